"""Simulated drives of the robot, as a camera of unknown focal length sees them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vad.geometry import Intrinsics, Rigid, look_at, project
from vad.mapping.camera_calibration import CameraCalibration
from vad.mapping.camera_stage import CameraMapper

Array = NDArray[np.float64]
S_NS = 1_000_000_000


def way_points(shape: str, rng: np.random.Generator) -> Array:
    """Corners of a drive from a dock at (0.3, 0.3) over one of the paper's shapes on 3 m x 3 m of floor."""
    dock = np.array([[0.3, 0.3]])
    if shape == "L":
        corners = np.array([[0.3, 2.6], [2.4, 2.6], [0.3, 2.6], [0.3, 0.3]])
    elif shape == "circle":
        angle = np.linspace(-np.pi / 2, 1.5 * np.pi, 40)
        corners = np.column_stack([1.4 + 1.0 * np.cos(angle), 1.6 + 1.0 * np.sin(angle)])
    elif shape == "rectangle":
        corners = np.array([[2.4, 0.3], [2.4, 2.4], [0.3, 2.4], [0.3, 0.3]])
    elif shape == "line":
        corners = np.array([[2.6, 2.6], [0.3, 0.3]])
    else:
        corners = rng.uniform([0.0, 0.0], [2.8, 2.8], (8, 2))
    return np.vstack([dock, corners, dock])


def drive(points: Array, step_s: float = 0.01) -> Array:
    """True positions every `step_s`: 0.3 m/s, slower before and after each corner, a stop at both ends."""
    path = [points[0]] * int(1.5 / step_s)
    for start, end in pairwise(points):
        length = float(np.linalg.norm(end - start))
        done = 0.0
        while done < length:
            near = min(done, length - done)
            path.append(start + (end - start) * done / length)
            done += step_s * min(0.3, 0.1 + np.sqrt(2.0 * 0.3 * near))
    return np.array(path + [points[-1]] * int(1.5 / step_s))


@dataclass
class Scene:
    """A drive and what is true of it."""

    lens: Intrinsics
    eye: Array
    camera_from_map: Rigid
    truth: Array
    mapper: CameraMapper
    latency_s: float


def simulate(
    shape: str,
    seed: int,
    *,
    pose_hz: float = 10.0,
    frame_hz: float = 7.0,
    noise_px: float = 1.5,
    k1: float = -0.1,
    known_lens: bool = False,
    laps: int = 1,
    spurious: int = 0,
    latency_s: float = 0.2,
    jump_m: float = 0.0,
) -> Scene:
    """A drive seen by a camera of unknown focal length; a person's blobs for a third of the time."""
    rng = np.random.default_rng(seed)
    focal = rng.uniform(450.0, 620.0)
    lens = Intrinsics(640, 480, focal, focal, 319.5, 239.5, k1)
    eye = np.array([rng.uniform(0.5, 2.0), rng.uniform(-1.6, -1.2), rng.uniform(1.8, 2.4)])
    camera_from_map = look_at(eye, [rng.uniform(1.1, 1.6), rng.uniform(1.1, 1.6), 0.0])
    truth = drive(np.vstack([way_points(shape, rng) for _ in range(laps)]))
    mapper = CameraMapper(640, 480, lens if known_lens else None)
    duration = len(truth) * 0.01
    for t in np.arange(0.0, duration, 1.0 / pose_hz):
        x, y = truth[min(round(t * 100), len(truth) - 1)] + rng.normal(0.0, 0.02, 2)
        # In the first third the robot believes to be elsewhere.
        x += jump_m if t < duration / 3.0 else 0.0
        mapper.add_pose(int((t + latency_s) * S_NS), float(x), float(y), 0.02)
    walker = rng.uniform(0, 640, 2)
    previous = truth[0]
    for t in np.arange(0.05, duration, 1.0 / frame_hz):
        here = truth[min(round(t * 100), len(truth) - 1)]
        found = []
        px = project(np.array([[*here, 0.0]]), lens, camera_from_map)[0]
        visible = 0 < px[0] < 640 and 0 < px[1] < 480
        if visible and np.linalg.norm(here - previous) > 0.01 and rng.random() < 0.95:
            found.append(px + rng.normal(0.0, noise_px, 2))
        if (t % 30.0) < 10.0:
            walker = np.clip(walker + rng.normal(0.0, 12.0, 2), 0, [640, 480])
            found += [walker + rng.normal(0, 3, 2), walker + np.array([0, 40]) + rng.normal(0, 3, 2)]
        if rng.random() < 0.3:
            found.append(rng.uniform(0, [640, 480]))
        found += list(rng.uniform(0, [640, 480], (spurious, 2)))
        mapper.add_candidates(int(t * S_NS), np.array(found).reshape(-1, 2), noise_px)
        previous = here
    return Scene(lens, eye, camera_from_map, truth, mapper, latency_s)


def true_deviation(scene: Scene, result: CameraCalibration) -> float:
    """Mean distance of the floor point of the robot's true pixel from the robot's true place."""
    eye_view = scene.truth[::20]
    look = project(np.column_stack([eye_view, np.zeros(len(eye_view))]), scene.lens, scene.camera_from_map)
    inside = (look > 0).all(axis=1) & (look < (640, 480)).all(axis=1)
    xy, _ = result.floor_point(look[inside], 1.5)
    return float(np.mean(np.linalg.norm(xy - eye_view[inside], axis=1)))
