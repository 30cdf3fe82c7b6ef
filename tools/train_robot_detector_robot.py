"""Robot vacuums as they are sold, drawn: what their tops and sides look like. Shapes, never photographs."""

from __future__ import annotations

import cv2
import numpy as np
from train_robot_detector_scene import Scene
from train_robot_detector_textures import SIDE_PX, Texture, colour, letters, noise

ROBOT = 1.0
"""Number of the first robot's object."""


def _grey(rng: np.random.Generator, low: float, high: float) -> np.ndarray:
    return np.clip(rng.uniform(low, high) * (1.0 + rng.uniform(-0.12, 0.12, 3)), 0.004, 0.95)


def body_colour(rng: np.random.Generator) -> np.ndarray:
    """Black half the time, else white, silver, champagne or a colour; linear RGB."""
    pick = rng.random()
    if pick < 0.52:
        return _grey(rng, 0.008, 0.06)
    if pick < 0.72:
        return _grey(rng, 0.6, 0.92)
    if pick < 0.86:
        return _grey(rng, 0.1, 0.5)
    if pick < 0.94:
        return np.clip(rng.uniform(0.2, 0.6) * np.array([1.0, 0.8, 0.6]) * rng.uniform(0.9, 1.1, 3), 0, 0.95)
    return np.clip(rng.uniform(0.1, 0.9) * rng.dirichlet(np.ones(3)) * 1.5, 0.01, 0.95)


def top(rng: np.random.Generator, body: np.ndarray, yaw: float) -> Texture:
    """The lid from above: rings, a middle panel, buttons, a lamp, a handle, lettering."""
    image = np.ones((SIDE_PX, SIDE_PX, 3), np.float32) * body
    dark = body.mean() < 0.15
    half = SIDE_PX / 2

    def other() -> list[float]:
        pick = rng.random()
        if pick < 0.4:
            return _grey(rng, 0.008, 0.08).tolist()
        if pick < 0.75:
            return (
                (body * (rng.uniform(1.3, 5.0) if dark else rng.uniform(0.4, 0.9)) + 0.005)
                .clip(0, 0.95)
                .tolist()
            )
        if pick < 0.92:
            return _grey(rng, 0.2, 0.8).tolist()
        return body_colour(rng).tolist()

    def circle(radius: float, paint: list[float], wide: float = -1, at: tuple[float, float] = (0, 0)) -> None:
        centre = (int(half + at[0] * half), int(half + at[1] * half))
        thick = -1 if wide < 0 else max(1, int(wide * half))
        cv2.circle(image, centre, max(1, int(radius * half)), paint, thick, cv2.LINE_AA)

    # Rim, ring and disc: the strongest mark of the family.
    if rng.random() < 0.75:
        circle(rng.uniform(0.8, 0.96), other(), rng.uniform(0.02, 0.2))
    if rng.random() < 0.5:
        circle(rng.uniform(0.55, 0.88), other())
    if rng.random() < 0.4:
        circle(rng.uniform(0.3, 0.8), other(), rng.uniform(0.01, 0.06))
    if rng.random() < 0.45:
        circle(rng.uniform(0.12, 0.4), other())
    pick = rng.random()
    if pick < 0.45:  # a panel or a handle across
        length, wide = rng.uniform(0.25, 0.85), rng.uniform(0.08, 0.35)
        at = (rng.uniform(-0.4, 0.4), rng.uniform(-0.2, 0.2))
        box = ((half + at[0] * half, half + at[1] * half), (wide * SIDE_PX, length * SIDE_PX), 0.0)
        if rng.random() < 0.5:
            cv2.ellipse(image, box, other(), -1, cv2.LINE_AA)
        else:
            cv2.fillPoly(image, [cv2.boxPoints(box).astype(np.int32)], other(), cv2.LINE_AA)
    elif pick < 0.65:  # a lid with a straight edge
        x = rng.uniform(-0.5, 0.5)
        cv2.rectangle(image, (0, 0), (int(half + x * half), SIDE_PX), other(), -1)
    for _ in range(int(rng.integers(0, 5))):  # buttons
        at = (rng.uniform(-0.6, 0.6), rng.uniform(-0.35, 0.35))
        circle(rng.uniform(0.02, 0.1), other(), at=at)
    if rng.random() < 0.35:  # the lit button
        glow = [[0.1, 0.9, 0.2], [0.9, 0.9, 0.9], [0.1, 0.4, 0.9], [0.9, 0.4, 0.1]][rng.integers(4)]
        at = (0.0, 0.0) if rng.random() < 0.6 else (rng.uniform(-0.6, 0.6), rng.uniform(-0.1, 0.1))
        circle(rng.uniform(0.04, 0.15), glow, at=at)
        if rng.random() < 0.5:
            circle(rng.uniform(0.12, 0.2), other(), 0.02, at)
    if rng.random() < 0.3:
        text = "".join(chr(c) for c in rng.integers(97, 123, int(rng.integers(3, 9))))
        start = [int(half + rng.uniform(-0.6, 0.0) * half), int(half + rng.uniform(-0.5, 0.5) * half)]
        letters(image, text, start, rng.uniform(0.6, 1.8), other(), int(rng.integers(2, 5)))
    if rng.random() < 0.5:
        circle(rng.uniform(0.95, 0.99), other(), rng.uniform(0.005, 0.03))
    turn = cv2.getRotationMatrix2D((half - 0.5, half - 0.5), float(np.degrees(yaw)), 1.0)
    image = cv2.warpAffine(image, turn, (SIDE_PX, SIDE_PX), borderMode=cv2.BORDER_REPLICATE)
    return np.clip(image * np.exp(0.02 * noise(rng, (8, 128)))[:, :, None], 0.003, 0.98).astype(np.float32)


