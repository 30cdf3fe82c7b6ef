"""Algorithm 1: the fast sum is the pair sum, and noiseless data give the place."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vad.mapping.paper import THRESHOLD_OFFICE_M, algorithm_1, pair_error
from vad.mapping.posterior import Grid

residuals = st.lists(st.floats(-20, 20, allow_nan=False), min_size=0, max_size=40)


@given(residuals, st.floats(0.0, 5.0))
def test_the_fast_sum_is_the_sum_over_pairs(values: list[float], threshold_m: float) -> None:
    r = np.array(values)
    gaps = np.abs(r[:, None] - r[None, :])
    upper = np.triu_indices(len(r), 1)
    pairs = gaps[upper]
    # A gap within rounding of the threshold may fall on either side.
    near = np.abs(pairs - threshold_m) < 1e-9
    expected = pairs[(pairs >= threshold_m) & ~near].sum()
    assert pair_error(r, threshold_m) == pytest.approx(expected, abs=1e-6 + pairs[near].sum())


def test_noiseless_path_lengths_lead_to_the_device() -> None:
    t = np.linspace(0, 2 * np.pi, 80)
    walk = np.stack([2.5 + 1.5 * np.cos(t), 2.0 + 1.2 * np.sin(t)], axis=1)
    anchor, device = np.array([0.0, 0.0]), np.array([4.0, 3.0])
    plc = np.linalg.norm(walk - anchor, axis=1) + np.linalg.norm(walk - device, axis=1)
    grid = Grid.over((-1.0, -1.0, 6.0, 6.0), 0.1)
    answer, error = algorithm_1(plc - plc[0], walk, anchor, grid, threshold_m=0.05)
    order = np.argsort(error, axis=None)
    assert np.linalg.norm(grid.points_m[order[0]] - device) < 0.15
    # The published answer averages the best 5 %, which lie along the hyperbolas' bundle.
    assert answer == pytest.approx(grid.points_m[order[: round(0.05 * error.size)]].mean(axis=0), abs=0.02)


def test_with_everything_below_the_threshold_all_candidates_are_equal() -> None:
    grid = Grid.over((0.0, 0.0, 1.0, 1.0), 0.5)
    _, error = algorithm_1(np.zeros(5), np.zeros((5, 2)), np.zeros(2), grid, threshold_m=THRESHOLD_OFFICE_M)
    assert np.all(error == 0)
