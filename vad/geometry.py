"""Frames, rigid motions, the pin-hole camera and plane homographies. Pure: arrays in, arrays out.

Frames (design.md): map is x right, y up on the plan, z up, metres; camera is x right, y down, z forward;
image is in pixels, x right, y down. `camera_from_map` takes map coordinates to the camera's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

# An undistortion that has not settled after this many Newton steps lies outside the model's range.
_UNDISTORT_STEPS = 12
# Points nearer than this to the camera's plane are treated as behind it.
_NEAREST_DEPTH_M = 1e-6


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """A pin-hole camera with two radial terms: r' = r (1 + k1 r^2 + k2 r^4), r in normalised coordinates."""

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    k1: float = 0.0
    k2: float = 0.0

    @property
    def matrix(self) -> FloatArray:
        """K, (3, 3)."""
        return np.array([[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]])

    def scaled(self, width_px: int, height_px: int) -> Intrinsics:
        """The same lens with pictures of another size; pixels are counted from the middle of the first.

        Raises:
            ValueError: a picture of another shape shows another part of what the lens sees.
        """
        x, y = width_px / self.width_px, height_px / self.height_px
        if abs(x / y - 1.0) > 0.01:
            raise ValueError(
                f"the lens was measured in pictures of {self.width_px}x{self.height_px}, these are of "
                f"{width_px}x{height_px}: another shape"
            )
        return Intrinsics(
            width_px,
            height_px,
            self.fx_px * x,
            self.fy_px * y,
            (self.cx_px + 0.5) * x - 0.5,
            (self.cy_px + 0.5) * y - 0.5,
            self.k1,
            self.k2,
        )


@dataclass(frozen=True, slots=True)
class Rigid:
    """A rigid motion p -> rotation p + translation, named by its use: `camera_from_map: Rigid`.

    rotation: (3, 3), orthonormal; translation: (3,), metres.
    """

    rotation: FloatArray
    translation: FloatArray

    def apply(self, points: ArrayLike) -> FloatArray:
        """(N, 3) points of the source frame in the target frame."""
        return np.asarray(points, dtype=np.float64) @ self.rotation.T + self.translation

    def inverse(self) -> Rigid:
        """a_from_b -> b_from_a."""
        return Rigid(self.rotation.T.copy(), -self.rotation.T @ self.translation)

    def compose(self, first: Rigid) -> Rigid:
        """The motion that does `first` and then this: c_from_b.compose(b_from_a) is c_from_a."""
        return Rigid(self.rotation @ first.rotation, self.rotation @ first.translation + self.translation)


def rotation_from_vector(rotation_vector: ArrayLike) -> FloatArray:
    """Rodrigues' formula: (3,) axis times angle in radians -> (3, 3) rotation."""
    v = np.asarray(rotation_vector, dtype=np.float64).reshape(3)
    angle = float(np.linalg.norm(v))
    cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    if angle < 1e-8:
        return np.asarray(np.eye(3) + cross, dtype=np.float64)
    a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2
    return np.asarray(np.eye(3) + a * cross + b * (cross @ cross), dtype=np.float64)


def look_at(eye_m: ArrayLike, target_m: ArrayLike) -> Rigid:
    """camera_from_map of a level camera at `eye_m` (3,) looking at `target_m` (3,), both in the map.

    Straight up or down the picture's right is the map's x.

    Raises:
        ValueError: eye and target are the same point.
    """
    eye, target = (np.asarray(p, dtype=np.float64).reshape(3) for p in (eye_m, target_m))
    forward = target - eye
    length = float(np.linalg.norm(forward))
    if length == 0.0:
        raise ValueError("eye and target are the same point")
    forward = forward / length
    right = np.array([forward[1], -forward[0], 0.0])
    across = float(np.linalg.norm(right))
    right = right / across if across > 1e-9 else np.array([1.0, 0.0, 0.0])
    down = np.cross(forward, right)
    rotation = np.vstack([right, down, forward])
    return Rigid(rotation, -rotation @ eye)


