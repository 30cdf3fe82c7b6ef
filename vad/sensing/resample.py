"""CSI at the packets' own times -> streams on a uniform clock, free of the NIC's phase noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

RATE_HZ = 200.0
"""The uniform clock: walking reflections stay below 60 Hz at 5 GHz."""

CUTOFF_HZ = 80.0
MAX_GAP_S = 0.06
"""Longer holes in the packets are not bridged: the frames that they touch carry no weight."""

CLIP_MEDIANS = 6.0


@dataclass(frozen=True, slots=True)
class UniformStreams:
    """t_ns int64 (M,) timeline, every 1/RATE_HZ; values complex64 (M, S); covered bool (M,): packets near."""

    t_ns: NDArray[np.int64]
    values: NDArray[np.complex64]
    covered: NDArray[np.bool_]


def antenna_ratio(csi: NDArray[np.complex64]) -> NDArray[np.complex64]:
    """Each other antenna divided by the strongest, per packet: what chains share (CFO, AGC) cancels.

    csi: complex (N, 30, R, T), R >= 2. Returns complex64 (N, S), S = (R - 1) * 30 * T. Outliers, where
    the reference fades, are clipped at CLIP_MEDIANS times the stream's median modulus.
    """
    power = np.mean(np.abs(csi) ** 2, axis=(0, 1, 3))
    reference = int(np.argmax(power))
    others = [r for r in range(csi.shape[2]) if r != reference]
    base = csi[:, :, reference : reference + 1, :]
    tiny = np.float32(1e-3 * np.sqrt(np.mean(np.abs(base) ** 2)) + 1e-12)
    ratio = csi[:, :, others, :] * base.conj() / np.maximum(np.abs(base) ** 2, tiny**2)
    return without_outliers(ratio.reshape(len(csi), -1))


def without_outliers(values: NDArray[np.complex64]) -> NDArray[np.complex64]:
    """Values (N, ...) clipped in modulus at CLIP_MEDIANS times their stream's median over axis 0."""
    modulus = np.abs(values)
    limit = CLIP_MEDIANS * np.median(modulus, axis=0, keepdims=True)
    return np.asarray(values * np.minimum(1.0, limit / np.maximum(modulus, 1e-12)), dtype=np.complex64)


def to_uniform(t_ns: NDArray[np.int64], values: NDArray[np.complex64]) -> UniformStreams:
    """Streams (N, S) at increasing packet times t_ns (N,) -> a uniform clock, low-passed without delay.

    Packets are first averaged onto a fine clock of 2 * RATE_HZ by linear interpolation (as the packet
    rate is about that), then a zero-phase low-pass of CUTOFF_HZ takes them to RATE_HZ.
    """
    fine_hz = 2 * RATE_HZ
    span_s = (t_ns[-1] - t_ns[0]) / 1e9
    count = max(4, int(span_s * fine_hz) + 1)
    at_s = np.arange(count) / fine_hz
    packet_s = (t_ns - t_ns[0]) / 1e9
    right = np.clip(np.searchsorted(packet_s, at_s, side="left"), 1, len(packet_s) - 1)
    left = right - 1
    gap_s = packet_s[right] - packet_s[left]
    weight = np.clip((at_s - packet_s[left]) / np.maximum(gap_s, 1e-9), 0, 1).astype(np.float32)[:, None]
    fine = values[left] * (1 - weight) + values[right] * weight
    spectrum = np.fft.fft(fine, axis=0)
    f_hz = np.abs(np.fft.fftfreq(count, 1 / fine_hz))
    edge_hz = 10.0
    taper = 0.5 * (1 + np.cos(np.pi * np.clip((f_hz - CUTOFF_HZ) / edge_hz, 0, 1)))
    low = np.fft.ifft(spectrum * taper[:, None], axis=0)
    uniform_t_ns = t_ns[0] + np.round(at_s[::2] * 1e9).astype(np.int64)
    return UniformStreams(uniform_t_ns, low[::2].astype(np.complex64), (gap_s <= MAX_GAP_S)[::2])