def add_robot(s: Scene, x: float, y: float) -> None:
    """A robot with its middle at (x, y)."""
    rng = s.rng
    first = len(s.prims)
    r, h, yaw = rng.uniform(0.155, 0.185), rng.uniform(0.068, 0.11), rng.uniform(0, 2 * np.pi)
    body = body_colour(rng)
    coat = {"mirror": rng.uniform(0.0, 0.7) * (rng.random() < 0.75), "rough": rng.uniform(0.0, 0.35),
            "gloss": rng.uniform(0, 0.5), "shine": rng.uniform(5, 150)}  # fmt: skip
    bumper = body if rng.random() < 0.4 else body_colour(rng) * (1.0 if rng.random() < 0.5 else 0.4)
    lid = s.material(np.ones(3), s.texture(top(rng, body, yaw)), cap=True, **coat)
    edge = s.material(body if rng.random() < 0.6 else body_colour(rng), **coat)
    side, dark = s.material(bumper, **coat), s.material(np.full(3, rng.uniform(0.005, 0.03)))
    gap, chamfer, inset = rng.uniform(0.006, 0.02), rng.uniform(0.004, 0.03), rng.uniform(0.004, 0.03)
    d_shape = rng.random() < 0.1
    split = gap + rng.uniform(0.35, 0.9) * (h - gap - chamfer)
    s.round(x, y, 0.003, 0.85 * r, 0.95 * r, gap, dark)
    s.round(x, y, gap, r - rng.uniform(0, 0.012), r, 0.012, side)
    s.round(x, y, gap + 0.012, r, r, max(split - gap - 0.012, 0.004), side)
    s.round(
        x, y, split, r - rng.uniform(0.0005, 0.005), r - 0.0005, 0.004, dark if rng.random() < 0.6 else edge
    )
    s.round(x, y, split + 0.004, r, r, max(h - chamfer - split - 0.004, 0.002), edge)
    s.round(x, y, h - chamfer, r, r - inset, chamfer, edge, lid)
    if d_shape:
        c, n = np.cos(yaw), np.sin(yaw)
        s.box(x + 0.5 * r * c, y + 0.5 * r * n, gap, yaw, 0.5 * r, r, h - gap, side, lid)
        s.prims[-1][10] = lid if rng.random() < 0.3 else edge
    kind = rng.random()
    if kind < 0.5:  # the lidar's tower
        off, tower = rng.uniform(0.0, 0.55) * r, rng.uniform(0.035, 0.065)
        tx, ty, high = x - off * np.cos(yaw), y - off * np.sin(yaw), rng.uniform(0.012, 0.035)
        m = s.material(body_colour(rng) if rng.random() < 0.5 else body, **coat)
        s.round(tx, ty, h, 0.85 * tower, 0.85 * tower, 0.5 * high, dark)
        s.round(tx, ty, h + 0.5 * high, tower, 0.95 * tower, 0.5 * high, m)
    elif kind < 0.75:  # a camera's or a sensor's bump at the rim, a handle
        off = rng.uniform(0.6, 0.95) * r
        bx, by = x + off * np.cos(yaw), y + off * np.sin(yaw)
        s.ball(
            bx, by, h, yaw, rng.uniform(0.01, 0.03), rng.uniform(0.015, 0.04), rng.uniform(0.008, 0.025), dark
        )
    if rng.random() < 0.3:  # a window for the sensors in the bumper
        for k in range(int(rng.integers(1, 4))):
            a = yaw + rng.uniform(-0.8, 0.8) + 0.1 * k
            px, py = x + (r - 0.002) * np.cos(a), y + (r - 0.002) * np.sin(a)
            size = (0.006, rng.uniform(0.01, 0.05), rng.uniform(0.005, 0.015))
            s.ball(px, py, gap + 0.5 * (split - gap), a, *size, dark)
    if rng.random() < 0.25:  # a side brush
        a = yaw + rng.uniform(0.4, 1.2)
        bx, by = x + r * np.cos(a), y + r * np.sin(a)
        m = s.material(colour(rng, 0.2, 0.9))
        for k in range(3):
            b = a + 2.1 * k
            s.box(bx + 0.04 * np.cos(b), by + 0.04 * np.sin(b), 0.003, b, 0.045, 0.004, 0.004, m)
    for p in s.prims[first:]:
        p[11] = ROBOT + len(s.robots)
    s.robots.append((x, y, r, h, yaw, d_shape))
