"""Drives of the robot through simulated rooms that a camera of an unknown lens watches: stage 1, seeded.

The paper's four paths on the floor that the camera sees, in the furnished rooms of `make_home`; a person
walks about for part of the time. The same drive gives candidates from geometry alone, and frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from vad.geometry import FloatArray, Intrinsics, Rigid, look_at, project
from vad.sim.scenario import Box, Scenario, make_home

DriveShape = Literal["L", "circle", "rectangle", "random"]
DRIVE_SHAPES: tuple[DriveShape, ...] = get_args(DriveShape)

POSE_SIGMA_M = 0.02
LATENCY_S = 0.2
PIXEL_SIGMA = 1.5

SPEED_M_S = 0.3
START_S = 2.0
# The robot's middle keeps this far from furniture and walls.
_CLEAR_M = 0.25
_EDGE_PX = 24.0
_TRIES = 600
_LARGEST_M = 3.0
# What moves less between two frames is no motion to a camera.
_SEEN_STEP_M = 0.01
_MISSED, _CLUTTER = 0.05, 0.2
_BODY_SIGMA_PX = 6.0


class Poses(NamedTuple):
    """What the robot says: t_s (N,) stamps on the camera's timeline, late by the latency; xy_m (N, 2)."""

    t_s: FloatArray
    xy_m: FloatArray


class Candidates(NamedTuple):
    """What moves in one frame: t_s; px (K, 2) raw pixels; sigma_px (K,); box (K, 4) if there is one."""

    t_s: float
    px: FloatArray
    sigma_px: FloatArray
    box: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class Drive:
    """One drive. scenario: room, robot and walker over time; lens: the true one, with its distortion."""

    scenario: Scenario
    lens: Intrinsics
    camera_from_map: Rigid
    shape: DriveShape
    laps: int

    @property
    def eye_m(self) -> FloatArray:
        """Where the camera truly is, (3,)."""
        return np.array(self.scenario.camera.eye_m)

    @property
    def end_s(self) -> float:
        """A second after the robot's stop."""
        return self.scenario.drive_end_s + 1.0

    def robot_xy_m(self, t_s: NDArray[np.float64]) -> FloatArray:
        """True places of the robot, (N, 2)."""
        return np.array([self.scenario.robot_at(float(t))[:2] for t in t_s]).reshape(-1, 2)

    def pixels(self, xy_m: FloatArray) -> FloatArray:
        """Where floor points (N, 2) are in the raw picture; NaN outside of it."""
        px = project(np.column_stack([xy_m, np.zeros(len(xy_m))]), self.lens, self.camera_from_map)
        size = (self.lens.width_px, self.lens.height_px)
        inside = np.asarray((px > 0.0).all(axis=1) & (px < size).all(axis=1))
        return np.where(inside[:, None], px, np.nan)

    def poses(self, rng: np.random.Generator, *, rate_hz: float, latency_s: float = LATENCY_S) -> Poses:
        """Poses with POSE_SIGMA_M of white noise per axis, stamped `latency_s` late."""
        t_s = np.arange(0.0, self.end_s, 1.0 / rate_hz)
        return Poses(t_s + latency_s, self.robot_xy_m(t_s) + rng.normal(0.0, POSE_SIGMA_M, (len(t_s), 2)))

    def candidates(self, rng: np.random.Generator, *, rate_hz: float) -> list[Candidates]:
        """What a finder of moving things would say, from geometry: the robot, the person, clutter."""
        t_s = np.arange(0.03, self.end_s, 1.0 / rate_hz)
        truth = self.robot_xy_m(t_s)
        step = np.linalg.norm(np.diff(truth, axis=0, prepend=truth[:1]), axis=1)
        size = (self.lens.width_px, self.lens.height_px)
        frames = []
        for t, px, moved in zip(t_s.tolist(), self.pixels(truth), step * rate_hz / 10.0, strict=True):
            found = []
            if np.isfinite(px[0]) and moved > _SEEN_STEP_M and rng.random() > _MISSED:
                found.append(px + rng.normal(0.0, PIXEL_SIGMA, 2))
            walker = self.scenario.walker_at(t)
            if walker is not None:
                feet = self.pixels(np.array([[walker.x_m, walker.y_m]]))[0]
                found += [feet + shift + rng.normal(0.0, _BODY_SIGMA_PX, 2) for shift in ((0, 0), (0, -40))]
            if rng.random() < _CLUTTER:
                found.append(rng.uniform((0.0, 0.0), size))
            seen = np.array(found).reshape(-1, 2)
            seen = seen[np.isfinite(seen[:, 0])]
            if len(seen):
                frames.append(Candidates(t, seen, np.full(len(seen), PIXEL_SIGMA)))
        return frames


