"""The real network on rendered people, its coordinates, the motion gate and the ground point."""

from __future__ import annotations

from functools import cache, partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from effort import effort
from hypothesis import given
from hypothesis import strategies as st

from vad.errors import VadError
from vad.geometry import apply_homography, floor_homography, look_at, project
from vad.sim.render import Renderer
from vad.sim.render_shapes import View
from vad.sim.scenario import CameraPlacement, Scenario, make_home
from vad.vision.ground import GroundPoint, Refusal, ground_point
from vad.vision.people import MotionGate, Person, PoseNetwork

pytestmark = pytest.mark.timeout(600)
"""Much work for the processor: a busy machine takes many times as long as an idle one."""

FRAME_S = 0.4


@pytest.fixture(scope="module")
def network() -> PoseNetwork:
    return PoseNetwork()


@cache
def home(seed: int) -> tuple[Scenario, Renderer]:
    scenario = make_home(seed, walks=1)
    return scenario, Renderer(scenario, seed=seed)


def inside(scenario: Scenario, t_s: float) -> bool:
    x0, y0, x1, y1 = scenario.room_m
    walker = scenario.walker_at(t_s)
    return walker is not None and x0 < walker.x_m < x1 and y0 < walker.y_m < y1


def walk_times(scenario: Scenario) -> list[float]:
    walk = scenario.walks[0]
    return [t for t in np.arange(walk.start_s, walk.end_s, FRAME_S) if inside(scenario, t)]


@pytest.mark.parametrize(
    "seed", [1, pytest.param(2, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.slow)]
)
def test_the_network_finds_the_walker_and_the_ground_point_is_near_the_truth(
    network: PoseNetwork, seed: int
) -> None:
    scenario, renderer = home(seed)
    map_from_image = floor_homography(renderer.view.intrinsics, renderer.view.camera_from_map)
    times = walk_times(scenario)
    found, seen_s, errors = 0, [], []
    for t_s in times:
        people = network.infer(renderer.frame(t_s))
        found += len(people) > 0
        point = ground_point(people[0], (640, 480)) if people else Refusal("nobody")
        if isinstance(point, GroundPoint):
            walker = scenario.walker_at(t_s)
            assert walker is not None
            xy = apply_homography(map_from_image, [[point.x_px, point.y_px]])[0]
            seen_s.append(t_s)
            errors.append(xy - (walker.x_m, walker.y_m))
    error = np.array(errors)
    distance = np.linalg.norm(error, axis=1)
    # A step takes 0.75 s: averaged over that, what remains is the slow part.
    slow = np.array([error[np.abs(np.array(seen_s) - t) < 0.5].mean(axis=0) for t in seen_s])
    assert found >= 0.9 * len(times)
    assert len(errors) >= 0.7 * len(times)
    assert np.median(distance) < 0.12
    assert np.percentile(distance, 95) < 0.4
    assert np.median(np.linalg.norm(slow, axis=1)) < 0.08


def test_an_empty_room_holds_nobody(network: PoseNetwork) -> None:
    scenario, renderer = home(1)
    assert network.infer(renderer.frame(scenario.drive_start_s), score_min=0.3) == []


@pytest.mark.parametrize("shape", [(480, 640), (360, 640), (720, 720), (500, 333)])
def test_keypoints_are_in_the_pixels_of_a_picture_of_any_shape(
    network: PoseNetwork, shape: tuple[int, int]
) -> None:
    scenario, renderer = home(2)
    picture = renderer.frame(scenario.walks[0].start_s + 5.0)
    (reference, *_) = network.infer(picture)
    height, width = shape
    canvas = np.full((height, width, 3), 90, np.uint8)
    scale = min(width / 640, height / 480)
    inner = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    canvas[: inner.shape[0], : inner.shape[1]] = inner[:height, :width]
    person = network.infer(canvas)[0]
    # The trunk's middle: single joints wander by some pixels when the person is shown smaller.
    moved = (person.keypoints[[5, 6, 11, 12], :2] / scale - reference.keypoints[[5, 6, 11, 12], :2]).mean(
        axis=0
    )
    assert np.abs(moved).max() < 2.5


def test_another_input_size_finds_the_same_person() -> None:
    scenario, renderer = home(2)
    picture = renderer.frame(scenario.walks[0].start_s + 6.0)
    small, large = (PoseNetwork(input_size=size).infer(picture)[0] for size in ((192, 256), (480, 640)))
    assert np.abs(np.array(small.box) - large.box).max() < 25.0


def test_a_bad_model_or_input_size_is_refused(tmp_path: Path) -> None:
    with pytest.raises(VadError, match="missing"):
        PoseNetwork(tmp_path / "none.onnx")
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(b"this is no network")
    with pytest.raises(VadError, match="cannot be loaded"):
        PoseNetwork(broken)
    with pytest.raises(VadError, match="multiples of 32"):
        PoseNetwork(input_size=(300, 400))


def test_the_motion_gate_opens_for_a_walker_and_rests_in_a_still_room() -> None:
    scenario, renderer = home(1)
    gate = MotionGate(hold_frames=5)
    still_s = scenario.drive_end_s + 0.5
    states = [gate.update(renderer.frame(still_s + k / 15)) for k in range(40)]
    assert not any(states[6:])
    walk_s = walk_times(scenario)[10]
    states = [gate.update(renderer.frame(walk_s + k / 15)) for k in range(15)]
    assert all(states)
    dimmed = [gate.update((renderer.frame(still_s + k / 15) * 0.9).astype(np.uint8)) for k in range(60)]
    assert not any(dimmed[-10:])


