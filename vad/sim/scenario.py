"""One simulated home, fully determined by its seed: rooms, camera, radio, robot, people, what happens when.

Everything here is a value or a function of time, so that the picture, the radio and the robot's serial
line show the same world at the same instant. Times are seconds since the home's start (`t_s`); places
are metres in the map frame (x right, y up on the plan, z up), which is also the robot's own frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

CARRIER_HZ = 5.24e9
ROBOT_RADIUS_M = 0.17
ROBOT_HEIGHT_M = 0.09
_TABLE_STEP_S = 0.05


@dataclass(frozen=True, slots=True)
class Box:
    """A piece of furniture or a wall: an upright box on the floor. rgb in 0..255."""

    x0_m: float
    y0_m: float
    x1_m: float
    y1_m: float
    height_m: float
    rgb: tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class CameraPlacement:
    """Where the camera hangs and what its lens is (pinhole, principal point centred)."""

    eye_m: tuple[float, float, float]
    target_m: tuple[float, float, float]
    width_px: int
    height_px: int
    focal_px: float


@dataclass(frozen=True, slots=True)
class WalkerState:
    """A person at one instant. x_m, y_m: midway between the feet; phase_rad: gait, 2 pi in two steps."""

    x_m: float
    y_m: float
    heading_rad: float
    speed_mps: float
    phase_rad: float
    height_m: float


@dataclass(frozen=True)
class Walk:
    """One visit of a walker: a path sampled every 0.05 s from start_s on."""

    start_s: float
    xy_m: FloatArray
    height_m: float

    @cached_property
    def _walked_m(self) -> FloatArray:
        steps = np.linalg.norm(np.diff(self.xy_m, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def end_s(self) -> float:
        """When the walker is out of the picture again."""
        return self.start_s + (len(self.xy_m) - 1) * _TABLE_STEP_S

    def state(self, t_s: float) -> WalkerState | None:
        """The walker at t_s; None while nobody is there."""
        u = (t_s - self.start_s) / _TABLE_STEP_S
        if u < 0 or u > len(self.xy_m) - 1:
            return None
        grid = np.arange(len(self.xy_m))
        x, y = (float(np.interp(u, grid, self.xy_m[:, k])) for k in (0, 1))
        i = int(np.clip(u, 1, len(self.xy_m) - 2))
        velocity = (self.xy_m[i + 1] - self.xy_m[i - 1]) / (2 * _TABLE_STEP_S)
        walked_m = float(np.interp(u, grid, self._walked_m))
        stride_m = 0.8 * self.height_m
        return WalkerState(
            x,
            y,
            float(np.arctan2(velocity[1], velocity[0])),
            float(np.hypot(*velocity)),
            2 * np.pi * walked_m / stride_m,
            self.height_m,
        )


@dataclass(frozen=True)
class Scenario:
    """A home with one hub, one new device, one robot and one person who walks now and then.

    room_m: (x0, y0, x1, y1) of the room the camera sees; plan_m: of the whole plan; anchor_m: the hub's
    antenna (centre of its array), beside the camera; device_m: the truth to be found.
    """

    seed: int
    room_m: tuple[float, float, float, float]
    plan_m: tuple[float, float, float, float]
    boxes: tuple[Box, ...]
    camera: CameraPlacement
    anchor_m: tuple[float, float, float]
    device_m: tuple[float, float, float]
    device_mac: str
    robot_path_m: FloatArray
    robot_speed_mps: float
    drive_start_s: float
    join_s: float
    walks: tuple[Walk, ...]

    @cached_property
    def _robot_clock_s(self) -> FloatArray:
        """When the robot is at each corner: it drives straight and turns on the spot at 1.5 rad/s."""
        legs = np.diff(self.robot_path_m, axis=0)
        headings = np.arctan2(legs[:, 1], legs[:, 0])
        turns = np.abs(np.angle(np.exp(1j * np.diff(headings, prepend=headings[0]))))
        spent = turns / 1.5 + np.linalg.norm(legs, axis=1) / self.robot_speed_mps
        return np.concatenate([[0.0], np.cumsum(spent)])

    @property
    def drive_end_s(self) -> float:
        """When the robot stands still again."""
        return self.drive_start_s + float(self._robot_clock_s[-1])

    def robot_at(self, t_s: float) -> tuple[float, float, float]:
        """The robot's x_m, y_m, yaw_rad (counter-clockwise from x)."""
        clock = self._robot_clock_s
        u = float(np.clip(t_s - self.drive_start_s, 0.0, clock[-1]))
        leg = int(np.clip(np.searchsorted(clock, u, side="right") - 1, 0, len(clock) - 2))
        a, b = self.robot_path_m[leg], self.robot_path_m[leg + 1]
        driving_s = float(np.linalg.norm(b - a)) / self.robot_speed_mps
        heading = float(np.arctan2(*(b - a)[::-1]))
        before_drive_s = clock[leg + 1] - driving_s - u
        if before_drive_s > 0 and leg > 0:
            previous = a - self.robot_path_m[leg - 1]
            start = float(np.arctan2(previous[1], previous[0]))
            turn = float(np.angle(np.exp(1j * (heading - start))))
            turning_s = abs(turn) / 1.5
            return float(a[0]), float(a[1]), start + turn * (1 - before_drive_s / max(turning_s, 1e-9))
        along = a + (b - a) * np.clip((u - (clock[leg + 1] - driving_s)) / max(driving_s, 1e-9), 0.0, 1.0)
        return float(along[0]), float(along[1]), heading

    def walker_at(self, t_s: float) -> WalkerState | None:
        """The person at t_s; None while nobody is in the room."""
        for walk in self.walks:
            if walk.start_s <= t_s <= walk.end_s:
                return walk.state(t_s)
        return None


