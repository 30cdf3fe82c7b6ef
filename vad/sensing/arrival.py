"""The walker's echo per antenna pair: phases that tell its direction, up to where the antennas are."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from vad.sensing.resample import RATE_HZ, UniformStreams
from vad.sensing.spectrogram import HOP_S, WINDOW_S

MIN_RIDGE_HZ = 4.0
"""Nearer to zero the echo cannot be told from what stands still."""

BAND_HZ = 3.0
FRAME_STRIDE = 2


@dataclass(frozen=True, slots=True)
class ArrivalPhases:
    """t_ns int64 (K,): frames in which the echo stands clear of zero; coherence complex64 (P, K): for each
    pair of antennas the echo's cross-correlation, modulus 0..1, phase 2 pi / lambda times the projection of
    the pair's baseline on the direction to the echo, plus a constant of the two receive chains."""

    t_ns: NDArray[np.int64]
    coherence: NDArray[np.complex64]


def arrival_phases(
    streams: UniformStreams, antennas: int, frame_t_ns: NDArray[np.int64], ridge_hz: NDArray[np.float64]
) -> ArrivalPhases:
    """Cross-correlate the antennas around the ridge (method.md 3, term A).

    streams: of moving_part, values (M, 30 * antennas * T) in the order (30, antennas, T); frame_t_ns and
    ridge_hz (F,): frame centres of the spectrogram made from the same clock, and the ridge there.
    """
    width, hop = round(WINDOW_S * RATE_HZ), round(HOP_S * RATE_HZ)
    values = streams.values.reshape(len(streams.values), 30, antennas, -1)
    hann = np.hanning(width).astype(np.float32)[:, None, None, None]
    time_s = np.arange(width) / RATE_HZ
    offsets_hz = np.arange(-BAND_HZ, BAND_HZ + 1e-9, 0.4)
    pairs = list(combinations(range(antennas), 2))
    kept, rows = [], []
    for k in range(0, len(frame_t_ns), FRAME_STRIDE):
        window = values[k * hop : k * hop + width]
        if abs(ridge_hz[k]) <= MIN_RIDGE_HZ or len(window) < width:
            continue
        if not streams.covered[k * hop : k * hop + width].all():
            continue
        turn = np.exp(-2j * np.pi * (ridge_hz[k] + offsets_hz)[:, None] * time_s).astype(np.complex64)
        echo = np.tensordot(turn, (window - window.mean(axis=0)) * hann, axes=1)
        power = np.maximum(np.sum(np.abs(echo) ** 2, axis=(0, 1, 3)), 1e-20)
        rows.append([np.vdot(echo[:, :, b], echo[:, :, a]) / np.sqrt(power[a] * power[b]) for a, b in pairs])
        kept.append(k)
    coherence = np.array(rows, dtype=np.complex64).reshape(len(kept), len(pairs)).T
    return ArrivalPhases(frame_t_ns[kept], coherence)
