"""What the camera sees, with the floor plan drawn into it: whether the calibration is right, at a glance."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from vad.geometry import FloatArray, project
from vad.mapping.camera_calibration import CameraCalibration

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]

# BGR.
_GRID: Colour = (235, 235, 235)
_WALL: Colour = (60, 60, 235)
_PATH: Colour = (80, 220, 90)
_RESIDUAL: Colour = (0, 200, 255)
_INK: Colour = (255, 255, 255)

_REACH_M = 9.0
_STEP_M = 0.05
_NEAR_M = 0.2
_ERROR_CELL_PX = 8
_ERROR_WORST_M = 0.15
_ERROR_SHARE = 0.22
# Walls stand in the way of the floor behind them, by direction from the camera. What is nearer than this is
# the wall that the camera hangs on.
_DIRECTIONS = 1440
_OWN_WALL_M = 0.5
_WALL_DEPTH_M = 0.12
_LETTERS_AT_PX = 640
# The lower share of the picture that belongs to the legend.
_FOOT = 0.1


def draw_overlay(
    image: Image,
    calibration: CameraCalibration,
    *,
    walls_m: FloatArray | None = None,
    path_m: FloatArray | None = None,
    found_px: FloatArray | None = None,
    robot_m: FloatArray | None = None,
    errors: bool = False,
    lines: Sequence[str] = (),
) -> Image:
    """A copy of the picture with the map's metre grid and what else is given.

    Args:
        image: (H, W, 3) BGR, raw. calibration: one with a place. walls_m: (N, 2) centres of occupied cells;
            what lies behind them, seen from the camera, is not drawn.
        path_m: (M, 2) the robot's path. found_px, robot_m: (K, 2) where the robot was found, raw pixels, and
            where it says it was: a line from one to the other. errors: shade the floor by its uncertainty,
            green 0 to red 15 cm. lines: written into the picture's foot, above what the colours mean.

    Raises:
        ValueError: the calibration has no place.
    """
    if calibration.camera_from_map is None or calibration.intrinsics is None:
        raise ValueError("the camera is not calibrated")
    drawn = np.array(image, copy=True)
    shown = _Shown(calibration, walls_m)
    legend: list[tuple[str, Colour]] = []
    if errors:
        _shade_errors(drawn, calibration, shown)
        legend.append(("floor: green exact, red 15 cm", _INK))
    _draw_grid(drawn, calibration, shown)
    if walls_m is not None:
        seen = shown.of(walls_m)
        for px in _visible(_pixels(walls_m[seen], calibration), drawn):
            cv2.circle(drawn, px, 2, _WALL, -1, cv2.LINE_AA)
        legend.append(("walls of the plan", _WALL))
    if path_m is not None:
        _draw_line(drawn, _pixels(path_m, calibration), _PATH, 2)
        legend.append(("robot's path", _PATH))
    if found_px is not None and robot_m is not None:
        said = _pixels(robot_m, calibration)
        for there, here in zip(said, found_px, strict=True):
            if np.isfinite(there).all():
                cv2.line(drawn, _whole(there), _whole(here), _RESIDUAL, 1, cv2.LINE_AA)
                cv2.circle(drawn, _whole(here), 2, _RESIDUAL, -1, cv2.LINE_AA)
        legend.append(("seen by the camera", _RESIDUAL))
    _write(drawn, lines, legend)
    return drawn


class _Shown:
    """Which floor points no wall of the plan hides from the camera."""

    def __init__(self, calibration: CameraCalibration, walls_m: FloatArray | None) -> None:
        assert calibration.position_m is not None
        self._eye_m = calibration.position_m[:2]
        # How far the nearest wall is, for each direction.
        self._wall_m = np.full(_DIRECTIONS, np.inf)
        if walls_m is None or not len(walls_m):
            return
        away = walls_m - self._eye_m
        distance = np.linalg.norm(away, axis=1)
        middle = np.arctan2(away[:, 1], away[:, 0])
        half = np.arcsin(np.clip(_STEP_M / np.maximum(distance, _STEP_M), 0.0, 1.0))
        for angle, wide, far in zip(middle, half, distance, strict=True):
            if far > _OWN_WALL_M:
                first, last = (
                    int(np.floor(a / (2 * np.pi) * _DIRECTIONS)) for a in (angle - wide, angle + wide)
                )
                bins = np.arange(first, last + 1) % _DIRECTIONS
                self._wall_m[bins] = np.minimum(self._wall_m[bins], far)

    def of(self, xy_m: FloatArray) -> NDArray[np.bool_]:
        """For points (N, 2); a wall's own foot is shown. False for NaN."""
        away = xy_m - self._eye_m
        angle = np.nan_to_num(np.arctan2(away[:, 1], away[:, 0]))
        bins = np.floor(angle / (2 * np.pi) * _DIRECTIONS).astype(int) % _DIRECTIONS
        near = np.linalg.norm(away, axis=1) < self._wall_m[bins] + _WALL_DEPTH_M
        return np.asarray(near, dtype=np.bool_)