def _smooth_walk(corners_m: FloatArray, start_s: float, rng: np.random.Generator, height_m: float) -> Walk:
    """A person's walk through corners: rounded turns, 0.75-1.1 m/s with slow changes of pace."""
    dense: list[FloatArray] = []
    for a, b in pairwise(corners_m):
        n = max(2, int(np.linalg.norm(b - a) / 0.02))
        dense.append(a + (b - a) * np.linspace(0, 1, n, endpoint=False)[:, None])
    path = np.concatenate([*dense, corners_m[-1:]])
    path = _averaged(path, 45)  # 0.9 m of path: nobody turns on a point
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    t, along, pace = 0.0, [0.0], rng.uniform(0.8, 1.0)
    wobble_phase, wobble_hz = rng.uniform(0, 2 * np.pi), rng.uniform(0.08, 0.2)
    while along[-1] < s[-1]:
        ramp = min(1.0, 0.3 + t / 1.0, 0.3 + (s[-1] - along[-1]) / 0.8)
        speed = ramp * pace * (1 + 0.12 * np.sin(2 * np.pi * wobble_hz * t + wobble_phase))
        along.append(along[-1] + speed * _TABLE_STEP_S)
        t += _TABLE_STEP_S
    at = np.minimum(along, s[-1])
    # A body's mass: over a second of averaging no turn takes more than about 4 m/s^2.
    xy = np.stack([np.interp(at, s, path[:, k]) for k in (0, 1)], axis=1)
    return Walk(start_s, _averaged(xy, round(1.0 / _TABLE_STEP_S) + 1), height_m)


