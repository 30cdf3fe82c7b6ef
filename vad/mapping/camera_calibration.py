"""A camera's place and what follows from it: floor points with covariance. Pure."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, cast, get_args

import numpy as np
from numpy.typing import ArrayLike

from vad.geometry import (
    FloatArray,
    Intrinsics,
    Rigid,
    apply_homography,
    floor_homography,
    rotation_from_vector,
    undistort,
)
from vad.mapping.camera_view import CameraView

CameraStatus = Literal["uncalibrated", "collecting", "valid", "invalid", "recalibrating"]

SCHEMA = "vad.camera/2"
# The order of the parameters in every covariance: a small rotation in the camera frame (rad), the camera's
# position in the map (m), the logarithm of the focal length, k1, k2, the principal point (px).
PARAMETERS = 11
_STEPS = np.array([1e-5, 1e-5, 1e-5, 1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5, 1e-2, 1e-2])


def moved(intrinsics: Intrinsics, camera_from_map: Rigid, change: FloatArray) -> tuple[Intrinsics, Rigid]:
    """The camera after a small `change` (11,) of its parameters."""
    rotation = rotation_from_vector(change[:3]) @ camera_from_map.rotation
    position = -camera_from_map.rotation.T @ camera_from_map.translation + change[3:6]
    scale = float(np.exp(change[6]))
    lens = replace(
        intrinsics,
        fx_px=intrinsics.fx_px * scale,
        fy_px=intrinsics.fy_px * scale,
        cx_px=intrinsics.cx_px + float(change[9]),
        cy_px=intrinsics.cy_px + float(change[10]),
        k1=intrinsics.k1 + float(change[7]),
        k2=intrinsics.k2 + float(change[8]),
    )
    return lens, Rigid(rotation, -rotation @ position)


@dataclass(frozen=True, slots=True)
class CameraCalibration:
    """Stage 1's result: where the camera is, how good that is, or why it is not known yet.

    status: `valid` alone may be used; percent: progress of the weakest gate, 100 when valid; reason: why it
    is not valid, a sentence for the user; unseen: thirds of the picture (`left`, `middle`, `right`) without
    the robot. intrinsics: given or estimated; focal_sigma_px: 0 when given. map_from_image: (3, 3), floor,
    undistorted pixels (eq. 4), the same estimate as camera_from_map (eq. 3). deviation_m: mean distance of
    the robot's pose from the camera's floor point, each pair predicted without itself. homography_gap_m:
    mean distance on the floor between this estimate and a free homography of the same pairs; a large one
    says that the lens is not as described. time_offset_s: pose stamp minus frame stamp of the same moment.
    parameter_covariance: (11, 11), see PARAMETERS. view: what the picture's still background looked like.
    """

    status: CameraStatus
    percent: int
    reason: str
    pairs: int = 0
    unseen: tuple[str, ...] = ()
    camera_from_map: Rigid | None = None
    intrinsics: Intrinsics | None = None
    focal_sigma_px: float = 0.0
    map_from_image: FloatArray | None = None
    deviation_m: float | None = None
    homography_gap_m: float | None = None
    time_offset_s: float | None = None
    time_offset_sigma_s: float | None = None
    parameter_covariance: FloatArray | None = None
    view: CameraView | None = None

    @property
    def position_m(self) -> FloatArray | None:
        """The camera's position, (3,), map frame: -R^-1 t (eq. 3)."""
        return None if self.camera_from_map is None else self.camera_from_map.inverse().translation

    @property
    def position_covariance(self) -> FloatArray | None:
        """Covariance of `position_m`, (3, 3), m^2."""
        return None if self.parameter_covariance is None else self.parameter_covariance[3:6, 3:6]

    @property
    def homography_covariance(self) -> FloatArray | None:
        """Covariance of `map_from_image` row by row, (9, 9), to first order; it has unit norm."""
        camera_from_map, lens, covariance = self.camera_from_map, self.intrinsics, self.parameter_covariance
        if camera_from_map is None or lens is None or covariance is None:
            return None
        columns = [
            (
                floor_homography(*moved(lens, camera_from_map, step))
                - floor_homography(*moved(lens, camera_from_map, -step))
            ).ravel()
            / (2.0 * size)
            for size, step in zip(_STEPS, np.diag(_STEPS), strict=True)
        ]
        by_parameter = np.stack(columns, axis=-1)
        return np.asarray(by_parameter @ covariance @ by_parameter.T, dtype=np.float64)

    def floor_point(self, image_px: ArrayLike, sigma_px: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Where raw pixels lie on the floor, calibration uncertainty included.

        Args:
            image_px: (N, 2) raw pixels. sigma_px: scalar or (N,), 1 standard deviation per axis.

        Returns:
            xy_m (N, 2) in the map frame and its covariance (N, 2, 2); NaN at and above the horizon.

        Raises:
            ValueError: the camera has no place yet.
        """
        px = np.asarray(image_px, dtype=np.float64).reshape(-1, 2)
        sigma = np.broadcast_to(np.asarray(sigma_px, dtype=np.float64), (len(px),))
        return self.floor_points_with(px, np.eye(2) * (sigma**2)[:, None, None])

    def floor_points_with(
        self, image_px: ArrayLike, covariance_px2: ArrayLike
    ) -> tuple[FloatArray, FloatArray]:
        """As `floor_point`, for pixels (N, 2) with full covariances (N, 2, 2), px^2."""
        camera_from_map, lens, covariance = self.camera_from_map, self.intrinsics, self.parameter_covariance
        if camera_from_map is None or lens is None or covariance is None:
            raise ValueError("the camera is not calibrated")
        px = np.asarray(image_px, dtype=np.float64).reshape(-1, 2)
        noise = np.asarray(covariance_px2, dtype=np.float64).reshape(-1, 2, 2)
        xy = _on_floor(px, lens, camera_from_map)
        towards = np.stack(
            [
                (
                    _on_floor(px, *moved(lens, camera_from_map, step))
                    - _on_floor(px, *moved(lens, camera_from_map, -step))
                )
                / (2.0 * size)
                for size, step in zip(_STEPS, np.diag(_STEPS), strict=True)
            ],
            axis=-1,
        )
        by_pixel = np.stack(
            [
                _on_floor(px + half, lens, camera_from_map) - _on_floor(px - half, lens, camera_from_map)
                for half in (np.array([0.5, 0.0]), np.array([0.0, 0.5]))
            ],
            axis=-1,
        )
        spread = by_pixel @ noise @ by_pixel.transpose(0, 2, 1)
        return xy, spread + towards @ covariance @ towards.transpose(0, 2, 1)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON; `from_dict` reads them back."""
        plain: dict[str, Any] = {"schema": SCHEMA}
        for name, value in asdict(replace(self, view=None)).items():
            if isinstance(value, np.ndarray):
                plain[name] = value.tolist()
            elif isinstance(value, dict):
                plain[name] = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in value.items()}
            else:
                plain[name] = list(value) if isinstance(value, tuple) else value
        plain["view"] = None if self.view is None else self.view.to_dict()
        return plain

    @staticmethod
    def from_dict(plain: dict[str, Any]) -> CameraCalibration:
        """The inverse of `to_dict`.

        Raises:
            ValueError: not a calibration of this schema.
        """
        if plain.get("schema") != SCHEMA or plain.get("status") not in get_args(CameraStatus):
            raise ValueError(f"not a {SCHEMA} record")
        try:
            return _from_plain(plain)
        except (KeyError, TypeError) as error:
            raise ValueError(f"not a complete {SCHEMA} record: {error}") from error