def test_an_idle_frame_costs_the_gate_little() -> None:
    _, renderer = home(1)
    gate, picture = MotionGate(), renderer.frame(0.0)
    assert effort(*[partial(gate.update, picture)] * 30) < 1


# -- ground points of a geometric person -------------------------------------------------------------


def upright_person(xy_m: tuple[float, float], height_m: float, camera: CameraPlacement) -> Person:
    """A standing person exactly as the body model has it, without noise."""
    view = View.of(camera)
    fractions = {5: 0.81, 6: 0.81, 11: 0.522, 12: 0.522, 13: 0.285, 14: 0.285, 15: 0.061, 16: 0.061}
    keypoints = np.zeros((17, 3))
    for k, fraction in fractions.items():
        keypoints[k, :2] = project([[*xy_m, fraction * height_m]], view.intrinsics, view.camera_from_map)[0]
        keypoints[k, 2] = 0.6
    top, bottom = project([[*xy_m, height_m], [*xy_m, 0.0]], view.intrinsics, view.camera_from_map)
    return Person(keypoints, (bottom[0] - 30, top[1], bottom[0] + 30, bottom[1] + 5), 0.6)


camera_places = st.builds(
    lambda z, f, down: CameraPlacement((0.0, 0.0, z), (3.0, 3.0, down), 640, 480, f),
    st.floats(1.2, 2.6),
    st.floats(350, 700),
    st.floats(0.2, 0.9),
)


@given(camera_places, st.floats(2.2, 4.0), st.floats(-0.6, 0.6), st.floats(1.5, 1.95))
def test_the_ground_point_of_an_upright_body_is_exact(
    camera: CameraPlacement, along: float, aside: float, height_m: float
) -> None:
    place = (along - aside, along + aside)
    person = upright_person(place, height_m, camera)
    view = View.of(camera)
    truth = project([[*place, 0.0]], view.intrinsics, view.camera_from_map)[0]
    point = ground_point(person, (640, 480))
    if person.box[3] > 470 or not 20 < truth[0] < 620:
        return
    assert isinstance(point, GroundPoint)
    # Heights keep their cross-ratio; only the lean's line is an approximation, good to a pixel or so.
    assert abs(point.y_px - truth[1]) < 0.1
    assert abs(point.x_px - truth[0]) < 2.0


@pytest.fixture
def standing() -> Person:
    return upright_person((2.6, 2.6), 1.75, CameraPlacement((0, 0, 2.2), (3, 3, 0.5), 640, 480, 410))


def changed(person: Person, scores: dict[int, float], box: tuple[float, ...] | None = None) -> Person:
    keypoints = person.keypoints.copy()
    for k, score in scores.items():
        keypoints[k, 2] = score
    x0, y0, x1, y1 = box or person.box
    return Person(keypoints, (x0, y0, x1, y1), person.score)


def test_hidden_ankles_are_gated(standing: Person) -> None:
    both = ground_point(standing, (640, 480))
    one = ground_point(changed(standing, {16: 0.12}), (640, 480))
    alone = ground_point(changed(standing, {16: 0.01}), (640, 480))
    assert isinstance(both, GroundPoint)
    assert isinstance(one, GroundPoint)
    assert isinstance(alone, GroundPoint)
    assert (both.ankles, one.ankles, alone.ankles) == (2, 1, 1)
    assert both.covariance_px2[1, 1] < one.covariance_px2[1, 1] < alone.covariance_px2[1, 1]
    none = ground_point(changed(standing, {15: 0.1, 16: 0.12}), (640, 480))
    assert none == Refusal("no ankle seen")


def test_without_a_trunk_equation_6_shifts_to_the_boxs_bottom(standing: Person) -> None:
    point = ground_point(changed(standing, {5: 0.05, 6: 0.05}), (640, 480))
    whole = ground_point(standing, (640, 480))
    assert isinstance(point, GroundPoint)
    assert isinstance(whole, GroundPoint)
    assert point.y_px == pytest.approx(standing.box[3])
    assert point.covariance_px2[1, 1] > whole.covariance_px2[1, 1]


def test_feet_cut_by_the_pictures_edge_are_refused(standing: Person) -> None:
    x0, y0, x1, _ = standing.box
    cut = changed(standing, {}, (x0, y0, x1, 478.0))
    assert ground_point(cut, (640, 480)) == Refusal("feet cut off by the picture's lower edge")
    ankle_x = float(standing.keypoints[15, 0])
    narrow = ground_point(standing, (int(ankle_x) + 3, 480))
    assert narrow == Refusal("feet cut off by the picture's side")


def test_the_view_of_a_placement_is_the_scenarios_camera() -> None:
    placement = CameraPlacement((0, 0, 2), (3, 3, 0.5), 640, 480, 400)
    view = View.of(placement)
    middle = project([placement.target_m], view.intrinsics, look_at(placement.eye_m, placement.target_m))
    assert middle[0] == pytest.approx([320, 240])
