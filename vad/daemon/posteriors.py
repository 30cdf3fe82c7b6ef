"""Posteriors as the store keeps them."""

from __future__ import annotations

import numpy as np

from vad.mapping.posterior import Grid, Posterior
from vad.store.records import PosteriorRecord


def posterior_of(stored: PosteriorRecord) -> Posterior:
    """A stored posterior as one to compute with."""
    rows, columns = stored.log_posterior.shape
    half = stored.step_m / 2
    grid = Grid(stored.bounds_m[0] + half, stored.bounds_m[1] + half, stored.step_m, columns, rows)
    return Posterior(grid, stored.log_posterior.astype(np.float64))


def outer_edges(grid: Grid) -> tuple[float, float, float, float]:
    """x0, y0, x1, y1 of the outer edges of the outer cells."""
    x0, y0, x1, y1 = grid.bounds_m
    half = grid.step_m / 2
    return x0 - half, y0 - half, x1 + half, y1 + half
