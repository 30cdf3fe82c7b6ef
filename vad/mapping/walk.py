"""The walker's ground track as the Wi-Fi stage needs it: place and velocity at any time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_BASE_S = 0.2
_LEAST_SLOW_SHARE = 0.2
"""No track's errors are all new at every point: at least this share of sigma_m lasts."""


@dataclass(frozen=True, slots=True)
class SeenWalk:
    """A track under a window, a little before and after F instants t_s (F,), seconds.

    ahead_m, behind_m (F, 2): base_s apart. The rest tells what the errors do to velocities.
    """

    t_s: FloatArray
    ahead_m: FloatArray
    behind_m: FloatArray
    base_s: float
    _difference: FloatArray
    _lag_s: FloatArray
    _white_m: float
    _slow_m: float

    def velocity_covariance(self, share: float, correlation_s: float) -> FloatArray:
        """(F, F) m^2/s^2 along one axis: the track's errors that are new at each point, and of those that
        last a share, smooth over correlation_s (Matern 3/2)."""
        lag = np.sqrt(3) * self._lag_s / correlation_s
        errors = (share * self._slow_m) ** 2 * (1 + lag) * np.exp(-lag)
        errors[np.diag_indices_from(errors)] += self._white_m**2
        return np.asarray(self._difference @ errors @ self._difference.T)


@dataclass(frozen=True, slots=True)
class WalkTrack:
    """t_ns int64 (M,), strictly increasing, timeline; xy_m (M, 2) map frame; sigma_m (M,)."""

    t_ns: NDArray[np.int64]
    xy_m: FloatArray
    sigma_m: FloatArray

    def covers(self, t_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which times lie inside the track."""
        inside: NDArray[np.bool_] = (t_ns >= self.t_ns[0]) & (t_ns <= self.t_ns[-1])
        return inside

    def position_m(self, t_ns: NDArray[np.int64]) -> FloatArray:
        """Places (N, 2), linear between the track's points, held at its ends."""
        t_s, at_s = self._seconds(t_ns)
        return np.stack([np.interp(at_s, t_s, self.xy_m[:, k]) for k in (0, 1)], axis=1)

    def later(self, offset_s: float) -> WalkTrack:
        """The same walk, its stamps raised by offset_s."""
        return WalkTrack(self.t_ns + int(offset_s * 1e9), self.xy_m, self.sigma_m)

    def seen_at(self, t_ns: NDArray[np.int64], half_width_s: float) -> SeenWalk:
        """The track under a Hann window (a walker's mass, not a detector's jitter) around t_ns (F,)."""
        t_s, at_s = self._seconds(t_ns)
        ahead, behind = (_hann(t_s, at_s + shift, half_width_s) for shift in (_BASE_S / 2, -_BASE_S / 2))
        white_m = min(self.white_m, float(np.median(self.sigma_m)))
        sigma_m = float(np.median(self.sigma_m))
        slow_m = np.sqrt(max(sigma_m**2 - white_m**2, (_LEAST_SLOW_SHARE * sigma_m) ** 2))
        return SeenWalk(
            at_s,
            ahead @ self.xy_m,
            behind @ self.xy_m,
            _BASE_S,
            (ahead - behind) / _BASE_S,
            np.abs(t_s[:, None] - t_s[None]),
            white_m,
            float(slow_m),
        )

    @property
    def white_m(self) -> float:
        """Standard deviation along an axis of what is new at each point, from second differences, which a
        walker's own movement hardly reaches."""
        if len(self.xy_m) < 5:
            return 0.0
        bend = self.xy_m[2:] - 2 * self.xy_m[1:-1] + self.xy_m[:-2]
        return float(1.4826 * np.median(np.abs(bend)) / np.sqrt(6))

    @property
    def length_m(self) -> float:
        """The way walked, measured over 0.5 s chords so that jitter does not count as walking."""
        at = np.arange(self.t_ns[0], self.t_ns[-1] + 1, 500_000_000)
        if len(at) < 2:
            return 0.0
        return float(np.linalg.norm(np.diff(self.position_m(at), axis=0), axis=1).sum())

    @property
    def breadth_m(self) -> float:
        """The smaller standard deviation of the places: 0 for a straight line."""
        if len(self.xy_m) < 2:
            return 0.0
        return float(np.sqrt(max(0.0, np.linalg.eigvalsh(np.cov(self.xy_m.T))[0])))

    def _seconds(self, t_ns: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
        return (self.t_ns - self.t_ns[0]) / 1e9, (t_ns - self.t_ns[0]) / 1e9


def _hann(t_s: FloatArray, at_s: FloatArray, half_width_s: float) -> FloatArray:
    """Weights (F, M) of points at t_s (M,) for windows around at_s (F,), each row's sum 1."""
    x = (t_s[None] - at_s[:, None]) / half_width_s
    weights = np.where(np.abs(x) < 1, 0.5 * (1 + np.cos(np.pi * x)), 0.0)
    nearest = np.argmin(np.abs(x), axis=1)
    weights[np.arange(len(at_s)), nearest] += 1e-3  # a window between sparse points holds none
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))
