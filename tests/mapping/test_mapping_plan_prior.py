"""What the floor plan says of a device's place before anything is measured."""

from __future__ import annotations

import numpy as np

from vad.mapping.plan_prior import OPEN_FLOOR_NATS, OUTSIDE_NATS, plan_log_prior
from vad.mapping.posterior import Grid, Posterior
from vad.robot.floor_plan import FREE, OCCUPIED, UNKNOWN, FloorPlan
from vad.solve import on_plan, plan_prior

FINE = Grid.over((0.0, 0.0, 8.0, 6.0), 0.05)
GRID = Grid.over((0.0, 0.0, 8.0, 6.0), 0.1)


def room() -> np.ndarray[tuple[int, int], np.dtype[np.bool_]]:
    """A room from (1, 1) to (7, 5): free inside, not free outside."""
    x, y = FINE.points_m.T
    return ((x > 1) & (x < 7) & (y > 1) & (y < 5)).reshape(FINE.rows, FINE.columns)


def at(prior: np.ndarray[tuple[int, ...], np.dtype[np.float64]], x_m: float, y_m: float) -> float:
    return float(prior[round(y_m / GRID.step_m), round(x_m / GRID.step_m)])


def test_walls_are_likelier_than_the_middle_of_the_floor_and_outside_is_unlikely() -> None:
    prior = plan_log_prior(room(), FINE, GRID)
    assert at(prior, 1.2, 3.0) == 0
    assert at(prior, 4.0, 3.0) < -0.9 * OPEN_FLOOR_NATS
    assert at(prior, 0.8, 3.0) == 0, "a shelf may hide the floor"
    assert at(prior, 0.0, 0.0) < -0.5 * OUTSIDE_NATS
    assert prior.min() >= -(OPEN_FLOOR_NATS + OUTSIDE_NATS) - 0.1, "evidence may overcome it"


def test_a_plan_that_tells_nothing_changes_nothing() -> None:
    for free in (np.zeros_like(room()), np.ones_like(room())):
        assert not plan_log_prior(free, FINE, GRID).any()


def test_a_region_half_outside_is_drawn_into_the_home() -> None:
    cells = np.full((120, 160), UNKNOWN, dtype=np.int8)
    cells[20:100, 20:140] = FREE
    cells[20:100, 138:140] = OCCUPIED
    plan = FloorPlan(1, 0.05, (0.0, 0.0, 0.0), cells)
    prior = plan_prior(plan, GRID)
    off = GRID.points_m - np.array([7.3, 3.0])
    wide = Posterior(GRID, (-0.5 * (off**2).sum(axis=1)).reshape(GRID.rows, GRID.columns))
    before, after = wide.mean_and_covariance()[0], on_plan(wide, prior).mean_and_covariance()[0]
    assert after[0] < before[0]
    sharp = Posterior(GRID, (-0.5 * (off**2).sum(axis=1) / 0.1**2).reshape(GRID.rows, GRID.columns))
    assert np.linalg.norm(on_plan(sharp, prior).mean_and_covariance()[0] - [7.3, 3.0]) < 0.05
