"""Where the walker's echo comes from, seen by the antennas at the unknown end (method.md 3, term A).

The antennas' places are unknown: for each pair of antennas the baseline vector that explains the phases
best is taken for each candidate, with a prior on its length. The constant phase between two receive chains
drops out in the modulus of the sum.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vad.mapping.walk import WalkTrack
from vad.sensing.arrival import ArrivalPhases

FloatArray = NDArray[np.float64]

BASELINE_SIGMA_M = 0.06
BASELINE_LIMIT_M = 0.12
BASELINE_STEP_M = 0.02
GAIN = 0.4
PAIR_SHARE = 2 / 3
"""Three pairs of three antennas hold two independent phases."""

_CHUNK = 256


def arrival_sums(
    phases: ArrivalPhases, walk: WalkTrack, points_m: FloatArray, *, wavelength_m: float
) -> NDArray[np.float32]:
    """|sum over t of g exp(-i 2 pi / lambda b . u_R)|, (G, P, B, B): candidates points_m (G, 2), pairs, and
    baselines b along x and y. Sums of several walks of one device add: its antennas stay where they are."""
    steps = baselines_m()
    inside = walk.covers(phases.t_ns)
    result = np.zeros((len(points_m), len(phases.coherence), len(steps), len(steps)), dtype=np.float32)
    if not inside.any():
        return result
    position = walk.position_m(phases.t_ns[inside])
    coherence = phases.coherence[:, inside]
    wave = (-1j * 2 * np.pi / wavelength_m * steps)[None, :, None]
    for start in range(0, len(points_m), _CHUNK):
        offset = position[None] - points_m[start : start + _CHUNK, None]
        direction = offset / (np.linalg.norm(offset, axis=2, keepdims=True) + 1e-3)
        by_x = np.exp(wave * direction[:, None, :, 0]).astype(np.complex64)
        by_y = np.exp(wave * direction[:, None, :, 1]).astype(np.complex64).transpose(0, 2, 1)
        for k, pair in enumerate(coherence):
            result[start : start + _CHUNK, k] = np.abs(np.matmul(by_x * pair[None, None], by_y))
    return result


def arrival_log_likelihood(sums: NDArray[np.float32], *, weight: float = 1.0) -> FloatArray:
    """log-likelihood (G,) up to a constant from `arrival_sums`, of which `weight` counts."""
    steps = baselines_m()
    prior = (steps[:, None] ** 2 + steps[None, :] ** 2) / (2 * BASELINE_SIGMA_M**2)
    best = (weight * GAIN * sums - prior).max(axis=(2, 3))
    return np.asarray(PAIR_SHARE * best.sum(axis=1), dtype=np.float64)


def baselines_m() -> FloatArray:
    """The baseline components tried along each axis, metres."""
    return np.arange(-BASELINE_LIMIT_M, BASELINE_LIMIT_M + 1e-9, BASELINE_STEP_M)
