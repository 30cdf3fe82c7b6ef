"""How well any unbiased estimator can place a device from one walk: the Cramer-Rao bound of its Doppler.

What is observed is the path length change plc_i = |P_i T| + |P_i R| + c (the paper's (8), (9); c unknown)
and the track Q_i = P_i + e_i. To first order the residual plc_i - (|Q_i T| + |Q_i R|) has mean
-(d|P_i R|/dR) dR + c and noise -g_i . e_i, g_i = unit(P_i - T) + unit(P_i - R): the track's error, seen by
both ends, coloured as the track's error is. Phases between antennas are not in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_FLOOR_M = 1e-3
"""Path length changes are never better than this: keeps the noise's covariance regular where g vanishes."""

_NOTHING = 1e-6
"""Information of a kilometre's uncertainty, 1/m^2: rounding, not knowledge."""


@dataclass(frozen=True, slots=True)
class TrackNoise:
    """Errors of a track along each axis, m: white from point to point, and an Ornstein-Uhlenbeck process."""

    white_m: float
    slow_m: float
    correlation_s: float = 1.0

    @property
    def sigma_m(self) -> float:
        """Of both parts together, along one axis."""
        return float(np.hypot(self.white_m, self.slow_m))

    def covariance_m2(self, t_s: FloatArray) -> FloatArray:
        """(N, N) of the errors along one axis at times t_s (N,)."""
        slow = self.slow_m**2 * np.exp(-np.abs(t_s[:, None] - t_s[None]) / self.correlation_s)
        return np.asarray(slow + self.white_m**2 * np.eye(len(t_s)), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class DopplerBound:
    """information (2, 2) 1/m^2 of the device's place, the unknown offset marginalised."""

    information: FloatArray

    @property
    def covariance_m2(self) -> FloatArray:
        """(2, 2): the least covariance of an unbiased estimate; inf where the walk tells nothing."""
        if np.linalg.eigvalsh(self.information)[0] < _NOTHING:
            return np.full((2, 2), np.inf)
        return np.asarray(np.linalg.inv(self.information), dtype=np.float64)

    @property
    def rms_m(self) -> float:
        """Root of the mean squared distance."""
        return float(np.sqrt(np.trace(self.covariance_m2)))

    def plus(self, other: DopplerBound) -> DopplerBound:
        """Of two walks with independent errors."""
        return DopplerBound(self.information + other.information)


def doppler_bound(
    t_s: FloatArray,
    walk_m: FloatArray,
    anchor_m: FloatArray,
    device_m: FloatArray,
    noise: TrackNoise,
    *,
    doppler_sigma_mps: float = 0.0,
) -> DopplerBound:
    """The bound for one walk.

    t_s (N,), walk_m (N, 3): the reflecting body at the track's points, N >= 4; anchor_m, device_m (3,): the
    ends of the link; only the device's x and y are unknown. doppler_sigma_mps: error of the path length
    change rate, new at each point; it adds up to a random walk of the path length change.
    """
    to_anchor, to_device = _units(walk_m - anchor_m), _units(walk_m - device_m)
    gradient = (to_anchor + to_device)[:, :2]
    covariance = (gradient @ gradient.T) * noise.covariance_m2(t_s) + _FLOOR_M**2 * np.eye(len(t_s))
    if doppler_sigma_mps > 0:
        steps = np.concatenate([[0.0], np.diff(t_s)])
        walked = np.cumsum((doppler_sigma_mps * steps) ** 2)
        covariance += np.minimum(walked[:, None], walked[None])
    sensitivity = np.column_stack([-to_device[:, :2], np.ones(len(t_s))])
    full = sensitivity.T @ np.linalg.solve(covariance, sensitivity)
    information = full[:2, :2] - np.outer(full[:2, 2], full[2, :2]) / full[2, 2]
    return DopplerBound(np.asarray((information + information.T) / 2, dtype=np.float64))


def _units(offset_m: FloatArray) -> FloatArray:
    return np.asarray(offset_m / np.linalg.norm(offset_m, axis=1, keepdims=True), dtype=np.float64)
