"""Solid parts drawn into a picture: shaded hulls of spheres in perspective, and soft shadows on the floor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vad.geometry import FloatArray, Intrinsics, Rigid, look_at
from vad.sim.scenario import CameraPlacement

Image = NDArray[np.uint8]
Floats = NDArray[np.float32]

_NEAREST_M = 0.25
_CIRCLE = np.stack([np.cos(a := np.linspace(0, 2 * np.pi, 20, endpoint=False)), np.sin(a)], axis=1)
_SHIFT = 4  # cv2's fixed-point bits: corners to a sixteenth of a pixel
# Light falls from above and a little from the left of the picture.
_LIGHT_X, _LIGHT_Y = -0.45, -0.9
_AMBIENT, _DIFFUSE = 0.86, 0.42


@dataclass(frozen=True, slots=True)
class View:
    """The simulated camera."""

    intrinsics: Intrinsics
    camera_from_map: Rigid

    @classmethod
    def of(cls, placement: CameraPlacement) -> View:
        """The true camera of a scenario: square pixels, principal point in the middle, no distortion."""
        p = placement
        intrinsics = Intrinsics(
            p.width_px, p.height_px, p.focal_px, p.focal_px, p.width_px / 2, p.height_px / 2
        )
        return cls(intrinsics, look_at(p.eye_m, p.target_m))


@dataclass(frozen=True, slots=True)
class Part:
    """The convex hull of spheres. centres_m: (N, 3) in the map; radii_m: (N,); rgb: 0..255.

    order_m is added to the part's depth when parts are sorted: negative draws it over its neighbours.
    """

    centres_m: FloatArray
    radii_m: FloatArray
    rgb: tuple[float, float, float]
    order_m: float = 0.0


@dataclass(frozen=True, slots=True)
class Patch:
    """A rectangle of a picture with a part's coverage in it, 0..1, (height, width)."""

    rows: slice
    columns: slice
    coverage: Floats


def draw_parts(image: Image, view: View, parts: list[Part]) -> None:
    """Draw parts into (H, W, 3) BGR, the farthest first."""
    depths = [float(view.camera_from_map.apply(part.centres_m)[:, 2].mean()) + part.order_m for part in parts]
    for k in np.argsort(depths)[::-1]:
        _draw_part(image, view, parts[int(k)])


def draw_shadow(
    image: Image, view: View, centre_m: tuple[float, float], radius_m: float, strength: float
) -> None:
    """Darken the floor round a point, softly: `strength` is the share of light lost in the middle."""
    ring = np.column_stack([_CIRCLE * radius_m + np.array(centre_m), np.zeros(len(_CIRCLE))])
    camera = view.camera_from_map.apply(ring)
    if camera[:, 2].min() < _NEAREST_M:
        return
    outline = _pixels(camera, view)
    blur_px = float(np.ptp(outline[:, 1])) * 0.3
    patch = _patch(image, outline, blur_px)
    if patch is not None:
        target = image[patch.rows, patch.columns]
        target[:] = target * (1.0 - strength * patch.coverage[:, :, None])


def _pixels(camera: FloatArray, view: View) -> FloatArray:
    k = view.intrinsics
    return camera[:, :2] / camera[:, 2:] * (k.fx_px, k.fy_px) + (k.cx_px, k.cy_px)


def _patch(image: Image, outline: FloatArray, blur_px: float) -> Patch | None:
    """The coverage of a convex outline, (N, 2) px, softened by blur_px; None outside the picture."""
    height, width = image.shape[:2]
    pad = 2 + 2 * blur_px
    x0, y0 = np.floor(outline.min(axis=0) - pad).astype(int)
    x1, y1 = np.ceil(outline.max(axis=0) + pad).astype(int)
    x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, width), min(y1, height)
    if x1 - x0 < 2 or y1 - y0 < 2:
        return None
    hull = cv2.convexHull((outline - (x0, y0)).astype(np.float32)).reshape(-1, 2)
    mask = np.zeros((y1 - y0, x1 - x0), np.uint8)
    # cv2 counts pixel centres as whole numbers, projection has them at one half.
    corners = np.round((hull - 0.5) * (1 << _SHIFT)).astype(np.int32)
    cv2.fillConvexPoly(mask, corners, 255, cv2.LINE_AA, _SHIFT)
    soft = _soft(_blurred, mask.astype(np.float32) * np.float32(1 / 255), max(blur_px, 0.6))
    return Patch(slice(y0, y1), slice(x0, x1), soft)


def _soft(work: Callable[[Floats, float], Floats], mask: Floats, sigma_px: float) -> Floats:
    """`work` on a mask at a size where its blur is small, for wide blurs are dear."""
    shrink = int(sigma_px / 2)
    if shrink < 2 or min(mask.shape) < 2 * shrink:
        return work(mask, sigma_px)
    height, width = mask.shape
    small = cv2.resize(mask, (width // shrink, height // shrink), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.resize(work(np.asarray(small, np.float32), sigma_px / shrink), (width, height)))


def _blurred(mask: Floats, sigma_px: float) -> Floats:
    return np.asarray(cv2.GaussianBlur(mask, (0, 0), sigma_px), np.float32)


def _slope_to_light(mask: Floats, sigma_px: float) -> Floats:
    """How far a rounded body of this silhouette faces the light at each pixel, -1..1."""
    body = _blurred(mask, sigma_px)
    slope_x = cv2.Sobel(body, cv2.CV_32F, 1, 0, ksize=3)
    slope_y = cv2.Sobel(body, cv2.CV_32F, 0, 1, ksize=3)
    steep = 0.55 * sigma_px
    return np.asarray(np.clip((slope_x * -_LIGHT_X + slope_y * -_LIGHT_Y) * steep, -1.0, 1.0), np.float32)


def _draw_part(image: Image, view: View, part: Part) -> None:
    camera = view.camera_from_map.apply(part.centres_m)
    if camera[:, 2].min() < _NEAREST_M:
        return
    centres = _pixels(camera, view)
    radii = part.radii_m / camera[:, 2] * view.intrinsics.fx_px
    outline = (centres[:, None, :] + radii[:, None, None] * _CIRCLE[None]).reshape(-1, 2)
    patch = _patch(image, outline, 0.0)
    if patch is None:
        return
    # The slope of the softened silhouette stands for the surface's normal: a rounded body.
    radius_px = float(radii.max())
    lit = _soft(_slope_to_light, patch.coverage, max(0.55 * radius_px, 0.8))
    shade = (_AMBIENT + _DIFFUSE * lit)[:, :, None]
    colour = np.array(part.rgb[::-1], np.float32) * shade
    target = image[patch.rows, patch.columns]
    alpha = patch.coverage[:, :, None]
    target[:] = np.clip(target + (colour - target) * alpha, 0, 255)
