"""`tools/bench camera --moved`: how soon a moved camera is noticed, and that light alone never moves it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from bench_camera_cases import FRAME_HZ, POSE_HZ

from vad.geometry import look_at
from vad.mapping.camera_calibration import CameraCalibration
from vad.mapping.camera_keeper import LOOK_EVERY_NS, CameraKeeper
from vad.mapping.camera_view import CameraView
from vad.sim.camera_drive import POSE_SIGMA_M, Drive, make_drive
from vad.sim.render_lens import LensRenderer
from vad.sim.render_shapes import Image

_S_NS = 1_000_000_000
_LOOKS = 12
_SOLVE_EVERY_S = 3.0
# How the camera is moved: its place (m) and the point it looks at (m).
MOVES: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "turned by 1 degree": ((0.0, 0.0, 0.0), (0.06, 0.0, 0.0)),
    "turned by 3 degrees": ((0.0, 0.0, 0.0), (0.2, 0.0, 0.0)),
    "turned by 10 degrees": ((0.0, 0.0, 0.0), (0.6, -0.3, 0.0)),
    "turned by 30 degrees": ((0.0, 0.0, 0.0), (1.8, -1.8, 0.0)),
    "shifted by 11 cm": ((0.1, 0.05, 0.0), (0.1, 0.05, 0.0)),
    "30 cm lower": ((0.0, 0.0, -0.3), (0.0, 0.0, -0.3)),
}
LIGHTS = ("none", "dim", "dark", "bright", "lamp", "sun", "infrared")


@dataclass(frozen=True, slots=True)
class Noticed:
    """One event in one room. after_s: until it counted as moved, None: never; by: `background`, `robot`."""

    event: str
    by: str
    seed: int
    after_s: float | None


def lit(picture: Image, kind: str, rng: np.random.Generator) -> Image:
    """A picture in another light."""
    light = picture.astype(np.float64)
    height, width = light.shape[:2]
    x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    if kind == "dim":
        light = 0.06 * light + rng.normal(0.0, 3.0, light.shape)
    elif kind == "dark":
        light = rng.normal(4.0, 3.0, light.shape)
    elif kind == "bright":
        light = 2.2 * light
    elif kind == "lamp":
        light = light * (0.15 + 1.6 * np.exp(-((x - 0.2) ** 2 + (y - 0.3) ** 2) / 0.08))[:, :, None]
    elif kind == "sun":
        patch = ((x + 0.3 * y > 0.5) & (x + 0.3 * y < 0.75) & (y > 0.4)).astype(np.float64)
        light = light * (0.7 + 1.8 * cv2.GaussianBlur(patch, (0, 0), 2.0)[:, :, None])
    elif kind == "infrared":
        grey = light.mean(axis=2, keepdims=True)
        light = np.repeat(200.0 * (grey / 255.0) ** 0.7, 3, axis=2) + rng.normal(0.0, 4.0, light.shape)
    return np.asarray(np.clip(light, 0.0, 255.0), dtype=np.uint8)


def moved(drive: Drive, name: str) -> Drive:
    """The same room and drive, the camera moved."""
    eye_by, target_by = MOVES[name]
    camera = drive.scenario.camera
    eye, target = np.add(camera.eye_m, eye_by), np.add(camera.target_m, target_by)
    place = replace(camera, eye_m=tuple(eye.tolist()), target_m=tuple(target.tolist()))
    scenario = replace(drive.scenario, camera=place)
    return replace(drive, scenario=scenario, camera_from_map=look_at(eye, target))


def room(seed: int) -> list[Noticed]:
    """Every event in one room."""
    drive = make_drive(seed, "rectangle", laps=1)
    keeper = CameraKeeper(drive.lens.width_px, drive.lens.height_px, None, None)
    _play(keeper, drive, 0.0)
    known = keeper.calibration
    before = LensRenderer(drive.scenario, drive.lens, seed=seed)
    known = replace(known, view=CameraView.of(before.frame(0.0)))
    rng = np.random.default_rng([seed, 0x11])
    rows = []
    for light in LIGHTS:
        pictures = [lit(before.frame(10.0 + 5.0 * k), light, rng) for k in range(_LOOKS)]
        rows.append(Noticed(f"light: {light}", "background", seed, _looks(known, pictures)))
    for name in MOVES:
        elsewhere = moved(drive, name)
        after = LensRenderer(elsewhere.scenario, elsewhere.lens, seed=seed)
        pictures = [after.frame(10.0 + 5.0 * k) for k in range(_LOOKS)]
        rows.append(Noticed(name, "background", seed, _looks(known, pictures)))
        rows.append(Noticed(name, "robot", seed, _drives(replace(known, view=None), elsewhere)))
    rows.append(Noticed("not moved", "robot", seed, _drives(replace(known, view=None), drive)))
    return rows


def _looks(known: CameraCalibration, pictures: list[Image]) -> float | None:
    """Seconds from the first picture until it counts as moved."""
    assert known.intrinsics is not None
    keeper = CameraKeeper(known.intrinsics.width_px, known.intrinsics.height_px, None, known)
    for k, picture in enumerate(pictures):
        if keeper.look(k * LOOK_EVERY_NS, picture):
            return k * LOOK_EVERY_NS / _S_NS
    return None


def _drives(known: CameraCalibration, drive: Drive) -> float | None:
    """Seconds of driving until the robot alone makes it count as moved."""
    assert known.intrinsics is not None
    keeper = CameraKeeper(known.intrinsics.width_px, known.intrinsics.height_px, None, known)
    return _play(keeper, drive, 1000.0)


def _play(keeper: CameraKeeper, drive: Drive, begin_s: float) -> float | None:
    rng = np.random.default_rng(round(begin_s))
    poses = list(zip(*drive.poses(rng, rate_hz=POSE_HZ), strict=True))
    solved_s = 0.0
    for frame in drive.candidates(rng, rate_hz=FRAME_HZ):
        while poses and poses[0][0] <= frame.t_s + 0.2:
            t, (x, y) = poses.pop(0)
            keeper.add_pose(round((begin_s + t) * _S_NS), float(x), float(y), POSE_SIGMA_M)
        now_ns = round((begin_s + frame.t_s) * _S_NS)
        keeper.add_candidates(now_ns, frame.px, frame.sigma_px)
        if frame.t_s - solved_s >= _SOLVE_EVERY_S:
            solved_s = frame.t_s
            if keeper.solve(now_ns).status == "recalibrating":
                return frame.t_s
    return None