def _pixels(xy_m: FloatArray, calibration: CameraCalibration) -> FloatArray:
    """Floor points (N, 2) as raw pixels; NaN behind the camera, and where the lens model folds over."""
    assert calibration.camera_from_map is not None
    assert calibration.intrinsics is not None
    lens = calibration.intrinsics
    floor = np.column_stack([xy_m, np.zeros(len(xy_m))])
    camera = calibration.camera_from_map.apply(floor)
    depth = np.where(camera[:, 2] > _NEAR_M, camera[:, 2], np.nan)
    r2 = np.sum((camera[:, :2] / depth[:, None]) ** 2, axis=1)
    folds = ~(1.0 + 3.0 * lens.k1 * r2 + 5.0 * lens.k2 * r2 * r2 > 0.2)
    px = project(floor, lens, calibration.camera_from_map)
    return np.where((folds | np.isnan(depth))[:, None], np.nan, px)


def _draw_grid(image: Image, calibration: CameraCalibration, shown: _Shown) -> None:
    """A line for every half metre, a stronger one for every metre, with its number."""
    position = calibration.position_m
    assert position is not None
    x0, y0 = np.floor(position[:2] - _REACH_M)
    ends = np.arange(0.0, 2 * _REACH_M + _STEP_M, _STEP_M)
    for k in range(int(4 * _REACH_M) + 1):
        whole = k % 2 == 0
        for along_x in (True, False):
            fixed = np.full(len(ends), (y0 if along_x else x0) + 0.5 * k)
            moving = (x0 if along_x else y0) + ends
            xy = np.column_stack([moving, fixed] if along_x else [fixed, moving])
            near = (np.linalg.norm(xy - position[:2], axis=1) < _REACH_M) & shown.of(xy)
            px = np.where(near[:, None], _pixels(xy, calibration), np.nan)
            _draw_line(image, px, _GRID, 1, 0.65 if whole else 0.25)
    metres = np.stack(np.meshgrid(x0 + np.arange(2 * _REACH_M), y0 + np.arange(2 * _REACH_M)), axis=-1)
    crossings = metres.reshape(-1, 2)
    near = np.linalg.norm(crossings - position[:2], axis=1) < 0.7 * _REACH_M
    crossings = crossings[near & shown.of(crossings)]
    for (x, y), px in zip(crossings.tolist(), _pixels(crossings, calibration), strict=True):
        if _inside(px, image) and px[1] < (1.0 - _FOOT) * image.shape[0]:
            _text(image, f"({x:g}, {y:g})", (int(px[0]) + 3, int(px[1]) - 3), 0.36)


