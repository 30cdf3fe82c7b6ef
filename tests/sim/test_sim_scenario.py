"""Every simulated home is one in which people, robot and radio behave as real ones do, whatever its seed."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from vad.geometry import project
from vad.sim.render_shapes import View
from vad.sim.scenario import Scenario, make_home

Floats = NDArray[np.float64]

STEP_S = 0.05
seeds = st.integers(0, 100_000)


@cache
def home(seed: int) -> Scenario:
    """A home with three visits, made once."""
    return make_home(seed, walks=3)


def in_picture(scenario: Scenario, xy_m: Floats, z_m: float) -> NDArray[np.bool_]:
    """Which points (N, 2) at this height the camera sees."""
    view = View.of(scenario.camera)
    points = np.column_stack([xy_m, np.full(len(xy_m), z_m)])
    in_front = view.camera_from_map.apply(points)[:, 2] > 0.1
    px = project(points, view.intrinsics, view.camera_from_map)
    size = (scenario.camera.width_px, scenario.camera.height_px)
    return np.asarray(in_front & (px >= 0).all(axis=1) & (px <= size).all(axis=1))


def clearance_m(scenario: Scenario, xy_m: Floats) -> float:
    """How near the points come to furniture; 0 inside it."""
    nearest = np.inf
    for box in scenario.boxes:
        low, high = np.array([box.x0_m, box.y0_m]), np.array([box.x1_m, box.y1_m])
        outside = np.maximum(np.maximum(low - xy_m, xy_m - high), 0.0)
        nearest = min(nearest, float(np.hypot(*outside.T).min()))
    return nearest


@given(seeds)
@settings(max_examples=40, deadline=None)
def test_people_walk_in_the_picture_and_leave_by_the_door(seed: int) -> None:
    scenario = home(seed)
    x0, y0, x1, _ = scenario.room_m
    for walk in scenario.walks:
        seen = in_picture(scenario, walk.xy_m, 0.0) & in_picture(scenario, walk.xy_m, walk.height_m)
        visible = np.flatnonzero(seen)
        assert len(visible) * STEP_S > 8.0, "long enough to be measured"
        assert seen[visible[0] : visible[-1] + 1].all(), "in one piece"
        assert not seen[0]
        assert not seen[-1]
        for end in (walk.xy_m[0], walk.xy_m[-1]):
            assert end[1] < y0, "behind the wall with the door"
            assert x0 < end[0] < x1
        assert clearance_m(scenario, walk.xy_m) > 0.0, "not through the furniture"


@given(seeds)
@settings(max_examples=40, deadline=None)
def test_people_move_as_bodies_do(seed: int) -> None:
    for walk in home(seed).walks:
        velocity = np.diff(walk.xy_m, axis=0) / STEP_S
        speed = np.linalg.norm(velocity, axis=1)
        assert speed.max() < 1.3
        assert np.median(speed) > 0.6
        acceleration = np.linalg.norm(np.diff(velocity, axis=0) / STEP_S, axis=1)
        assert acceleration.max() < 4.0
        assert 1.6 <= walk.height_m <= 1.9


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_a_walker_is_there_during_his_visits_only_and_his_state_fits_his_path(seed: int) -> None:
    scenario = home(seed)
    for before, after in pairwise(scenario.walks):
        assert after.start_s - before.end_s > 3.0, "between two visits the room is empty for a while"
        assert scenario.walker_at((before.end_s + after.start_s) / 2) is None
    assert scenario.walker_at(0.0) is None
    walk = scenario.walks[0]
    times = np.arange(walk.start_s + 0.2, walk.end_s - 0.2, 0.1)
    states = [scenario.walker_at(t) for t in times]
    phases, off_mps, off_rad = [], [], []
    for t, state in zip(times, states, strict=True):
        ahead = scenario.walker_at(t + 0.01)
        assert state is not None
        assert ahead is not None
        velocity = np.array([ahead.x_m - state.x_m, ahead.y_m - state.y_m]) / 0.01
        off_mps.append(abs(np.hypot(*velocity) - state.speed_mps))
        turned = np.arctan2(velocity[1], velocity[0]) - state.heading_rad
        off_rad.append(abs(np.angle(np.exp(1j * turned))))
        phases.append(state.phase_rad)
    # The table has steps of 0.05 s: in a turn on the spot speed and heading are of a moment before.
    assert np.percentile(off_mps, 90) < 0.15
    assert np.percentile(off_rad, 90) < 0.3
    assert np.all(np.diff(phases) >= 0), "nobody walks backwards in his own gait"
    strides = (phases[-1] - phases[0]) / (2 * np.pi)
    assert strides > 6


@given(seeds)
@settings(max_examples=40, deadline=None)
def test_the_robot_drives_without_jumps_where_the_camera_sees_it(seed: int) -> None:
    scenario = home(seed)
    t_s = np.arange(0.0, scenario.drive_end_s + 1.0, STEP_S)
    path = np.array([scenario.robot_at(t) for t in t_s])
    assert np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1).max() <= 0.36 * STEP_S
    assert np.abs(np.angle(np.exp(1j * np.diff(path[:, 2])))).max() <= 1.55 * STEP_S
    assert in_picture(scenario, path[:, :2], 0.0).all()
    assert clearance_m(scenario, path[:, :2]) > 0.0, "not through the furniture"
    still = path[t_s <= scenario.drive_start_s]
    assert np.ptp(still, axis=0).max() == 0.0
    assert np.ptp(path[:, 0]) > 1.5
    assert np.ptp(path[:, 1]) > 1.5
    assert scenario.drive_end_s < 90.0, "the demo has three minutes"


@given(seeds)
@settings(max_examples=60, deadline=None)
def test_the_device_is_in_the_home_and_not_at_the_hub(seed: int) -> None:
    scenario = home(seed)
    device, anchor = np.array(scenario.device_m), np.array(scenario.anchor_m)
    assert np.hypot(*(device - anchor)[:2]) >= 1.5
    x0, y0, x1, y1 = scenario.plan_m
    assert x0 < device[0] < x1
    assert y0 < device[1] < y1
    assert 0.3 < device[2] < 1.5
    assert np.linalg.norm(anchor - np.array(scenario.camera.eye_m)) < 0.2, "the hub is beside the camera"
    assert scenario.drive_end_s < scenario.join_s < scenario.walks[0].start_s


def test_a_seed_is_a_home() -> None:
    first, again, other = make_home(4), make_home(4), make_home(5)
    assert first.device_m == again.device_m
    assert first.room_m != other.room_m
    for a, b in zip(first.walks, again.walks, strict=True):
        np.testing.assert_array_equal(a.xy_m, b.xy_m)
    assert len({make_home(seed, walks=1).device_mac for seed in range(30)}) == 30
