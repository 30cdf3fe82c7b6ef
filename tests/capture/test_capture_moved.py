"""Two posteriors agree, contradict each other, or say nothing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vad.capture.moved import CONTRADICTS, contradicts, log_agreement
from vad.mapping.posterior import Grid, Posterior

GRID = Grid.over((0.0, 0.0, 8.0, 5.0), 0.1)


def at(x_m: float, y_m: float, sigma_m: float, grid: Grid = GRID) -> Posterior:
    square = ((grid.points_m - (x_m, y_m)) ** 2).sum(axis=1)
    return Posterior(grid, (-square / (2 * sigma_m**2)).reshape(grid.rows, grid.columns))


def test_the_same_place_agrees_and_another_room_contradicts() -> None:
    known = at(2.0, 2.0, 0.25)
    assert log_agreement(known, at(2.2, 1.9, 0.3)) > 2.0
    assert not contradicts(known, at(2.5, 2.3, 0.3)), "0.6 m are within what walks differ by"
    assert contradicts(known, at(6.0, 2.0, 0.3))


def test_a_walk_that_says_little_contradicts_nothing() -> None:
    assert not contradicts(at(2.0, 2.0, 0.25), at(4.5, 3.0, 2.0))
    assert not contradicts(at(2.0, 2.0, 3.0), at(6.0, 3.0, 0.3))
    assert log_agreement(at(1.0, 1.0, 0.2), at(4.0, 2.5, 60.0)) == pytest.approx(0.0, abs=0.1)


def test_posteriors_that_never_overlap_are_a_number_too() -> None:
    hard = Posterior(GRID, np.where(at(1, 1, 0.1).probability > 1e-12, 0.0, -1e9))
    assert np.isfinite(log_agreement(hard, at(7.0, 4.0, 0.1)))
    assert contradicts(hard, at(7.0, 4.0, 0.1))


def test_different_grids_are_refused() -> None:
    with pytest.raises(ValueError, match="different grids"):
        log_agreement(at(1, 1, 0.2), at(1, 1, 0.2, Grid.over((0.0, 0.0, 8.0, 5.0), 0.2)))


@given(st.floats(0.2, 0.5), st.floats(0.2, 0.5), st.floats(0, 1), st.floats(0, 2 * np.pi))
def test_false_alarms_are_rare(before_m: float, walk_m: float, share: float, angle: float) -> None:
    """Two estimates that miss each other by up to three of their joint standard deviations still agree."""
    off = 3.0 * share * float(np.hypot(before_m, walk_m))
    walk = at(4.0 + off * np.cos(angle), 2.5 + off * np.sin(angle), walk_m)
    assert log_agreement(at(4.0, 2.5, before_m), walk) > CONTRADICTS
