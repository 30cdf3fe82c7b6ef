"""Streams on a uniform clock -> a one-sided Doppler spectrogram and its log-likelihood (method.md 2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vad.sensing.resample import RATE_HZ, UniformStreams

WINDOW_S = 0.4
HOP_S = 0.05
MAX_DOPPLER_HZ = 60.0
SMOOTHING_HZ = 1.5
SIGNAL_SHARE = 0.85
"""l = log(0.85 N P + 0.15): a frame may hold no ridge of the walker at all in 15 % of cases."""

_FFT = 512
_SILENCE = 1e-12


@dataclass(frozen=True, slots=True)
class Spectrogram:
    """Doppler over time.

    t_ns int64 (F,): frame centres on the timeline; f_hz (B,): ascending, -MAX_DOPPLER_HZ..; the path length
    change rate is -lambda * f_hz. power (F, B): smoothed, mean 1 in each frame; log_likelihood (F, B):
    log(SIGNAL_SHARE * power + 1 - SIGNAL_SHARE); weight (F,): 0..1, the share of the window that packets
    cover (0 where there was a hole). level_db (F,): how loud what moves is, from an unknown zero on.
    """

    t_ns: NDArray[np.int64]
    f_hz: NDArray[np.float64]
    power: NDArray[np.float64]
    log_likelihood: NDArray[np.float64]
    weight: NDArray[np.float64]
    level_db: NDArray[np.float64]


def combined(first: Spectrogram, second: Spectrogram) -> Spectrogram:
    """Two views of the same frames: the mean of their powers and of their log-likelihoods, the second's
    level."""
    return Spectrogram(
        first.t_ns,
        first.f_hz,
        (first.power + second.power) / 2,
        (first.log_likelihood + second.log_likelihood) / 2,
        np.minimum(first.weight, second.weight),
        second.level_db,
    )


def spectrogram(streams: UniformStreams) -> Spectrogram:
    """Short-time Fourier transform: Hann WINDOW_S every HOP_S, each window's mean removed, each stream's
    frame normalised before the average, so that no antenna-subcarrier speaks louder than another."""
    deviation = np.std(streams.values, axis=0)
    live = deviation > 1e-9
    values = streams.values[:, live] / deviation[live]
    width = round(WINDOW_S * RATE_HZ)
    hop = round(HOP_S * RATE_HZ)
    starts = np.arange(0, max(1, len(values) - width + 1), hop)
    hann = np.hanning(width).astype(np.float32)[:, None]
    f_all = np.fft.fftfreq(_FFT, 1 / RATE_HZ)
    keep = np.flatnonzero(np.abs(f_all) <= MAX_DOPPLER_HZ)
    keep = keep[np.argsort(f_all[keep])]
    power = np.zeros((len(starts), len(keep)))
    weight = np.zeros(len(starts))
    level = np.full(len(starts), _SILENCE)
    for k, start in enumerate(starts):
        window = values[start : start + width]
        if len(window) < width:
            continue
        weight[k] = streams.covered[start : start + width].mean()
        moving = window - window.mean(axis=0)
        level[k] = max(_SILENCE, float(np.mean(np.abs(moving) ** 2)))
        spectrum = np.fft.fft(moving * hann, n=_FFT, axis=0)[keep]
        energy = np.abs(spectrum) ** 2
        total = energy.sum(axis=0)
        good = total > 0
        if good.any():
            power[k] = np.mean(energy[:, good] / total[good], axis=1)
    f_hz = np.asarray(f_all[keep], dtype=np.float64)
    power = _smooth(power, f_hz) * len(keep)
    weight = np.where(weight > 0.8, weight, 0.0)
    log_likelihood = np.log(SIGNAL_SHARE * power + 1 - SIGNAL_SHARE)
    centres = np.minimum(starts + width // 2, len(streams.t_ns) - 1)
    level_db = 10 * np.log10(level)
    return Spectrogram(streams.t_ns[centres], f_hz, power, log_likelihood, weight, level_db)


def _smooth(power: NDArray[np.float64], f_hz: NDArray[np.float64]) -> NDArray[np.float64]:
    """A Hann kernel of SMOOTHING_HZ half-width over frequency."""
    step_hz = f_hz[1] - f_hz[0]
    half = max(1, round(SMOOTHING_HZ / step_hz))
    kernel = np.hanning(2 * half + 1)
    kernel /= kernel.sum()
    return np.apply_along_axis(lambda row: np.convolve(row, kernel, mode="same"), 1, power)
