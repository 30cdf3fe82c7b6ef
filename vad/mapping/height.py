"""How high a device stands, as far as walks tell: by how much it is above or below the walker's torso."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vad.mapping.doppler_search import DopplerSearch

FloatArray = NDArray[np.float64]

OFF_TORSO_M = np.array([0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.25])
"""The differences of height that are tried: no walk tells above from below."""
OFF_TORSO_SD_M2 = 0.03
LOWEST_M, HIGHEST_M, STEP_M = 0.0, 2.3, 0.05
"""Where devices stand: on the floor, on shelves, under the ceiling."""

CELLS = 40
SHARE = 0.9
TOLD_M = 1.4
"""A wider range than this says no more than that it is in the home."""


def height_log_likelihood(
    search: DopplerSearch, points_m: FloatArray, log_density: FloatArray, doppler: FloatArray, offset_s: float
) -> FloatArray | None:
    """log p(walk | the device is so far above or below the torso), (7,), for OFF_TORSO_M; up to a constant.

    points_m (G, 2), log_density (G,) of the device there, doppler (G,): the part of it that Doppler told with
    the height unknown; it is replaced by what Doppler tells with the height known, and the likeliest places
    are summed over. None where the known end's height is not known, or when asked to stop.
    """
    if search.anchor_z_m is None:
        return None
    best = np.argsort(log_density)[-CELLS:]
    rest = log_density[best] - doppler[best]
    found = []
    for off_m in OFF_TORSO_M.tolist():
        line = replace(search.model.line, device_m2=off_m**2, device_sd_m2=OFF_TORSO_SD_M2)
        told = replace(search, model=replace(search.model, line=line)).at(points_m[best], offset_s)
        if told is None:
            return None
        found.append(float(np.logaddexp.reduce(told + rest)))
    return np.asarray(found) - max(found)


def height_range_m(log_likelihood: FloatArray, torso_z_m: float) -> tuple[float, float] | None:
    """Lowest and highest of the heights above the floor that hold SHARE of the probability, metres.

    None where they are so far apart that nothing is told. Any height is as likely as another beforehand.
    """
    heights = np.arange(LOWEST_M, HIGHEST_M + 1e-9, STEP_M)
    log_weight = np.interp(np.abs(heights - torso_z_m), OFF_TORSO_M, log_likelihood)
    weight = np.exp(log_weight - log_weight.max())
    order = np.argsort(-weight, kind="stable")
    held = np.cumsum(weight[order]) / weight.sum()
    kept = heights[order[: int(np.searchsorted(held, SHARE)) + 1]]
    low, high = float(kept.min()), float(kept.max())
    return (low, high) if high - low <= TOLD_M else None
