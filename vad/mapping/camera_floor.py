"""Which floor is in a camera's picture. Pure."""

from __future__ import annotations

import numpy as np

from vad.geometry import FloatArray, undistort
from vad.mapping.camera_calibration import CameraCalibration

_NEAR_M = 0.05
"""Nearer than this along the optical axis nothing is in the picture."""


def floor_in_picture(
    calibration: CameraCalibration, bounds_m: tuple[float, float, float, float]
) -> tuple[tuple[float, float], ...] | None:
    """Outline of the floor that lies in the picture, map frame, counter-clockwise; walls are not considered.

    Args:
        calibration: with a place and a lens; with a bent lens the middles of the picture's sides count.
        bounds_m: x0, y0, x1, y1; no floor beyond.

    Returns:
        Corners of a convex outline, metres to the centimetre; None where the place is not known, or no floor
        is in the picture.
    """
    pose, lens = calibration.camera_from_map, calibration.intrinsics
    if pose is None or lens is None or calibration.status not in ("valid", "recalibrating"):
        return None
    left, right, top, bottom = -0.5, lens.width_px - 0.5, -0.5, lens.height_px - 0.5
    middles = [[left, lens.cy_px], [right, lens.cy_px], [lens.cx_px, top], [lens.cx_px, bottom]]
    sides = (undistort(middles, lens) - (lens.cx_px, lens.cy_px)) / (lens.fx_px, lens.fy_px)
    (left, _), (right, _), (_, top), (_, bottom) = sides
    # each row r of the frustum: r @ (x, y, z, 1) >= 0 for what is in the picture, camera frame
    frustum = np.array(
        [[1, 0, -left, 0], [-1, 0, right, 0], [0, 1, -top, 0], [0, -1, bottom, 0], [0, 0, 1, -_NEAR_M]]
    )
    if not np.isfinite(frustum).all():
        return None
    x0, y0, x1, y1 = bounds_m
    outline: FloatArray = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], dtype=np.float64)
    for side in frustum:
        across, along, off = side[:3] @ pose.rotation[:, 0], side[:3] @ pose.rotation[:, 1], side[3]
        outline = _clipped(outline, np.array([across, along]), float(side[:3] @ pose.translation + off))
        if len(outline) < 3:
            return None
    return tuple((round(float(x), 2), round(float(y), 2)) for x, y in outline)


def _clipped(outline: FloatArray, normal: FloatArray, offset: float) -> FloatArray:
    """The part of a convex outline (N, 2) where normal . p + offset >= 0 (Sutherland-Hodgman)."""
    inside = outline @ normal + offset
    kept: list[FloatArray] = []
    for i, here in enumerate(inside):
        before = inside[i - 1]
        if (here >= 0) != (before >= 0):
            share = before / (before - here)
            kept.append(outline[i - 1] + share * (outline[i] - outline[i - 1]))
        if here >= 0:
            kept.append(outline[i])
    return np.array(kept).reshape(-1, 2)
