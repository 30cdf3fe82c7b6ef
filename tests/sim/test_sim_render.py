"""The simulated camera's pictures: same time same picture, people and robot where the scenario has them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from effort import effort

from vad.geometry import project
from vad.sim.render import Renderer
from vad.sim.render_person import foot_at
from vad.sim.render_shapes import View
from vad.sim.scenario import Scenario, make_home


@cache
def home(seed: int) -> tuple[Scenario, Renderer]:
    scenario = make_home(seed, walks=1)
    return scenario, Renderer(scenario, seed=seed)


def small(scenario: Scenario) -> Scenario:
    """The same home in pictures of a quarter of the pixels."""
    camera = replace(scenario.camera, width_px=320, height_px=240, focal_px=scenario.camera.focal_px / 2)
    return replace(scenario, camera=camera)


def changed_pixels(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of what differs by far more than noise."""
    rows, columns = np.nonzero(np.abs(a.astype(int) - b).max(axis=2) > 30)
    return rows, columns


def test_a_frame_is_a_function_of_its_time_alone() -> None:
    scenario = small(home(1)[0])
    renderer = Renderer(scenario, seed=1)
    first = renderer.frame(10.0)
    renderer.frame(scenario.walks[0].start_s + 5.0)
    assert np.array_equal(first, renderer.frame(10.0))
    assert np.array_equal(first, Renderer(scenario, seed=1).frame(10.0))
    assert not np.array_equal(first, renderer.frame(10.1))
    assert not np.array_equal(first, Renderer(scenario, seed=2).frame(10.0))
    assert first.shape == (240, 320, 3)
    assert first.dtype == np.uint8


def test_still_frames_differ_by_noise_only() -> None:
    _, renderer = home(1)
    a, b = renderer.frame(0.0).astype(float), renderer.frame(0.5).astype(float)
    assert 1.0 < (a - b).std() < 5.0
    assert np.abs(a - b).max() < 30


@pytest.mark.parametrize("seed", [1, 2])
def test_the_robot_is_drawn_where_it_is(seed: int) -> None:
    scenario, renderer = home(seed)
    for share in (0.3, 0.6):
        t_s = scenario.drive_start_s + share * (scenario.drive_end_s - scenario.drive_start_s)
        rows, columns = changed_pixels(renderer.frame(t_s), renderer.frame(scenario.drive_end_s + 1.0))
        x, y, _ = scenario.robot_at(t_s)
        truth = project([[x, y, 0.045]], renderer.view.intrinsics, renderer.view.camera_from_map)[0]
        near = np.hypot(columns - truth[0], rows - truth[1]) < 60
        assert np.count_nonzero(near) > 80
        assert abs(np.median(columns[near]) - truth[0]) < 6
        assert abs(np.median(rows[near]) - truth[1]) < 8


def test_a_person_is_drawn_from_the_floor_to_the_head_inside_the_room_only() -> None:
    scenario, renderer = home(2)
    walk = scenario.walks[0]
    empty = renderer.frame(scenario.drive_end_s + 1.0)
    assert len(changed_pixels(renderer.frame(walk.start_s + 0.05), empty)[0]) == 0  # still behind the wall
    t_s = walk.start_s + 0.5 * (walk.end_s - walk.start_s)
    walker = scenario.walker_at(t_s)
    assert walker is not None
    rows, columns = changed_pixels(renderer.frame(t_s), empty)
    feet, head = project(
        [[walker.x_m, walker.y_m, 0.0], [walker.x_m, walker.y_m, walker.height_m]],
        renderer.view.intrinsics,
        renderer.view.camera_from_map,
    )
    tall = feet[1] - head[1]
    assert abs(np.percentile(rows, 1) - head[1]) < 0.1 * tall
    assert abs(np.percentile(rows, 99) - feet[1]) < 0.15 * tall
    assert abs(np.median(columns) - (feet[0] + head[0]) / 2) < 0.12 * tall


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_foot_on_the_floor_stands_still_and_swings_without_a_jump(side: float) -> None:
    height_m, stride_m = 1.75, 0.8 * 1.75
    cycles = np.linspace(0, 1, 400, endpoint=False)
    ankles = np.array([foot_at(float(c), side, height_m).ankle_m for c in cycles])
    in_the_world = ankles[:, 0] + cycles * stride_m
    stance = cycles < 0.6
    assert np.ptp(in_the_world[stance]) < 1e-9
    wrapped = np.vstack([ankles, ankles[:1]])
    assert np.abs(np.diff(wrapped, axis=0)).max() < 0.02
    assert ankles[:, 2].min() > 0.05
    # Over a whole cycle the two ankles' middle is where the scenario says the walker is.
    assert abs(ankles[:, 0].mean()) < 0.01


def test_furniture_hides_who_stands_behind_it() -> None:
    scenario = small(home(1)[0])
    eye = np.array(scenario.camera.eye_m)
    box = scenario.boxes[1]
    middle = np.array([(box.x0_m + box.x1_m) / 2, (box.y0_m + box.y1_m) / 2])
    away = (middle - eye[:2]) / np.linalg.norm(middle - eye[:2])
    robot = np.vstack([middle + 0.8 * away, middle + 0.8 * away + 0.01])
    hidden = replace(scenario, robot_path_m=robot, walks=())
    moved = replace(hidden, robot_path_m=robot + 50.0)
    a, b = (Renderer(s, seed=1).frame(100.0) for s in (hidden, moved))
    view = View.of(hidden.camera)
    front = project([[*middle, 0.3 * box.height_m]], view.intrinsics, view.camera_from_map)[0].astype(int)
    patch = np.s_[front[1] - 6 : front[1] + 6, max(front[0] - 6, 0) : front[0] + 6]
    assert np.abs(a[patch].astype(int) - b[patch]).max() < 30


def test_a_frame_costs_little() -> None:
    scenario, renderer = home(1)
    walk = scenario.walks[0]
    times_s = np.linspace(walk.start_s, walk.end_s, 40)
    assert effort(*(partial(renderer.frame, float(t_s)) for t_s in times_s)) < 5
