"""A camera over its life: calibrated, moved, calibrated anew; light and lost robots do not fool it."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from vad.geometry import look_at
from vad.mapping.camera_calibration import CameraCalibration
from vad.mapping.camera_keeper import LOOK_EVERY_NS, CameraKeeper
from vad.mapping.camera_view import CameraView
from vad.sim.camera_drive import POSE_SIGMA_M, Drive, make_drive
from vad.sim.render_lens import LensRenderer

pytestmark = pytest.mark.timeout(600)
"""Much work for the processor: a busy machine takes many times as long as an idle one."""

S_NS = 1_000_000_000
Image = NDArray[np.uint8]


@cache
def drive(seed: int = 0) -> Drive:
    return make_drive(seed, "rectangle", laps=1)


def turned(before: Drive, turn_m: float) -> Drive:
    """The same drive with the camera looking `turn_m` beside where it looked."""
    target = np.add(before.scenario.camera.target_m, (turn_m, 0.0, 0.0))
    camera = replace(before.scenario.camera, target_m=(float(target[0]), float(target[1]), float(target[2])))
    view = look_at(camera.eye_m, camera.target_m)
    return replace(before, scenario=replace(before.scenario, camera=camera), camera_from_map=view)


def play(
    keeper: CameraKeeper,
    seen: Drive,
    begin_s: float,
    *,
    shift_m: float = 0.0,
    until: str = "",
    limit_s: float = 1e9,
    every_s: float = 6.0,
) -> float:
    """One drive from `begin_s` on, solved every so often; how long it took to reach the status `until`, or
    the whole drive."""
    rng = np.random.default_rng(round(begin_s))
    poses = list(zip(*seen.poses(rng, rate_hz=10.0), strict=True))
    frames = seen.candidates(rng, rate_hz=10.0)
    solved_s = 0.0
    for frame in frames:
        while poses and poses[0][0] <= frame.t_s + 0.2:
            t, (x, y) = poses.pop(0)
            keeper.add_pose(round((begin_s + t) * S_NS), float(x) + shift_m, float(y), POSE_SIGMA_M)
        keeper.add_candidates(round((begin_s + frame.t_s) * S_NS), frame.px, frame.sigma_px)
        if frame.t_s - solved_s >= every_s:
            solved_s = frame.t_s
            if keeper.solve(round((begin_s + frame.t_s) * S_NS)).status == until or frame.t_s > limit_s:
                return frame.t_s
    keeper.solve(round((begin_s + seen.end_s) * S_NS))
    return seen.end_s


@cache
def renderer(turn_m: float = 0.0) -> LensRenderer:
    """Pictures of half the pixels: the background is compared at their width."""
    seen = turned(drive(), turn_m) if turn_m else drive()
    return LensRenderer(seen.scenario, seen.lens.scaled(480, 360))


@cache
def known() -> CameraCalibration:
    keeper = CameraKeeper(640, 480, None, None)
    play(keeper, drive(), 0.0, every_s=1e9)
    assert keeper.calibration.status == "valid"
    return keeper.calibration


def calibrated(view: CameraView | None = None) -> CameraCalibration:
    return replace(known(), view=view)


@pytest.mark.slow
def test_a_turned_camera_is_noticed_by_the_robot_within_a_minute_and_calibrated_anew() -> None:
    keeper = CameraKeeper(640, 480, None, calibrated())
    play(keeper, drive(), 100.0)
    assert keeper.calibration.status == "valid"
    other = turned(drive(), 0.5)
    noticed_s = play(keeper, other, 300.0, until="recalibrating")
    assert keeper.calibration.status == "recalibrating"
    assert noticed_s < 60.0
    assert "moved" in keeper.calibration.reason
    assert keeper.calibration.camera_from_map is None
    play(keeper, other, 500.0, until="valid")
    assert keeper.calibration.status == "valid"
    xy = other.robot_xy_m(np.arange(5.0, 30.0, 1.0))
    found, _ = keeper.calibration.floor_point(other.pixels(xy), 1.0)
    assert float(np.nanmean(np.linalg.norm(found - xy, axis=1))) < 0.03


@pytest.mark.slow
def test_a_robot_that_lost_its_place_is_no_moved_camera() -> None:
    picture = renderer().frame(0.0)
    keeper = CameraKeeper(640, 480, None, calibrated(CameraView.of(picture)))
    assert not keeper.look(200 * S_NS, picture)
    # The background keeps standing still; `look` says so again and again while the robot drives.
    keeper.look(224 * S_NS, picture)
    play(keeper, drive(), 200.0, shift_m=1.0, limit_s=34.0)
    assert keeper.calibration.status == "valid"
    assert "lost" in keeper.calibration.reason
    # It finds itself: the calibration stands as it did.
    play(keeper, drive(), 400.0)
    assert keeper.calibration.status == "valid"
    assert keeper.calibration.reason == ""


@pytest.mark.slow
def test_a_person_alone_is_no_moved_camera() -> None:
    keeper = CameraKeeper(640, 480, None, calibrated())
    rng = np.random.default_rng(3)
    walker = np.array([300.0, 300.0])
    truth = drive().robot_xy_m(np.arange(0.0, 60.0, 0.1))
    for k, (x, y) in enumerate(truth.tolist()):
        t_ns = 200 * S_NS + k * S_NS // 10
        keeper.add_pose(t_ns, x, y, POSE_SIGMA_M)
        walker = np.clip(walker + rng.normal(0.0, 8.0, 2), 0.0, (640.0, 480.0))
        keeper.add_candidates(t_ns, walker, 1.5)
        if k % 60 == 59:
            assert keeper.solve(t_ns).status == "valid"


def looks(keeper: CameraKeeper, pictures: list[Image], begin_s: float) -> int:
    """How many looks it takes until the camera counts as moved; 0 for never."""
    for k, picture in enumerate(pictures):
        if keeper.look(round(begin_s * S_NS) + k * LOOK_EVERY_NS, picture):
            return k + 1
    return 0


@pytest.mark.parametrize("turn_m", [0.15, pytest.param(1.0, marks=pytest.mark.slow)])
def test_the_background_says_that_the_camera_was_moved(turn_m: float) -> None:
    before, after = renderer(), renderer(turn_m)
    keeper = CameraKeeper(640, 480, None, calibrated(CameraView.of(before.frame(1.0))))
    assert looks(keeper, [before.frame(t) for t in (10.0, 15.0, 20.0)], 10.0) == 0
    # Within a minute, and not at once: a bumped camera may swing back.
    assert looks(keeper, [after.frame(t) for t in (25.0, 30.0, 35.0)], 25.0) in (2, 3)
    assert keeper.calibration.status == "recalibrating"
    assert "moved" in keeper.calibration.reason


@pytest.mark.slow
def test_a_camera_turned_to_another_wall_is_noticed() -> None:
    before = renderer().frame(1.0)
    other = make_drive(5, "rectangle", laps=1)
    after = LensRenderer(other.scenario, other.lens)
    keeper = CameraKeeper(640, 480, None, calibrated(CameraView.of(before)))
    seen = looks(keeper, [after.frame(25.0 + 5.0 * k) for k in range(12)], 25.0)
    assert 0 < seen <= 12
    assert keeper.calibration.status == "recalibrating"


def lit(picture: Image, kind: str) -> Image:
    """The picture in another light."""
    rng = np.random.default_rng(1)
    light = picture.astype(np.float64)
    height, width = light.shape[:2]
    x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    if kind == "dim":
        light = 0.06 * light + rng.normal(0.0, 3.0, light.shape)
    elif kind == "dark":  # with a sensor's fixed pattern
        light = rng.normal(4.0, 3.0, light.shape)
    elif kind == "bright":
        light = 2.2 * light
    elif kind == "lamp":
        light = light * (0.15 + 1.6 * np.exp(-((x - 0.2) ** 2 + (y - 0.3) ** 2) / 0.08))[:, :, None]
    elif kind == "sun":
        patch = ((x + 0.3 * y > 0.5) & (x + 0.3 * y < 0.75) & (y > 0.4)).astype(np.float64)
        light = light * (0.7 + 1.8 * cv2.GaussianBlur(patch, (0, 0), 2.0)[:, :, None])
    else:
        grey = light.mean(axis=2, keepdims=True)
        light = np.repeat(200.0 * (grey / 255.0) ** 0.7, 3, axis=2) + rng.normal(0.0, 4.0, light.shape)
    return np.asarray(np.clip(light, 0.0, 255.0), dtype=np.uint8)


@pytest.mark.parametrize(
    "kind",
    [
        "dark",
        *(pytest.param(k, marks=pytest.mark.slow) for k in ("dim", "bright", "lamp", "sun", "infrared")),
    ],
)
def test_light_alone_never_moves_the_camera(kind: str) -> None:
    keeper = CameraKeeper(640, 480, None, calibrated(CameraView.of(renderer().frame(1.0))))
    pictures = [lit(renderer().frame(5.0 + 5.0 * k), kind) for k in range(8)]
    assert looks(keeper, pictures, 10.0) == 0
    assert keeper.calibration.status == "valid"


@pytest.mark.slow
def test_moved_while_it_was_being_calibrated_begins_again() -> None:
    keeper = CameraKeeper(640, 480, None, None)
    still, other = drive(), turned(drive(), 1.0)
    before, after = renderer(), renderer(1.0)
    assert not keeper.look(0, before.frame(0.0))
    play(keeper, still, 0.0, limit_s=10.0)
    assert looks(keeper, [after.frame(t) for t in (11.0, 16.0, 21.0)], 11.0) in (2, 3)
    assert keeper.calibration.status == "collecting"
    play(keeper, other, 100.0)
    assert keeper.calibration.status == "valid"
    assert keeper.calibration.view is not None


def test_another_picture_size_is_another_camera() -> None:
    keeper = CameraKeeper(1280, 720, None, calibrated())
    assert keeper.calibration.status == "uncalibrated"
    assert "size" in keeper.calibration.reason


def test_view_survives_json_and_refuses_what_is_none() -> None:
    view = CameraView.of(renderer().frame(1.0))
    record = json.loads(json.dumps(calibrated(view).to_dict()))
    back = CameraCalibration.from_dict(record)
    assert back.view is not None
    assert back.view.change_to(view).verdict == "same"
    assert len(json.dumps(record["view"])) < 40_000
    for spoil in ({"points": [[0.0, 0.0]]}, {"descriptors": "?"}, {"points": [[float("nan"), 0.0]] * 400}):
        with pytest.raises(ValueError, match="view"):
            CameraView.from_dict({**record["view"], **spoil})
    nothing = CameraView.of(np.zeros((48, 64), np.uint8))
    assert nothing.change_to(view).verdict == "unknown"
    assert CameraView.from_dict(nothing.to_dict()).change_to(nothing).verdict == "unknown"