def make_drive(seed: int, shape: DriveShape, *, laps: int = 2, centred: bool = True) -> Drive:
    """The home of `seed` with a camera of a random lens and `laps` rounds of a path.

    The lens has two radial terms, barrel for the most part as in webcams. centred: its principal point is
    the picture's middle; else it is off by about 1 % of the width.
    """
    home = make_home(seed, walks=3)
    rng = np.random.default_rng([seed, 0xD21])
    placed = home.camera
    width, height = placed.width_px, placed.height_px
    off = np.zeros(2) if centred else rng.normal(0.0, 0.01 * width, 2)
    lens = Intrinsics(
        width,
        height,
        placed.focal_px,
        placed.focal_px,
        (width - 1) / 2 + float(off[0]),
        (height - 1) / 2 + float(off[1]),
        float(rng.uniform(-0.25, 0.0)),
        float(rng.uniform(0.0, 0.05)),
    )
    view = look_at(placed.eye_m, placed.target_m)
    bare = replace(home, robot_path_m=np.zeros((2, 2)))
    drive = Drive(bare, lens, view, shape, laps)
    corners = _corners(drive, shape, rng)
    dock = _dock(drive, corners[0], rng)
    path = np.vstack([dock, corners, *[corners[1:]] * (laps - 1), dock])
    scenario = replace(
        home, robot_path_m=path, robot_speed_mps=SPEED_M_S, drive_start_s=START_S, join_s=0.0, walks=()
    )
    # Somebody walks about for part of the time.
    start_s, walks = START_S + 4.0, []
    for walk in home.walks:
        walks.append(replace(walk, start_s=start_s))
        start_s = walks[-1].end_s + 25.0
    return replace(drive, scenario=replace(scenario, walks=tuple(walks)))


def _corners(drive: Drive, shape: DriveShape, rng: np.random.Generator) -> FloatArray:
    """A closed path, (N, 2), on floor that is free and in the picture."""
    if shape == "random":
        return _random_corners(drive, rng)
    x0, y0, x1, y1 = drive.scenario.room_m
    best: tuple[float, FloatArray] | None = None
    for _ in range(_TRIES):
        size = rng.uniform(0.8, _LARGEST_M, 2)
        low = rng.uniform((x0 + _CLEAR_M, y0 + _CLEAR_M), (x1 - _CLEAR_M, y1 - _CLEAR_M))
        area = float(size.prod())
        if best is not None and area <= best[0]:
            continue
        corners = _shape(shape, low, size)
        if _free(drive, corners):
            best = area, corners
    if best is None:
        raise ValueError("the camera of this home sees too little free floor")
    return best[1]


def _dock(drive: Drive, begin: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Where the robot comes from, (1, 2): in the picture, at least 0.7 m straight off the path's begin."""
    x0, y0, x1, y1 = drive.scenario.room_m
    while True:
        dock = rng.uniform((x0, y0), (x1, y1))
        if np.linalg.norm(dock - begin) > 0.7 and _free(drive, np.array([dock, begin])):
            return np.array([dock], dtype=np.float64)


def _shape(shape: DriveShape, low: FloatArray, size: FloatArray) -> FloatArray:
    (x0, y0), (x1, y1) = low, low + size
    if shape == "L":
        # There and back along two legs.
        return np.array([[x0, y0], [x0, y1], [x1, y1], [x0, y1], [x0, y0]])
    if shape == "rectangle":
        return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])
    angle = np.linspace(0.0, 2 * np.pi, 41)
    ring = 0.5 * size.min() * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray(low + 0.5 * size + ring, dtype=np.float64)


def _random_corners(drive: Drive, rng: np.random.Generator) -> FloatArray:
    x0, y0, x1, y1 = drive.scenario.room_m
    corners: list[FloatArray] = []
    for _ in range(100 * _TRIES):
        corner = rng.uniform((x0, y0), (x1, y1))
        if not corners:
            if _free(drive, np.array([corner, corner])):
                corners.append(corner)
        elif np.linalg.norm(corner - corners[-1]) > 0.5 and _free(drive, np.array([corners[-1], corner])):
            last = len(corners) == 7
            if not last or _free(drive, np.array([corner, corners[0]])):
                corners.append(corner)
        if len(corners) == 8:
            return np.array([*corners, corners[0]])
    raise ValueError("the camera of this home sees too little free floor")


def _free(drive: Drive, corners: FloatArray) -> bool:
    points = np.vstack([a + (b - a) * np.linspace(0.0, 1.0, 12)[:, None] for a, b in pairwise(corners)])
    x0, y0, x1, y1 = drive.scenario.room_m
    room = Box(x0 + 2 * _CLEAR_M, y0 + 2 * _CLEAR_M, x1 - 2 * _CLEAR_M, y1 - 2 * _CLEAR_M, 0.0, (0, 0, 0))
    if not bool(np.all(_within(points, room))) or any(
        bool(np.any(_within(points, box))) for box in drive.scenario.boxes
    ):
        return False
    px = drive.pixels(points)
    size = np.array([drive.lens.width_px, drive.lens.height_px])
    return bool(np.all((px > _EDGE_PX) & (px < size - _EDGE_PX)))


def _within(points: FloatArray, box: Box) -> NDArray[np.bool_]:
    """Which points (N, 2) are in a box or nearer to it than the robot's middle may come."""
    low = np.array([box.x0_m, box.y0_m]) - _CLEAR_M
    high = np.array([box.x1_m, box.y1_m]) + _CLEAR_M
    return np.asarray(((points > low) & (points < high)).all(axis=1), dtype=np.bool_)
