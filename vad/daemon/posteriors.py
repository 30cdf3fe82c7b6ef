"""What walks say of a device, as the store keeps it."""

from __future__ import annotations

import numpy as np

from vad.mapping.device_stage import PlaceEstimate
from vad.mapping.evidence import Terms
from vad.mapping.plan_match import PlanTransform
from vad.mapping.posterior import Grid, Posterior
from vad.mapping.reanchor import moved_posterior
from vad.robot.floor_plan import FloorPlan
from vad.store.records import Estimate, PosteriorRecord

METHOD = "spectrogram-likelihood"


def estimate_of(place: PlaceEstimate, plan: FloorPlan, height90_m: tuple[float, float] | None) -> Estimate:
    """A place as the store keeps it, with its room. height90_m: where 90 % of its heights are."""
    x_m, y_m = (float(v) for v in place.xy_m)
    (a, b), (_, c) = place.covariance_m2.tolist()
    outline = place.region90_m[0] if place.region90_m else np.empty((0, 2))
    return Estimate(
        x_m,
        y_m,
        ((a, b), (b, c)),
        place.radius90_m,
        tuple((float(x), float(y)) for x, y in outline),
        plan.room_at(x_m, y_m),
        METHOD,
        height90_m,
    )


def terms_of(stored: PosteriorRecord) -> Terms:
    """A stored posterior as terms to compute with."""
    rows, columns = stored.log_posterior.shape
    half = stored.step_m / 2
    grid = Grid(stored.bounds_m[0] + half, stored.bounds_m[1] + half, stored.step_m, columns, rows)
    told = stored.log_posterior.astype(np.float64).ravel()
    heard = np.zeros_like(told) if stored.log_heard is None else stored.log_heard.astype(np.float64).ravel()
    height = None if stored.height is None else np.array(stored.height)
    return Terms(grid, stored.walks, told, heard, height=height)


def stored_terms(mac: str, epoch: int, terms: Terms, updated_at: str) -> PosteriorRecord:
    """Compact terms as the store keeps them. updated_at: RFC 3339."""
    shape = terms.grid.rows, terms.grid.columns
    return PosteriorRecord(
        mac,
        epoch,
        outer_edges(terms.grid),
        terms.grid.step_m,
        terms.walks,
        (terms.doppler - terms.doppler.max()).astype(np.float32).reshape(shape),
        updated_at,
        terms.heard.astype(np.float32).reshape(shape),
        None if terms.height is None else tuple(terms.height.tolist()),
    )


def moved_terms(terms: Terms, transform: PlanTransform, grid: Grid) -> Terms:
    """Compact terms on a grid of the new frame."""
    shape = terms.grid.rows, terms.grid.columns
    told, heard = (
        moved_posterior(Posterior(terms.grid, part.reshape(shape)), transform, grid).log_density.ravel()
        for part in (terms.doppler, terms.heard)
    )
    return Terms(grid, terms.walks, told, heard, height=terms.height)


def outer_edges(grid: Grid) -> tuple[float, float, float, float]:
    """x0, y0, x1, y1 of the outer edges of the outer cells."""
    x0, y0, x1, y1 = grid.bounds_m
    half = grid.step_m / 2
    return x0 - half, y0 - half, x1 + half, y1 + half