def distort(normalised: ArrayLike, intrinsics: Intrinsics) -> FloatArray:
    """(N, 2) ideal normalised camera coordinates (x/z, y/z) -> (N, 2) raw pixels."""
    n = np.asarray(normalised, dtype=np.float64)
    r2 = np.sum(n * n, axis=-1, keepdims=True)
    n = n * (1.0 + r2 * (intrinsics.k1 + r2 * intrinsics.k2))
    scale, centre = (intrinsics.fx_px, intrinsics.fy_px), (intrinsics.cx_px, intrinsics.cy_px)
    return np.asarray(n * scale + centre, dtype=np.float64)


def project(points_map: ArrayLike, intrinsics: Intrinsics, camera_from_map: Rigid) -> FloatArray:
    """(N, 3) map points -> (N, 2) raw pixels; NaN for points behind the camera."""
    p = camera_from_map.apply(points_map)
    depth = np.where(p[:, 2:] > _NEAREST_DEPTH_M, p[:, 2:], np.nan)
    return distort(p[:, :2] / depth, intrinsics)


def undistort(points: ArrayLike, intrinsics: Intrinsics) -> FloatArray:
    """(N, 2) raw pixels -> (N, 2) pixels of the same camera without its radial distortion.

    Inverts r' = r (1 + k1 r^2 + k2 r^4) by Newton's method; NaN where the model cannot be inverted.
    """
    p = np.asarray(points, dtype=np.float64)
    if intrinsics.k1 == 0.0 and intrinsics.k2 == 0.0:
        return p.copy()
    scale = np.array([intrinsics.fx_px, intrinsics.fy_px])
    centre = np.array([intrinsics.cx_px, intrinsics.cy_px])
    bent = (p - centre) / scale
    radius_bent = np.linalg.norm(bent, axis=-1)
    radius = radius_bent.copy()
    k1, k2 = intrinsics.k1, intrinsics.k2
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for _ in range(_UNDISTORT_STEPS):
            r2 = radius * radius
            error = radius * (1.0 + r2 * (k1 + r2 * k2)) - radius_bent
            radius = radius - error / (1.0 + r2 * (3.0 * k1 + 5.0 * r2 * k2))
        r2 = radius * radius
        ratio = 1.0 + r2 * (k1 + r2 * k2)
        settled = np.abs(radius * ratio - radius_bent) < 1e-9 * (1.0 + radius_bent)
        invertible = settled & (1.0 + r2 * (3.0 * k1 + 5.0 * r2 * k2) > 0.0) & (radius >= 0.0)
        ratio = np.where(invertible, ratio, np.nan)
    return np.asarray(bent / ratio[..., None] * scale + centre, dtype=np.float64)


def floor_homography(intrinsics: Intrinsics, camera_from_map: Rigid) -> FloatArray:
    """map_from_image, (3, 3), of the floor z = 0: undistorted pixels -> map metres; the paper's eq. 4.

    Its inverse, by `numpy.linalg.inv`, is image_from_map.

    Raises:
        numpy.linalg.LinAlgError: the camera lies in the floor.
    """
    columns = np.column_stack([camera_from_map.rotation[:, :2], camera_from_map.translation])
    map_from_image = np.linalg.inv(intrinsics.matrix @ columns)
    return np.asarray(map_from_image / np.linalg.norm(map_from_image), dtype=np.float64)


def apply_homography(homography: FloatArray, points: ArrayLike) -> FloatArray:
    """(3, 3) and (N, 2) points -> (N, 2); NaN for points on the homography's horizon."""
    p = np.asarray(points, dtype=np.float64)
    q = p @ homography[:, :2].T + homography[:, 2]
    w = q[:, 2:]
    return np.asarray(q[:, :2] / np.where(w == 0.0, np.nan, w))
