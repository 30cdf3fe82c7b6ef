"""The walker's ground track as the Wi-Fi stage needs it: place and velocity at any time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_VELOCITY_BASE_S = 0.1


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

    def velocity_mps(self, t_ns: NDArray[np.int64]) -> FloatArray:
        """Velocities (N, 2) as central differences over 0.2 s."""
        half_ns = int(_VELOCITY_BASE_S * 1e9)
        ahead, behind = self.position_m(t_ns + half_ns), self.position_m(t_ns - half_ns)
        t_s, at_s = self._seconds(t_ns)
        base_s = np.minimum(at_s + _VELOCITY_BASE_S, t_s[-1]) - np.maximum(at_s - _VELOCITY_BASE_S, t_s[0])
        return np.asarray((ahead - behind) / np.maximum(base_s, 1e-3)[:, None], dtype=np.float64)

    def later(self, offset_s: float) -> WalkTrack:
        """The same walk, its stamps raised by offset_s."""
        return WalkTrack(self.t_ns + int(offset_s * 1e9), self.xy_m, self.sigma_m)

    def smoothed(self, window_s: float) -> WalkTrack:
        """The track at 20 Hz under a Hann window of `window_s`: a walker's mass, not a detector's jitter."""
        t_ns = np.arange(self.t_ns[0], self.t_ns[-1] + 1, 50_000_000)
        width = max(1, round(window_s / 0.05)) | 1
        kernel = np.hanning(width + 2)[1:-1]
        kernel /= kernel.sum()
        half = width // 2
        padded = np.pad(self.position_m(t_ns), ((half, half), (0, 0)), mode="edge")
        xy = np.stack([np.convolve(padded[:, k], kernel, mode="valid") for k in (0, 1)], axis=1)
        t_s, at_s = self._seconds(t_ns)
        return WalkTrack(t_ns, xy, np.interp(at_s, t_s, self.sigma_m))

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
