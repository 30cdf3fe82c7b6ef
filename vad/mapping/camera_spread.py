"""How what was collected spreads over the floor, and which of it to use. Pure."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vad.geometry import FloatArray

_CELL_M = 0.25


def spread(xy_m: FloatArray) -> tuple[float, float]:
    """Area of the convex hull, m^2, and the standard deviation across the narrow direction, m, of (N, 2)."""
    known = xy_m[np.isfinite(xy_m[:, 0])]
    if len(known) < 3:
        return 0.0, 0.0
    width = float(np.sqrt(max(np.linalg.eigvalsh(np.cov(known.T))[0], 0.0)))
    return float(cv2.contourArea(cv2.convexHull(known.astype(np.float32)))), width


def spread_selection(xy_m: FloatArray, limit: int) -> NDArray[np.int64]:
    """Rows of (N, 2) positions, at most `limit`, taken round-robin from the cells of the floor; NaN left out.

    The first rows are as evenly spread as the whole, so a prefix is a smaller selection.
    """
    rows = np.flatnonzero(np.isfinite(xy_m[:, 0]))
    # A fixed permutation: within a cell early and late visits are taken alike, the same every time.
    rows = np.random.default_rng(0).permutation(rows)
    cells = np.floor(xy_m[rows] / _CELL_M).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    cell = cell.ravel()
    order = np.argsort(cell, kind="stable")
    first = np.searchsorted(cell[order], cell[order])
    visit = np.empty(len(rows), dtype=np.int64)
    visit[order] = np.arange(len(rows)) - first
    return np.asarray(rows[np.argsort(visit, kind="stable")][:limit], dtype=np.int64)


def best_of_each(frame: NDArray[np.int64], badness: FloatArray, limit: float) -> NDArray[np.int64]:
    """Rows of the least bad candidate of every frame, where it is below `limit`; (K,) in, rows out."""
    order = np.lexsort((np.where(np.isnan(badness), np.inf, badness), frame))
    _, first = np.unique(frame[order], return_index=True)
    best = order[first]
    return np.asarray(best[badness[best] < limit], dtype=np.int64)
