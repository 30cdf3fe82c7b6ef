"""Does a new walk say the same place as all walks before it? Pure: two posteriors in, a number out."""

from __future__ import annotations

import cv2
import numpy as np

from vad.mapping.posterior import Posterior

SHARED_SIGMA_M = 0.25
"""Walks of one device at one place differ by more than their own posteriors say: by this much."""
CONTRADICTS = -2.3
"""Below this log ratio, the device is ten times as likely somewhere else as where it was."""


def log_agreement(before: Posterior, walk: Posterior) -> float:
    """log p(walk | the device is where it was) - log p(walk | it may be anywhere on the map, all alike).

    Positive: they agree, the more the sharper both are. About 0: one of them says nothing. Negative: they
    contradict each other. ValueError for posteriors on different grids.
    """
    if before.grid != walk.grid:
        raise ValueError("posteriors on different grids cannot be compared")
    sigma = SHARED_SIGMA_M / walk.grid.step_m
    blurred = cv2.GaussianBlur(walk.probability, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
    overlap = float(np.sum(before.probability * blurred) / blurred.sum())
    return float(np.log(max(overlap, 1e-300)) + np.log(blurred.size))


def contradicts(before: Posterior, walk: Posterior) -> bool:
    """Whether the walk places the device elsewhere."""
    return log_agreement(before, walk) < CONTRADICTS
