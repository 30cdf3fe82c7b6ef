"""The robot's path between its poses. Pure."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vad.geometry import FloatArray
from vad.mapping.camera_beliefs import MAX_GAP_S, beliefs

# How far a robot strays from the curve through its poses, as an acceleration.
_STRAY_M_S2 = 0.1
# Dense poses are smoothed over this long to each side: a robot turns and stops within it.
_SMOOTH_S, _SMOOTH_MAX_S = 0.35, 0.6
_SMOOTH_POSES, _SMOOTH_REACH = 5, 25


class PoseTrack:
    """Robot positions as a curve over time: cubic between neighbours, nothing across gaps and jumps.

    Wild poses, which the robot itself takes back with the next ones, are dropped. Where it believes in
    another place from some moment on it has found itself anew: another segment begins.

    Args:
        t_s: (M,) seconds, any origin, any order; doubles are dropped.
        xy_m: (M, 2) map frame. sigma_m: (M,).

    Attributes:
        wild: how many poses were dropped. segment: (M',) of each pose kept, from 0 on.
    """

    def __init__(self, t_s: ArrayLike, xy_m: ArrayLike, sigma_m: ArrayLike) -> None:
        times = np.asarray(t_s, dtype=np.float64)
        _, order = np.unique(times, return_index=True)
        places = np.asarray(xy_m, dtype=np.float64).reshape(-1, 2)[order]
        sigmas = np.asarray(sigma_m, dtype=np.float64)[order]
        kept, segment = beliefs(times[order], places, sigmas)
        self.wild = len(order) - len(kept)
        self.segment: NDArray[np.int64] = segment
        self.t_s: FloatArray = times[order][kept]
        self.xy_m: FloatArray = places[kept]
        self.sigma_m: FloatArray = sigmas[kept]
        self._dt = np.diff(self.t_s)
        self._usable: NDArray[np.bool_] = (self._dt <= MAX_GAP_S) & (np.diff(segment) == 0)
        self._slope: FloatArray = self._mean_slopes()
        self._smooth()

    def _mean_slopes(self) -> FloatArray:
        """Velocity at each pose from its neighbours, the nearer counting more."""
        velocity = np.diff(self.xy_m, axis=0) / self._dt[:, None]
        weight = np.where(self._usable, 1.0 / self._dt, 0.0)
        total = np.zeros(len(self.t_s))
        slopes = np.zeros_like(self.xy_m)
        for side in (slice(1, None), slice(None, -1)):
            total[side] += weight
            slopes[side] += weight[:, None] * np.where(self._usable[:, None], velocity, 0.0)
        return np.asarray(slopes / np.maximum(total, 1e-12)[:, None])

    def _smooth(self) -> None:
        """Where poses are dense, place and velocity from a parabola through the poses around.

        Without it the curve's noise hides from the fit which way the time offset lies. `sigma_m` stays each
        pose's own: the errors of smoothed neighbours are the same ones.
        """
        if len(self.t_s) < _SMOOTH_POSES:
            return
        step_s = float(np.median(self._dt))
        reach_s = max(_SMOOTH_S, 0.55 * (_SMOOTH_POSES - 1) * step_s)
        if reach_s > _SMOOTH_MAX_S:
            return
        count = len(self.t_s)
        moments = np.zeros((count, 5))
        sums = np.zeros((count, 3, 2))
        reach = min(int(np.ceil(reach_s / step_s)), _SMOOTH_REACH)
        for shift in range(-reach, reach + 1):
            other = np.arange(count) + shift
            inside = (other >= 0) & (other < count)
            other = np.clip(other, 0, count - 1)
            t = self.t_s[other] - self.t_s
            inside &= (np.abs(t) <= reach_s) & (self.segment[other] == self.segment)
            powers = np.where(inside[:, None], t[:, None] ** np.arange(5), 0.0)
            moments += powers
            sums += powers[:, :3, None] * self.xy_m[other][:, None, :]
        enough = moments[:, 0] >= _SMOOTH_POSES
        normal = moments[enough][:, np.arange(3)[:, None] + np.arange(3)]
        curve = np.linalg.solve(normal, sums[enough])
        self.xy_m[enough], self._slope[enough] = curve[:, 0], curve[:, 1]

    def at(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Position (N, 2) and sigma (N,) at (N,) times; NaN where the track does not say."""
        if len(self.t_s) < 2:
            return np.full((len(t_s), 2), np.nan), np.full(len(t_s), np.nan)
        i = np.clip(np.searchsorted(self.t_s, t_s, side="right") - 1, 0, len(self._dt) - 1)
        dt, since = self._dt[i], t_s - self.t_s[i]
        known = self._usable[i] & (since >= 0.0) & (since <= dt)
        u = (since / dt)[:, None]
        xy = (
            (1.0 + 2.0 * u) * (1.0 - u) ** 2 * self.xy_m[i]
            + u**2 * (3.0 - 2.0 * u) * self.xy_m[i + 1]
            + u * (1.0 - u) ** 2 * dt[:, None] * self._slope[i]
            + u**2 * (u - 1.0) * dt[:, None] * self._slope[i + 1]
        )
        stray = 0.5 * _STRAY_M_S2 * since * (dt - since)
        sigma = np.sqrt(np.maximum(self.sigma_m[i], self.sigma_m[i + 1]) ** 2 + stray**2)
        return np.where(known[:, None], xy, np.nan), np.where(known, sigma, np.nan)

    def interval(self, t_s: FloatArray) -> NDArray[np.int64]:
        """Index of the pair of poses each (N,) time lies between; times that share one share its noise."""
        return np.asarray(np.searchsorted(self.t_s, t_s, side="right"), dtype=np.int64)

    def segment_at(self, t_s: FloatArray) -> NDArray[np.int64]:
        """The segment each (N,) time lies in, -1 where the track does not say."""
        i = np.clip(np.searchsorted(self.t_s, t_s, side="right") - 1, 0, max(len(self.t_s) - 1, 0))
        known = np.isfinite(self.at(t_s)[0][:, 0])
        return np.asarray(np.where(known, self.segment[i], -1), dtype=np.int64)