def _averaged(xy: FloatArray, width: int) -> FloatArray:
    """Each column of (N, 2) under a Hann window of `width` (odd) rows, the ends held."""
    kernel = np.hanning(width + 2)[1:-1]
    kernel /= kernel.sum()
    padded = np.concatenate([np.repeat(xy[:1], width // 2, 0), xy, np.repeat(xy[-1:], width // 2, 0)])
    return np.stack([np.convolve(padded[:, k], kernel, mode="valid") for k in (0, 1)], axis=1)


def _sees(camera: CameraPlacement, xy_m: FloatArray, z_m: float, margin_px: float) -> NDArray[np.bool_]:
    """Which points (N, 2) at height z_m lie inside the picture with a margin."""
    eye = np.array(camera.eye_m)
    forward = np.array(camera.target_m) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    ray = np.column_stack([xy_m, np.full(len(xy_m), z_m)]) - eye
    depth = ray @ forward
    u = camera.focal_px * (ray @ right) / depth + camera.width_px / 2
    v = camera.focal_px * (ray @ down) / depth + camera.height_px / 2
    inside: NDArray[np.bool_] = (
        (depth > 0.3)
        & (u > margin_px)
        & (u < camera.width_px - margin_px)
        & (v > margin_px)
        & (v < camera.height_px - margin_px)
    )
    return inside


def _floor_in_view(
    camera: CameraPlacement, room: tuple[float, float, float, float], boxes: tuple[Box, ...], head_m: float
) -> FloatArray:
    """Grid points (N, 2) on the free floor where a person's feet and head are both in the picture."""
    x0, y0, x1, y1 = room
    xs, ys = np.arange(x0 + 0.45, x1 - 0.4, 0.1), np.arange(y0 + 0.45, y1 - 0.4, 0.1)
    grid = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    ok = _sees(camera, grid, 0.0, 24.0) & _sees(camera, grid, head_m, 4.0)
    for box in boxes:
        near_x = (grid[:, 0] > box.x0_m - 0.45) & (grid[:, 0] < box.x1_m + 0.45)
        near_y = (grid[:, 1] > box.y0_m - 0.45) & (grid[:, 1] < box.y1_m + 0.45)
        ok &= ~(near_x & near_y)
    return grid[ok]


def _farthest_corners(points: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """A few points of the set, far from one another, in angular order: the corners of a round walk."""
    chosen = [points[rng.integers(len(points))]]
    while len(chosen) < count:
        distance = np.min([np.linalg.norm(points - c, axis=1) for c in chosen], axis=0)
        likely = np.flatnonzero(distance >= 0.8 * distance.max())
        chosen.append(points[rng.choice(likely)])
    corners = np.array(chosen)
    middle = corners.mean(axis=0)
    angle = np.arctan2(corners[:, 1] - middle[1], corners[:, 0] - middle[0])
    return corners[np.argsort(angle)]


def _robot_sweep(points: FloatArray) -> FloatArray:
    """A vacuum's lanes over the floor that the camera sees, 1.2 m apart, from x0 to x1."""
    lanes = []
    for k, x in enumerate(np.arange(points[:, 0].min() + 0.1, points[:, 0].max(), 1.2)):
        lane = points[np.abs(points[:, 0] - x) < 0.06]
        if len(lane) < 2:
            continue
        ends = np.array([[x, lane[:, 1].min()], [x, lane[:, 1].max()]])
        lanes.append(ends if k % 2 == 0 else ends[::-1])
    return np.concatenate(lanes)


def make_home(seed: int, *, walks: int = 12) -> Scenario:
    """A furnished home for `seed`, whose robot drives once and whose person makes `walks` visits.

    The camera is in a corner of the main room; the device near a wall of it or just behind the wall of
    the next room, at least 1.5 m from the hub; people come and go by a door under the camera.
    """
    rng = np.random.default_rng([seed, 0x5AD])
    width, depth = rng.uniform(5.2, 6.2), rng.uniform(4.4, 5.2)
    x0, y0 = rng.uniform(-1.0, -0.4), rng.uniform(-1.0, -0.4)
    room = (x0, y0, x0 + width, y0 + depth)
    plan = (x0, y0, x0 + width + 2.6, y0 + depth)

    def paint(low: int, high: int) -> tuple[int, int, int]:
        r, g, b = rng.integers(low, high, 3)
        return int(r), int(g), int(b)

    boxes = (
        Box(room[2] - 1.3, room[3] - 0.75, room[2] - 0.1, room[3] - 0.05, 0.75, paint(70, 150)),
        Box(
            room[2] - 0.5, room[1] + 0.3, room[2] - 0.05, room[1] + 1.3, rng.uniform(0.5, 1.6), paint(90, 180)
        ),
        Box(
            room[0] + 0.05,
            room[3] - 1.2,
            room[0] + 0.55,
            room[3] - 0.2,
            rng.uniform(0.4, 0.9),
            paint(60, 140),
        ),
    )
    eye = (room[0] + 0.12, room[1] + 0.12, rng.uniform(2.1, 2.4))
    middle = (room[0] + width * rng.uniform(0.5, 0.56), room[1] + depth * rng.uniform(0.5, 0.56), 0.55)
    camera = CameraPlacement(eye, middle, 640, 480, rng.uniform(390, 430))
    anchor = (eye[0] + 0.08, eye[1] + 0.02, eye[2] - 0.1)
    height = rng.uniform(1.62, 1.85)
    floor = _floor_in_view(camera, room, boxes, height)
    device = _place_device(room, anchor, rng)
    path = _robot_sweep(floor)
    mac = "f4:f5:d8:" + ":".join(f"{v:02x}" for v in rng.integers(0, 256, 3))
    first = Scenario(seed, room, plan, boxes, camera, anchor, device, mac, path, 0.35, 3.0, 0.0, ())
    start = first.drive_end_s + 4.0
    door = np.array([[room[0] + 1.2, room[1] - 0.6]])
    visits: list[Walk] = []
    for _ in range(walks):
        corners = _farthest_corners(floor, 5, rng)[:: rng.choice([-1, 1])]
        nearest = int(np.argmin(np.linalg.norm(corners - door, axis=1)))
        loop = np.roll(corners, -nearest, axis=0)
        visit = _smooth_walk(np.concatenate([door, loop, loop[:1], door]), start, rng, height)
        visits.append(visit)
        start = visit.end_s + 4.0
    return Scenario(
        seed,
        room,
        plan,
        boxes,
        camera,
        anchor,
        device,
        mac,
        path,
        0.35,
        3.0,
        visits[0].start_s - 3.0,
        tuple(visits),
    )


def _place_device(
    room: tuple[float, float, float, float], anchor: tuple[float, float, float], rng: np.random.Generator
) -> tuple[float, float, float]:
    """Near a wall of the room, or up to 0.6 m behind the wall to the next room, 0.4-1.4 m high."""
    x0, y0, x1, y1 = room
    while True:
        side = int(rng.integers(4))
        along_x, along_y = rng.uniform(x0 + 0.4, x1 - 0.4), rng.uniform(y0 + 0.4, y1 - 0.4)
        x, y = ((along_x, y1 - 0.25), (x1 - 0.3, along_y), (along_x, y0 + 0.25), (x1 + 0.5, along_y))[side]
        if np.hypot(x - anchor[0], y - anchor[1]) > 1.5:
            return float(x), float(y), float(rng.uniform(0.4, 1.4))