@dataclass(frozen=True, slots=True)
class Deviations:
    """Robot against camera. robot_m, camera_m: (N, 2) floor points, map frame; image_px: (N, 2) where it was
    found, raw; agreeing: share of the pictures that should show the robot in which it was found where it
    should be; path_m: (M, 2) all of the robot's path."""

    robot_m: FloatArray
    camera_m: FloatArray
    image_px: FloatArray
    agreeing: float
    path_m: FloatArray


def _on_floor(px: FloatArray, lens: Intrinsics, camera_from_map: Rigid) -> FloatArray:
    straight = undistort(px, lens)
    rays = np.column_stack(
        [
            (straight[:, 0] - lens.cx_px) / lens.fx_px,
            (straight[:, 1] - lens.cy_px) / lens.fy_px,
            np.ones(len(px)),
        ]
    )
    downwards = (rays @ camera_from_map.rotation)[:, 2:] < 0.0
    return np.where(downwards, apply_homography(floor_homography(lens, camera_from_map), straight), np.nan)


def _from_plain(plain: dict[str, Any]) -> CameraCalibration:
    def array(value: Any, *shape: int) -> FloatArray:
        read = np.asarray(value, dtype=np.float64)
        if read.shape != shape or not np.all(np.isfinite(read)):
            raise ValueError(f"expected finite numbers of shape {shape}")
        return read

    def number(name: str) -> float | None:
        return None if plain[name] is None else float(plain[name])

    motion, lens = plain["camera_from_map"], plain["intrinsics"]
    homography, covariance = plain["map_from_image"], plain["parameter_covariance"]
    return CameraCalibration(
        status=cast(CameraStatus, plain["status"]),
        percent=int(plain["percent"]),
        reason=str(plain["reason"]),
        pairs=int(plain["pairs"]),
        unseen=tuple(str(third) for third in plain["unseen"]),
        camera_from_map=None
        if motion is None
        else Rigid(array(motion["rotation"], 3, 3), array(motion["translation"], 3)),
        intrinsics=None if lens is None else Intrinsics(**lens),
        focal_sigma_px=float(plain["focal_sigma_px"]),
        map_from_image=None if homography is None else array(homography, 3, 3),
        deviation_m=number("deviation_m"),
        homography_gap_m=number("homography_gap_m"),
        time_offset_s=number("time_offset_s"),
        time_offset_sigma_s=number("time_offset_sigma_s"),
        parameter_covariance=None if covariance is None else array(covariance, PARAMETERS, PARAMETERS),
        view=None if plain["view"] is None else CameraView.from_dict(plain["view"]),
    )
