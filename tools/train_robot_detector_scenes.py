"""Rooms with and without a robot vacuum, for training: drawn by chance, nothing from a photograph."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import train_robot_detector_textures as tex
from train_robot_detector_furniture import add_clutter, add_furniture, add_rugs
from train_robot_detector_render import BALL, render
from train_robot_detector_robot import ROBOT, add_robot, body_colour
from train_robot_detector_scene import CLEAR_M, Scene

WIDTH, HEIGHT = 448, 336
_ROBOT_RADIUS_M = 0.17


@dataclass
class Picture:
    """image: (HEIGHT, WIDTH, 3) uint8 BGR. Of each robot: boxes (N, 4) x0, y0, x1, y1; contacts (N, 2), the
    floor under its middle; visible (N,) share 0..1."""

    image: np.ndarray
    boxes: np.ndarray
    contacts: np.ndarray
    visible: np.ndarray


def room_of(s: Scene, camera_xy: np.ndarray) -> np.ndarray:
    """Walls around the camera and the robot's place, a floor and a ceiling; the first eight materials."""
    rng = s.rng
    gym = rng.random() < 0.12
    reach = rng.uniform(3, 12, 4) if gym else np.abs(rng.normal(0.6, 1.8, 4)) + 0.35
    x0, x1 = min(camera_xy[0], 0) - reach[0], max(camera_xy[0], 0) + reach[1]
    y0, y1 = min(camera_xy[1], 0) - reach[2], max(camera_xy[1], 0) + reach[3]
    height = rng.uniform(4, 8) if gym else rng.uniform(2.75, 3.2)
    walls = [s.texture(tex.wall(rng)) for _ in range(2)]
    floor = tex.court(rng) if gym or rng.random() < 0.04 else tex.FLOORS[rng.integers(len(tex.FLOORS))](rng)
    tint = tex.colour(rng, 0.6, 0.97, 0.15) if rng.random() < 0.5 else np.ones(3)
    for k in range(4):
        plain = rng.random() < 0.5
        s.material(tint * rng.uniform(0.5, 1.0), -1 if plain else walls[k % 2], rng.uniform(1.5, 4.0))
    shiny = rng.random() < (0.85 if gym else 0.55)
    side = rng.uniform(6, 14) if gym else rng.uniform(0.7, 3.2)
    s.material(
        np.ones(3) * rng.uniform(0.6, 1.1),
        s.texture(floor),
        side,
        mirror=rng.uniform(0.1, 0.9) * shiny,
        rough=rng.uniform(0.0, 0.25) ** 1.3,
        gloss=0.05 * shiny,
        shine=60,
    )
    s.material(np.full(3, rng.uniform(0.7, 0.95)))
    s.plain(0.02, 0.95)  # skirting
    s.plain(0.3, 0.95)  # window frames
    skirting = rng.uniform(0.05, 0.14) if rng.random() < 0.7 else 0.0
    for _ in range(int(rng.integers(0, 4))):
        face = int(rng.integers(4))
        low, high = (y0, y1) if face < 2 else (x0, x1)
        wide = rng.uniform(0.6, 2.5)
        u = rng.uniform(low, max(high - wide, low + 0.1))
        v = 0.05 if rng.random() < 0.3 else rng.uniform(0.6, 1.2)
        glow = rng.uniform(1.0, 4.0)
        s.windows.append(
            [face, u, u + wide, v, rng.uniform(1.9, 2.4), glow, rng.integers(1, 4), rng.integers(1, 3)]
        )
    return np.array([x0, x1, y0, y1, 0.0, height, skirting])


