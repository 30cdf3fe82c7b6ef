"""The still picture of a simulated room: one ray for each quarter of a pixel, walls, floor and furniture."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vad.geometry import FloatArray
from vad.sim.render_shapes import Image, View
from vad.sim.scenario import Box, Scenario

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

CEILING_M = 2.6
_OVERSAMPLE = 2
_SKIRTING_M = 0.09
_PLANK_M = (1.25, 0.145)
_FAR = np.float32(1e9)
_NOISE_ROW = 512


@dataclass(frozen=True, slots=True)
class RoomPicture:
    """image: (H, W, 3) BGR; covers: for each box of the scenario its coverage 0..1, (H, W)."""

    image: Image
    covers: tuple[Floats, ...]


def draw_room(scenario: Scenario, view: View, rng: np.random.Generator) -> RoomPicture:
    """The room without robot and people, from the scenario's camera."""
    k = view.intrinsics
    width, height = k.width_px * _OVERSAMPLE, k.height_px * _OVERSAMPLE
    u, v = np.meshgrid(
        (np.arange(width, dtype=np.float32) + 0.5) / _OVERSAMPLE,
        (np.arange(height, dtype=np.float32) + 0.5) / _OVERSAMPLE,
    )
    rays = np.stack([(u - k.cx_px) / k.fx_px, (v - k.cy_px) / k.fy_px, np.ones_like(u)], axis=-1)
    rays = np.asarray(rays @ view.camera_from_map.rotation, dtype=np.float32)
    eye = np.array(scenario.camera.eye_m, np.float32)
    colours, reach = _shell(scenario, rays, eye, rng)
    covers: list[Floats] = []
    for box in scenario.boxes:
        distance, face = _hit_box(box, rays, eye)
        mask = distance < reach
        points = np.asarray(eye + rays[mask] * distance[mask, None], dtype=np.float32)
        colours[mask] = _furniture(box, points, face[mask])
        reach[mask] = distance[mask]
        for cover in covers:
            cover[mask] = 0.0
        covers.append(mask.astype(np.float32))
    size = (k.width_px, k.height_px)
    small = cv2.resize(colours, size, interpolation=cv2.INTER_AREA)
    off_axis = (rays[::2, ::2] * rays[::2, ::2]).sum(-1, keepdims=True) - 1.0
    small = small / (1.0 + 0.28 * off_axis)  # the lens loses light towards the corners
    image = np.clip(cv2.GaussianBlur(small, (0, 0), 0.6), 0, 255)[:, :, ::-1]
    return RoomPicture(
        np.ascontiguousarray(image.astype(np.uint8)),
        tuple(
            np.asarray(cv2.resize(cover, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
            for cover in covers
        ),
    )


def _shell(scenario: Scenario, rays: Floats, eye: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Floor, ceiling and walls: colours (H, W, 3) RGB, and how far along each ray they are, (H, W)."""
    x0, y0, x1, y1 = scenario.room_m
    with np.errstate(divide="ignore", invalid="ignore"):
        to_z = np.where(rays[..., 2] < 0, -eye[2], CEILING_M - eye[2]) / rays[..., 2]
        to_x = (np.where(rays[..., 0] > 0, x1, x0) - eye[0]) / rays[..., 0]
        to_y = (np.where(rays[..., 1] > 0, y1, y0) - eye[1]) / rays[..., 1]
    to_x, to_y, to_z = (a.astype(np.float32) for a in (to_x, to_y, to_z))
    reach = np.minimum(np.minimum(to_x, to_y), to_z)
    points = eye + rays * reach[..., None]
    texture = rng.random((256, 256)).astype(np.float32)
    colours = np.empty_like(points)
    flat, on_x = to_z <= reach, to_x <= reach
    floor = flat & (rays[..., 2] < 0)
    colours[flat & ~floor] = (232, 230, 224)
    colours[floor] = _floor(scenario, points[floor], texture, rng)
    paint = np.array([rng.uniform(185, 225), rng.uniform(185, 215), rng.uniform(170, 205)])
    corner = 1.0 - 0.22 * np.exp(-np.hypot(points[..., 0] - x1, points[..., 1] - y1) / 0.25)
    # A wall is seen as (metres along it, metres up). The near two, beside the camera, are plain.
    for across_x, wall in ((True, on_x & ~flat), (False, ~on_x & ~flat)):
        along, ray = (1, rays[..., 0]) if across_x else (0, rays[..., 1])
        q = np.stack([points[..., along], points[..., 2]], axis=-1)
        shade = paint * (0.88 if across_x else 1.0)
        far, near = wall & (ray > 0), wall & (ray <= 0)
        colours[near] = _wall(q[near], shade, texture, corner[near])
        if across_x:
            colours[far] = _window_wall(q[far], (y0, y1), shade, texture, corner[far])
        else:
            colours[far] = _door_wall(q[far], (x0, x1), shade, texture, corner[far], rng)
    return colours, reach


def _noise(texture: Floats, x: Floats, y: Floats) -> Floats:
    """Smooth noise in 0..1 with cells of one unit, sampled at (N,) places."""
    # In rows, for cv2.remap is slow on a column.
    n, count = len(texture), len(x)
    padded = np.zeros((2, -(-count // _NOISE_ROW) * _NOISE_ROW), np.float32)
    padded[0, :count], padded[1, :count] = np.mod(x, n), np.mod(y, n)
    if not count:
        return np.zeros(0, np.float32)
    map_x, map_y = padded.reshape(2, -1, _NOISE_ROW)
    smooth = cv2.remap(texture, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return np.asarray(smooth.ravel()[:count], dtype=np.float32)


def _floor(scenario: Scenario, p: Floats, texture: Floats, rng: np.random.Generator) -> Floats:
    """Wooden planks, a rug, light from the window, dark edges along walls and furniture. p: (N, 3)."""
    x, y = p[:, 0], p[:, 1]
    wood = np.array([rng.uniform(140, 178), rng.uniform(104, 132), rng.uniform(70, 98)], np.float32)
    row = np.floor(y / _PLANK_M[1])
    shifted = x + 0.47 * _PLANK_M[0] * row
    column = np.floor(shifted / _PLANK_M[0])
    tone = texture[(row * 7 + column * 13).astype(int) % 256, (row * 31 + column).astype(int) % 256]
    grain = _noise(texture, x * 4.0, y * 90.0) * 0.6 + _noise(texture, x * 14.0, y * 30.0) * 0.4
    seam = np.minimum(np.mod(y, _PLANK_M[1]), np.mod(shifted, _PLANK_M[0])) < 0.005
    shade = (0.84 + 0.2 * tone + 0.16 * (grain - 0.5)) * np.where(seam, 0.72, 1.0)
    colour = wood * shade[:, None].astype(np.float32)
    rx0, ry0, rx1, ry1 = scenario.room_m
    middle = np.array([rx0 + 0.55 * (rx1 - rx0), ry0 + 0.6 * (ry1 - ry0)]) + rng.uniform(-0.3, 0.3, 2)
    inside = np.minimum(0.9 - np.abs(x - middle[0]), 0.65 - np.abs(y - middle[1]))
    rug = np.array(rng.uniform(90, 170, 3), np.float32)
    border = ((inside > 0.08) & (inside < 0.14))[:, None]
    weave = (0.9 + 0.2 * _noise(texture, x * 70.0, y * 70.0))[:, None]
    colour = np.where((inside > 0)[:, None], np.where(border, rug * 0.6, rug) * weave, colour)
    light = 0.74 + 0.36 * np.exp(-((x - rx1 + 1.6) ** 2 + (y - ry1 + 2.2) ** 2) / 5.0)
    light *= 1.0 - 0.3 * np.exp(-np.minimum(rx1 - x, ry1 - y) / 0.18)
    for box in scenario.boxes:
        gap = np.hypot(
            np.maximum(np.maximum(box.x0_m - x, x - box.x1_m), 0),
            np.maximum(np.maximum(box.y0_m - y, y - box.y1_m), 0),
        )
        light *= 1.0 - 0.4 * np.exp(-gap / 0.14)
    return np.asarray(colour * light[:, None], np.float32)


def _wall(q: Floats, paint: FloatArray, texture: Floats, corner: Floats) -> Floats:
    """Plain paint with a skirting board; q: (N, 2) metres along and up."""
    mottle = 0.97 + 0.06 * _noise(texture, q[:, 0] * 6, q[:, 1] * 6)
    shade = mottle * corner * (0.86 + 0.14 * q[:, 1] / CEILING_M)
    colour = paint * shade[:, None]
    skirting = q[:, 1] < _SKIRTING_M
    colour[skirting] = np.array([214, 210, 202]) * corner[skirting, None]
    colour[np.abs(q[:, 1] - _SKIRTING_M) < 0.008] *= 0.75
    return colour.astype(np.float32)


def _panel(q: Floats, left: float, right: float, low: float, high: float) -> FloatArray:
    """How far inside a rectangle of the wall each point is, metres; negative outside. (N,)."""
    sides = np.minimum(q[:, 0] - left, right - q[:, 0])
    inside = np.minimum(sides, np.minimum(q[:, 1] - low, high - q[:, 1]))
    return np.asarray(inside, dtype=np.float64)


def _window_wall(
    q: Floats, span: tuple[float, float], paint: FloatArray, texture: Floats, corner: Floats
) -> Floats:
    colour = _wall(q, paint, texture, corner)
    middle = span[0] + 0.55 * (span[1] - span[0])
    inside = _panel(q, middle - 0.75, middle + 0.75, 0.95, 2.15)
    colour[inside > -0.06] = (226, 226, 222)
    sky = 200 + 40 * _noise(texture, q[:, 0] * 1.5, q[:, 1] * 2.5)
    panes = (inside > 0.03) & (np.abs(q[:, 0] - middle) > 0.03)
    colour[panes] = np.stack([sky * 0.95, sky, np.minimum(sky * 1.06, 255)], axis=1)[panes]
    sill = (np.abs(q[:, 0] - middle) < 0.85) & (np.abs(q[:, 1] - 0.88) < 0.025)
    colour[sill] = (205, 203, 198)
    radiator = _panel(q, middle - 0.55, middle + 0.55, 0.15, 0.72)
    ribs = 0.9 + 0.1 * np.sign(np.sin(q[:, 0] * 2 * np.pi / 0.07))
    colour[radiator > 0] = (np.array([218, 217, 212]) * ribs[:, None])[radiator > 0]
    return colour


def _door_wall(
    q: Floats,
    span: tuple[float, float],
    paint: FloatArray,
    texture: Floats,
    corner: Floats,
    rng: np.random.Generator,
) -> Floats:
    colour = _wall(q, paint, texture, corner)
    left = span[0] + 0.42 * (span[1] - span[0])
    door = _panel(q, left, left + 0.88, -1.0, 2.03)
    colour[door > -0.07] = (222, 218, 208)
    leaf = np.array([176, 140, 102]) * (0.9 + 0.2 * _noise(texture, q[:, 0] * 40, q[:, 1] * 2))[:, None]
    colour[door > 0] = leaf[door > 0]
    colour[(door > 0) & (door < 0.012)] *= 0.5
    for low, high in ((0.2, 0.9), (1.05, 1.9)):
        field = _panel(q, left + 0.14, left + 0.74, low, high)
        colour[np.abs(field) < 0.012] *= 0.72
    handle = np.hypot(q[:, 0] - left - 0.08, q[:, 1] - 1.02) < 0.035
    colour[handle] = (90, 88, 84)
    for centre, half in ((left - 0.95, 0.3), (left + 1.75, 0.24)):
        picture = _panel(q, centre - half, centre + half, 1.35, 1.35 + 1.5 * half)
        inner = q[picture > 0]
        scene = np.stack(
            [_noise(texture, inner[:, 0] * 5 + k * 9, inner[:, 1] * 5) for k in range(3)], axis=1
        )
        tint = rng.uniform(90, 200, 3)
        colour[picture > -0.03] = (52, 44, 38)
        colour[picture > 0] = tint * (0.55 + 0.7 * scene)
    return colour


def _hit_box(box: Box, rays: Floats, eye: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """How far each ray goes to the box, (H, W), huge where it misses; and through which axis's face."""
    low = np.array([box.x0_m, box.y0_m, 0.0], np.float32)
    high = np.array([box.x1_m, box.y1_m, box.height_m], np.float32)
    # Axis by axis: reductions over a last axis of three are several times slower.
    enter, leave = [], []
    for axis in range(3):
        ray = rays[..., axis]
        safe = np.where(np.abs(ray) < 1e-9, np.float32(1e-9), ray)
        a, b = (low[axis] - eye[axis]) / safe, (high[axis] - eye[axis]) / safe
        enter.append(np.minimum(a, b))
        leave.append(np.maximum(a, b))
    x, y, z = enter
    distance = np.maximum(np.maximum(x, y), z)
    hit = (distance > 0) & (distance < np.minimum(np.minimum(leave[0], leave[1]), leave[2]))
    face = np.where((x >= y) & (x >= z), 0, np.where(y >= z, 1, 2))
    return np.where(hit, distance, _FAR).astype(np.float32), face


def _furniture(box: Box, p: Floats, face: NDArray[np.int64]) -> Floats:
    """A cupboard: a lighter top, fronts with drawers and handles, darker towards the floor. p: (N, 3)."""
    rgb = np.array(box.rgb, np.float64)
    shade = np.select([face == 2, face == 0], [1.18, 0.86], 0.7) * np.where(
        face == 2, 1.0, 0.8 + 0.2 * p[:, 2] / box.height_m
    )
    along = np.where(face == 0, p[:, 1] - box.y0_m, p[:, 0] - box.x0_m)
    span = np.where(face == 0, box.y1_m - box.y0_m, box.x1_m - box.x0_m)
    drawers = max(1, round(box.height_m / 0.35))
    up = np.mod(p[:, 2] / box.height_m * drawers, 1.0)
    edge = (np.minimum(up, 1 - up) * box.height_m / drawers < 0.012) | (
        np.minimum(along, span - along) < 0.015
    )
    grip = (np.abs(along - span / 2) < 0.07) & (np.abs(up - 0.75) * box.height_m / drawers < 0.014)
    shade = shade * np.where((face != 2) & edge, 0.6, 1.0) * np.where((face != 2) & grip, 0.45, 1.0)
    return np.asarray(rgb * shade[:, None], np.float32)
