"""Posterior: what is said from a grid is true of the grid."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vad.mapping.device_stage import place_from_posterior
from vad.mapping.evidence import DOPPLER_CORRELATION, Terms
from vad.mapping.posterior import Grid, Posterior

GRID = Grid.over((-3.0, -2.0, 5.0, 4.0), 0.1)


def gaussian(x_m: float, y_m: float, sigma_m: float) -> Posterior:
    offset = GRID.points_m - np.array([x_m, y_m])
    log_density = -0.5 * (offset**2).sum(axis=1) / sigma_m**2
    return Posterior(GRID, log_density.reshape(GRID.rows, GRID.columns))


@given(st.floats(-1.0, 3.0), st.floats(-0.5, 2.5), st.floats(0.15, 0.5))
@settings(max_examples=30)
def test_a_gaussian_keeps_its_mean_and_covariance(x_m: float, y_m: float, sigma_m: float) -> None:
    place = place_from_posterior(gaussian(x_m, y_m, sigma_m))
    assert place.xy_m == pytest.approx([x_m, y_m], abs=0.02)
    assert np.sqrt(np.diag(place.covariance_m2)) == pytest.approx([sigma_m, sigma_m], rel=0.1)
    # 90 % of a round Gaussian lies within 2.146 sigma.
    assert place.radius90_m == pytest.approx(2.146 * sigma_m, abs=0.08)
    assert place.status == "located"


@given(st.floats(0.05, 0.99))
@settings(max_examples=20)
def test_a_region_holds_what_it_says_and_not_more_than_a_cell_more(share: float) -> None:
    posterior = gaussian(1.0, 1.0, 0.4)
    held = posterior.probability[posterior.region(share)]
    assert held.sum() >= share - 1e-9
    assert held.sum() - held.min() <= share + 1e-9


def test_the_outline_of_a_region_goes_around_its_cells() -> None:
    posterior = gaussian(1.0, 1.0, 0.4)
    (outline,) = posterior.region_polygons_m(0.9)
    radius = np.linalg.norm(outline - [1.0, 1.0], axis=1)
    assert radius.min() > 0.7
    assert radius.max() < 1.05


def test_two_far_peaks_are_two_outlines_and_no_place() -> None:
    left, right = gaussian(-2.0, 0.0, 0.2), gaussian(4.0, 3.0, 0.2)
    both = Posterior(GRID, np.logaddexp(left.log_density, right.log_density))
    assert len(both.region_polygons_m(0.9)) == 2
    assert place_from_posterior(both).status == "uncertain"


def test_fusing_multiplies_and_refuses_another_grid() -> None:
    fused = gaussian(0.0, 0.0, 0.4).fused(gaussian(1.0, 0.0, 0.4))
    mean, covariance = fused.mean_and_covariance()
    assert mean == pytest.approx([0.5, 0.0], abs=0.01)
    assert covariance[0, 0] == pytest.approx(0.08, rel=0.05)
    with pytest.raises(ValueError, match="different grids"):
        fused.fused(Posterior(Grid.over((0, 0, 1, 1), 0.1), np.zeros((11, 11))))


def test_correlated_walks_count_as_fewer_and_loudness_once() -> None:
    told = gaussian(0.0, 0.0, 0.4).log_density.ravel()
    one = Terms(GRID, 1, told, np.log(1 / (1 + GRID.points_m[:, 0] ** 2)))
    four = one.plus(one).plus(one).plus(one)
    _, covariance = four.posterior(GRID).mean_and_covariance()
    assert 0.16 / 4 < covariance[1, 1] < 0.16
    assert four.log_density() - (1 / (1 + 3 * DOPPLER_CORRELATION)) * four.doppler == pytest.approx(one.heard)


def test_compact_terms_say_what_the_whole_ones_say() -> None:
    coarse = Grid.over(GRID.bounds_m, 0.2)
    told = -((coarse.points_m - [0.5, 0.2]) ** 2).sum(axis=1)
    sums = np.random.default_rng(1).uniform(0, 3, size=(len(told), 3, 13, 13)).astype(np.float32)
    whole = Terms(coarse, 1, told, 0.1 * told, sums, np.array([0.0, -1, -2, -3, -4, -5, -6]))
    compact = whole.compact(GRID)
    assert compact.arrival is None
    assert compact.posterior(GRID).probability == pytest.approx(whole.posterior(GRID).probability, abs=1e-4)
    assert compact.height_range_m() == whole.height_range_m()
