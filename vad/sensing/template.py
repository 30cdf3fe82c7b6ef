"""Packets aligned to what stands still: the NIC's phase noise removed without a reference (method.md 2).

Every packet carries one unknown complex gain (CFO, AGC) and one unknown phase slope over the subcarriers
(sampling offset), common to all antennas and streams. Both are fitted to the static template of all
antenna-subcarrier values; what remains after the template is subtracted is the moving part, one-sided.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vad.sensing.resample import without_outliers

ITERATIONS = 3

SUBCARRIERS_20_MHZ = np.array([*range(-28, 0, 2), -1, *range(1, 28, 2), 28], dtype=np.float64)
SUBCARRIERS_40_MHZ = np.array([*range(-58, 0, 4), *range(2, 59, 4)], dtype=np.float64)
"""Indices of the 30 subcarriers that the Intel 5300 reports (formats.md 2)."""


def subcarriers(bandwidth_mhz: int) -> NDArray[np.float64]:
    """Indices (30,) for a channel of 20 or 40 MHz."""
    return SUBCARRIERS_40_MHZ if bandwidth_mhz == 40 else SUBCARRIERS_20_MHZ


def moving_part(csi: NDArray[np.complex64], *, bandwidth_mhz: int = 20) -> NDArray[np.complex64]:
    """CSI complex (N, 30, R, T) -> (N, 30, R, T): what moves, in units of the static template.

    Outliers of each stream are clipped.
    """
    values = csi.reshape(len(csi), 30, -1)
    level = np.sqrt(np.mean(np.abs(values) ** 2, axis=(1, 2), keepdims=True))
    values = values / np.maximum(level, 1e-12)
    index = subcarriers(bandwidth_mhz)
    template = values[len(values) // 2]
    aligned = values
    for _ in range(ITERATIONS):
        aligned = _aligned(values, template, index)
        template = np.median(aligned.real, axis=0) + 1j * np.median(aligned.imag, axis=0)
    return without_outliers(aligned - template).reshape(csi.shape)


def _aligned(
    values: NDArray[np.complex64], template: NDArray[np.complex64], index: NDArray[np.float64]
) -> NDArray[np.complex64]:
    """Each packet (N, 30, S) without its own slope and gain against the template (30, S)."""
    correlation = np.sum(values * template.conj(), axis=2)
    usual = np.median(np.diff(index))
    neighbours = correlation[:, 1:] * correlation[:, :-1].conj()
    slope = np.angle(np.sum(neighbours[:, np.diff(index) == usual], axis=1)) / usual
    for _ in range(2):
        turned = correlation * np.exp(-1j * slope[:, None] * index)
        angle = np.angle(turned * np.sum(turned, axis=1, keepdims=True).conj())
        weight = np.abs(turned) + 1e-12
        centred = index - np.sum(weight * index, axis=1, keepdims=True) / weight.sum(axis=1, keepdims=True)
        slope = slope + np.sum(weight * centred * angle, axis=1) / np.sum(weight * centred**2, axis=1)
    turned_values = values * np.exp(-1j * slope[:, None] * index)[:, :, None]
    energy = np.sum(np.abs(template) ** 2)
    gain = np.sum(turned_values * template.conj(), axis=(1, 2)) / max(float(energy), 1e-12)
    weak = np.abs(gain) < 1e-3  # a packet that has nothing of the template tells nothing
    gain = np.where(weak, 1.0, gain)
    result = turned_values / gain[:, None, None]
    result[weak] = template
    return np.asarray(result, dtype=np.complex64)