def _draw_line(image: Image, px: FloatArray, colour: Colour, width: int, share: float = 1.0) -> None:
    """A line through points (N, 2), interrupted at NaN and outside the picture."""
    layer = image if share >= 1.0 else image.copy()
    height, columns = image.shape[:2]
    margin = 200.0
    low, high = np.array([-margin, -margin]), np.array([columns + margin, height + margin])
    # Comparisons with NaN are false.
    good = np.asarray(((px > low) & (px < high)).all(axis=1), dtype=np.bool_)
    for run in np.split(np.arange(len(px)), np.flatnonzero(np.diff(good.astype(int))) + 1):
        if len(run) > 1 and good[run[0]]:
            corners = np.round(px[run] * 16.0).astype(np.int32).reshape(-1, 1, 2)
            cv2.polylines(layer, [corners], False, colour, width, cv2.LINE_AA, 4)
    if layer is not image:
        image[:] = cv2.addWeighted(layer, share, image, 1.0 - share, 0.0)


def _shade_errors(image: Image, calibration: CameraCalibration, shown: _Shown) -> None:
    """Colour the floor by the standard deviation of a floor point there, the calibration's own alone."""
    height, width = image.shape[:2]
    rows, columns = height // _ERROR_CELL_PX, width // _ERROR_CELL_PX
    u, v = np.meshgrid((np.arange(columns) + 0.5) * _ERROR_CELL_PX, (np.arange(rows) + 0.5) * _ERROR_CELL_PX)
    xy, covariance = calibration.floor_point(np.column_stack([u.ravel(), v.ravel()]), 0.0)
    sigma_m = np.sqrt(np.trace(covariance, axis1=1, axis2=2)).reshape(rows, columns)
    assert calibration.position_m is not None
    far = np.linalg.norm(xy - calibration.position_m[:2], axis=1).reshape(rows, columns) > _REACH_M
    floor = np.isfinite(sigma_m) & ~far & shown.of(xy).reshape(rows, columns)
    level = np.clip(np.where(floor, sigma_m, 0.0) / _ERROR_WORST_M, 0.0, 1.0)
    hue = np.round(60.0 * (1.0 - level)).astype(np.uint8)
    full = np.full_like(hue, 255)
    colour = cv2.cvtColor(np.stack([hue, full, full], axis=-1), cv2.COLOR_HSV2BGR)
    size = (width, height)
    tint = cv2.resize(colour, size, interpolation=cv2.INTER_LINEAR).astype(np.float64)
    share = _ERROR_SHARE * cv2.resize(floor.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    image[:] = np.clip(image + share[:, :, None] * (tint - image), 0, 255).astype(np.uint8)


def _visible(px: FloatArray, image: Image) -> list[tuple[int, int]]:
    return [_whole(p) for p in px if _inside(p, image)]


def _inside(px: FloatArray, image: Image) -> bool:
    height, width = image.shape[:2]
    return bool(np.isfinite(px).all() and 0 <= px[0] < width and 0 <= px[1] < height)


def _whole(px: FloatArray) -> tuple[int, int]:
    return int(np.clip(round(float(px[0])), -10_000, 10_000)), int(
        np.clip(round(float(px[1])), -10_000, 10_000)
    )


def _write(image: Image, lines: Sequence[str], legend: Sequence[tuple[str, Colour]]) -> None:
    """Lines into the lower left corner, and below them what each colour is."""
    scale = max(1.0, image.shape[1] / _LETTERS_AT_PX)
    y, x = image.shape[0] - round(8 * scale), round(8 * scale)
    for text, colour in legend:
        x += _text(image, text, (x, y), 0.4, colour) + round(12 * scale)
    for line in reversed(lines):
        y -= round(20 * scale)
        _text(image, line, (round(8 * scale), y), 0.45)


def _text(image: Image, text: str, at: tuple[int, int], size: float, colour: Colour = _INK) -> int:
    """Write on darkened ground, the larger the picture; returns the width, pixels."""
    size *= max(1.0, image.shape[1] / _LETTERS_AT_PX)
    # OpenCV's own letters are ASCII.
    plain = text.encode("ascii", "replace").decode("ascii")
    (width, height), below = cv2.getTextSize(plain, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
    x, y = at
    box = image[max(y - height - 2, 0) : y + below, max(x - 2, 0) : x + width + 2]
    box[:] = (0.45 * box).astype(np.uint8)
    cv2.putText(image, plain, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)
    return width
