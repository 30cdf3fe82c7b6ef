"""The paper's Algorithm 1: hyperbolas between all pairs of instants, over a grid of candidates.

With r_i(R) = plc_i - (|P_i T| + |P_i R|) the residual of (10)-(12) for a pair is r_i - r_j, and
e(R) = sum over pairs of F(r_i - r_j), F(x) = |x| where |x| >= threshold, else 0. The printed F keeps the
sign of x; summed over pairs it would cancel, so it is read as |x| (method.md 1).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vad.mapping.posterior import Grid

FloatArray = NDArray[np.float64]

THRESHOLD_OFFICE_M = 1.1
THRESHOLD_OPEN_SPACE_M = 2.3
BEST_SHARE = 0.05


def pair_error(residual_m: FloatArray, threshold_m: float) -> float:
    """sum over i < j of |r_i - r_j| where that is >= threshold_m; residual_m (N,); O(N log N).

    Sorted, a pair that counts is r_j with every r_i <= r_j - threshold, so prefix sums give its part.
    """
    r = np.sort(residual_m)
    prefix = np.concatenate([[0.0], np.cumsum(r)])
    partners = np.searchsorted(r, r - threshold_m, side="right")
    if threshold_m <= 0:
        partners = np.arange(len(r))
    return float(np.sum(partners * r - prefix[partners]))


def algorithm_1(
    plc_m: FloatArray, walk_m: FloatArray, anchor_m: FloatArray, grid: Grid, *, threshold_m: float
) -> tuple[FloatArray, FloatArray]:
    """The paper's answer (2,) m: the mean of the best 5 % of candidates; and e(R) as (rows, columns).

    plc_m (N,): path length change at N instants; walk_m (N, 2): the walker then; anchor_m (2,): T. Map frame.
    """
    points = grid.points_m
    to_anchor = np.linalg.norm(walk_m - anchor_m, axis=1)
    error = np.empty(len(points))
    for k, candidate in enumerate(points):
        to_candidate = np.linalg.norm(walk_m - candidate, axis=1)
        error[k] = pair_error(plc_m - to_anchor - to_candidate, threshold_m)
    best = np.argsort(error, kind="stable")[: max(1, round(BEST_SHARE * len(points)))]
    return points[best].mean(axis=0), error.reshape(grid.rows, grid.columns)