def _view(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, float]:
    """Camera position, its rows right, down, forward, and focal length in px; the robot is at the origin."""
    focal = 0.5 * WIDTH / np.tan(np.radians(rng.uniform(36, 95)) / 2)
    wide = np.exp(rng.uniform(np.log(0.045), np.log(0.5))) * WIDTH
    distance = focal * 2 * _ROBOT_RADIUS_M / wide
    low, high = [(4, 14), (12, 30), (25, 50), (45, 75)][rng.choice(4, p=[0.2, 0.4, 0.3, 0.1])]
    up = np.radians(rng.uniform(low, high))
    z = float(np.clip(distance * np.sin(up), 0.1, 2.65))
    flat = np.sqrt(max(distance**2 - z**2, 0.01))
    turn = rng.uniform(0, 2 * np.pi)
    eye = np.array([-flat * np.cos(turn), -flat * np.sin(turn), z])
    forward = np.array([0.0, 0.0, 0.04]) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rows = np.stack([right, np.cross(forward, right), forward])
    # The robot anywhere in the picture: turn the camera away from it.
    margin = 0.35 * wide
    u = rng.uniform(margin, WIDTH - margin) - WIDTH / 2
    v = rng.uniform(0.3 * margin, HEIGHT - 0.6 * margin) - HEIGHT / 2
    roll = np.radians(rng.normal(0, 3) if rng.random() < 0.85 else rng.uniform(-35, 35))
    a, b = -np.arctan2(u, focal), np.arctan2(v, focal)
    yaw = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    pitch = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    tilt = np.array([[np.cos(roll), np.sin(roll), 0], [-np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    return eye, (tilt @ pitch @ yaw).T.T @ rows, focal


def _lights(s: Scene, room: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    rng = s.rng
    lamps = []
    for _ in range(int(rng.integers(1, 3))):
        x, y = rng.uniform(room[0], room[1]), rng.uniform(room[2], room[3])
        wide = rng.uniform(0.1, 1.0)
        lamps.append([x, y, room[5] - 0.1, rng.uniform(1, 8), wide, wide, 0.05])
    for w in s.windows:
        u, v, face = (w[1] + w[2]) / 2, (w[3] + w[4]) / 2, int(w[0])
        place = [room[face] * 0.98, u] if face < 2 else [u, room[face] * 0.98]
        extent = [0.02, w[2] - w[1]] if face < 2 else [w[2] - w[1], 0.02]
        lamps.append([*place, v, rng.uniform(1, 6) * w[5] / 2, *extent, w[4] - w[3]])
    sun = np.zeros(4)
    if s.windows and rng.random() < 0.5:
        face = int(s.windows[0][0])
        out = np.array([[-1, 0], [1, 0], [0, -1], [0, 1]][face], float)
        side = np.array([-out[1], out[0]]) * rng.normal(0, 0.6)
        direction = np.array([*(out + side), rng.uniform(0.2, 0.9)])
        sun = np.array([*(direction / np.linalg.norm(direction)), rng.uniform(1.0, 6.0)])
    return np.array(lamps), sun, rng.uniform(0.1, 0.7)


def _box_of(
    robot: tuple[float, float, float, float, float, bool], eye: np.ndarray, rows: np.ndarray, focal: float
) -> np.ndarray:
    """The box around the projection of a robot, not cut by the picture's edges."""
    x, y, r, h, yaw, d_shape = robot
    a = np.linspace(0, 2 * np.pi, 48)
    ring = np.column_stack([x + r * np.cos(a), y + r * np.sin(a)])
    if d_shape:
        c, n = np.cos(yaw), np.sin(yaw)
        ring = np.vstack([ring, [[x + r * c - e * r * n, y + r * n + e * r * c] for e in (-1, 1)]])
    points = np.vstack([np.column_stack([ring, np.full(len(ring), z)]) for z in (0.005, h)])
    uv = _project(points, eye, rows, focal)
    return np.concatenate([uv.min(0), uv.max(0)])


def _project(points: np.ndarray, eye: np.ndarray, rows: np.ndarray, focal: float) -> np.ndarray:
    """(N, 3) in the room -> (N, 2) pixels."""
    local = (points - eye) @ rows.T
    return local[:, :2] / np.maximum(local[:, 2:], 0.02) * focal + np.array([WIDTH, HEIGHT]) / 2 - 0.5


def picture(seed: int, with_robot: bool, samples: int = 2) -> Picture | None:
    """One training picture; None where the robot is hidden or the camera looks into a piece of furniture."""
    rng = np.random.default_rng(seed)
    s = Scene(rng)
    eye, rows, focal = _view(rng)
    room = room_of(s, eye[:2])
    s.clear = [(0.0, 0.0, 0.19 + CLEAR_M), (eye[0], eye[1], 0.25 if eye[2] < 1.2 else 0.05)]
    s.prims.append([BALL, 0, 0, -50, 1, 0, 0.01, 0.01, 0.01, 0, 0, 0])  # the tables are never empty
    if with_robot:
        add_robot(s, 0.0, 0.0)
        if rng.random() < 0.05:
            angle = rng.uniform(0, 2 * np.pi)
            add_robot(s, 0.9 * np.cos(angle), 0.9 * np.sin(angle))
            s.clear.append((0.9 * np.cos(angle), 0.9 * np.sin(angle), 0.19 + CLEAR_M))
    add_rugs(s)
    for _ in range(int(rng.integers(0, 14))):
        add_furniture(s, room)
    distance = float(np.linalg.norm(eye))
    for _ in range(int(rng.integers(0, 5 if with_robot else 9))):
        near = (0.0, 0.0) if rng.random() < 0.7 else tuple(rng.uniform(room[[0, 2]], room[[1, 3]]))
        add_clutter(s, room, near, 0.35 * distance + 0.2)
    if with_robot and rng.random() < 0.12:  # a leg before it
        toward = np.arctan2(eye[1], eye[0]) + rng.uniform(-0.5, 0.5)
        away = rng.uniform(0.22, 0.5)
        leg = rng.uniform(0.01, 0.04)
        s.round(away * np.cos(toward), away * np.sin(toward), 0.0, leg, leg, 0.8, s.covered())
    if with_robot and rng.random() < 0.08:  # its dock
        toward = np.arctan2(eye[1], eye[0]) + np.pi + rng.uniform(-1.2, 1.2)
        m = s.material(body_colour(rng))
        s.box(0.22 * np.cos(toward), 0.22 * np.sin(toward), 0.0, toward, 0.05, rng.uniform(0.06, 0.15),
              rng.uniform(0.08, 0.4), m)  # fmt: skip
    lamps, sun, ambient = _lights(s, room)
    prims, mats = np.array(s.prims, np.float64), np.array(s.mats, np.float64)
    overlays = np.array(s.overlays, np.float64).reshape(-1, 9)
    windows = np.array(s.windows, np.float64).reshape(-1, 8)
    spheres, textures = s.bounds(), np.array(s.textures, np.float32)

    def shoot(scale: int, count: int) -> tuple[np.ndarray, np.ndarray]:
        camera = np.concatenate([eye, rows.ravel(), [focal / scale, WIDTH / 2 / scale, HEIGHT / 2 / scale]])
        return render(prims, spheres, mats, overlays, windows, textures, room, lamps, sun, ambient, camera,
                      WIDTH // scale, HEIGHT // scale, count, seed)  # fmt: skip

    small, numbers = shoot(4, 1)
    if not np.median(small) > 0.004 or np.mean(small.std((0, 1))) < 0.01:
        return None
    boxes, contacts, visible = [], [], []
    for k, robot in enumerate(s.robots):
        box = _box_of(robot, eye, rows, focal)
        seen = np.clip(box, 0, [WIDTH - 1, HEIGHT - 1] * 2)
        full = 0.72 * np.prod(seen[2:] - seen[:2])
        share = float((numbers == ROBOT + k).sum() * 16 / max(full, 1.0))
        boxes.append(seen)
        contacts.append(_project(np.array([[robot[0], robot[1], 0.0]]), eye, rows, focal)[0])
        visible.append(min(share, 1.0))
    if s.robots and visible[0] < 0.3:
        return None
    linear, _ = shoot(1, samples)
    level = np.percentile(linear.mean(2), rng.uniform(40, 90))
    exposed = linear * (rng.uniform(0.2, 0.75) / max(level, 1e-4)) * rng.uniform(0.88, 1.14, 3)
    encoded = np.clip(exposed, 0, 1) ** (1 / 2.2) * 255
    bgr = encoded[:, :, ::-1].round().astype(np.uint8)
    return Picture(
        np.ascontiguousarray(bgr),
        np.array(boxes).reshape(-1, 4),
        np.array(contacts).reshape(-1, 2),
        np.array(visible),
    )
