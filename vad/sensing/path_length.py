"""Spectrogram -> the ridge of the walker, and its integral: the path length change of the paper's (8)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vad.sensing.spectrogram import Spectrogram

FloatArray = NDArray[np.float64]

MAX_JUMP_HZ_PER_S = 120.0
"""A walker's Doppler changes by at most about 60 Hz in half a second (a quick turn)."""

JUMP_COST_PER_HZ = 0.02


@dataclass(frozen=True, slots=True)
class PathLength:
    """t_ns int64 (F,); f_hz (F,): the ridge; plc_m (F,): integrated path length change, 0 at the start."""

    t_ns: NDArray[np.int64]
    f_hz: FloatArray
    plc_m: FloatArray


def ridge_hz(spectrogram: Spectrogram) -> FloatArray:
    """The most likely continuous line (F,) through the spectrogram (Viterbi, linear cost of a change)."""
    score = spectrogram.log_likelihood * spectrogram.weight[:, None]
    step_hz = spectrogram.f_hz[1] - spectrogram.f_hz[0]
    hop_s = np.median(np.diff(spectrogram.t_ns)) / 1e9 if len(score) > 1 else 0.05
    reach = max(1, int(MAX_JUMP_HZ_PER_S * hop_s / step_hz))
    moves = np.arange(-reach, reach + 1)
    cost = JUMP_COST_PER_HZ * np.abs(moves) * step_hz
    bins = score.shape[1]
    back = np.zeros(score.shape, dtype=np.int32)
    best = score[0].copy()
    for k in range(1, len(score)):
        padded = np.pad(best, reach, constant_values=-np.inf)
        windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1) - cost
        choice = np.argmax(windows, axis=1)
        back[k] = np.clip(np.arange(bins) + moves[choice], 0, bins - 1)
        best = windows[np.arange(bins), choice] + score[k]
    path = np.empty(len(score), dtype=np.int64)
    path[-1] = int(np.argmax(best))
    for k in range(len(score) - 1, 0, -1):
        path[k - 1] = back[k, path[k]]
    return np.asarray(spectrogram.f_hz[path])


def path_length(spectrogram: Spectrogram, *, wavelength_m: float) -> PathLength:
    """Integrate PLCR = -lambda f along the ridge by the trapezoidal rule (7), (8)."""
    f_hz = ridge_hz(spectrogram)
    plcr_mps = -wavelength_m * f_hz
    t_s = (spectrogram.t_ns - spectrogram.t_ns[0]) / 1e9
    steps = 0.5 * (plcr_mps[1:] + plcr_mps[:-1]) * np.diff(t_s)
    return PathLength(spectrogram.t_ns, f_hz, np.concatenate([[0.0], np.cumsum(steps)]))
