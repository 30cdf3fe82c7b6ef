"""Session folders -> places: the one way that the daemon and `vad replay` share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vad.capture.session import Session, load_session, wrong_bounds
from vad.errors import SessionError
from vad.mapping.device_stage import (
    Evidence,
    PlaceEstimate,
    Recording,
    evidence_from_walk,
    paper_estimate,
    place_from_posterior,
)
from vad.mapping.evidence import Terms
from vad.mapping.plan_prior import plan_log_prior
from vad.mapping.posterior import Bounds, Grid, Posterior
from vad.mapping.walk import WalkTrack
from vad.robot.floor_plan import FREE, OCCUPIED, FloorPlan

FloatArray = NDArray[np.float64]

GRID_STEP_M = 0.1
PAPER_GRID_STEP_M = 0.2
MAX_SPAN_S = 600.0
"""A capture takes half a minute; times that are further apart are broken, and would only fill the memory."""

PLAN_STEP_M = 0.05
"""Finer than a wall."""

MARGIN_WITHOUT_MAP_M = 4.0
"""A session without map bounds: the device is looked for this far around the walk and the anchor."""


@dataclass(frozen=True, slots=True)
class Solved:
    """One session solved. paper_m: Algorithm 1's answer (2,), None where refused."""

    session: Session
    evidence: Evidence
    place: PlaceEstimate | None
    paper_m: FloatArray | None

    @property
    def height90_m(self) -> tuple[float, float] | None:
        """Lowest and highest height of the device, 90 %; None where it is not told."""
        return None if self.evidence.terms is None else self.evidence.terms.height_range_m()

    @property
    def error_m(self) -> float | None:
        """Distance of the likelihood estimate from the truth, where that is known."""
        return _error(None if self.place is None else self.place.xy_m, self.session.truth_m)

    @property
    def paper_error_m(self) -> float | None:
        """Distance of the paper's estimate from the truth, where that is known."""
        return _error(self.paper_m, self.session.truth_m)


@dataclass(frozen=True, slots=True)
class Fused:
    """Several sessions of one device, multiplied."""

    device: str
    sessions: tuple[str, ...]
    place: PlaceEstimate
    truth_m: FloatArray | None
    height90_m: tuple[float, float] | None = None

    @property
    def error_m(self) -> float | None:
        """Distance from the truth, where that is known."""
        return _error(self.place.xy_m, self.truth_m)


def _error(place_m: FloatArray | None, truth_m: FloatArray | None) -> float | None:
    if place_m is None or truth_m is None:
        return None
    return float(np.linalg.norm(place_m - truth_m))


def walk_of(session: Session) -> WalkTrack:
    """The session's walker as the Wi-Fi stage takes it."""
    return WalkTrack(session.walk_t_ns, session.walk_xy_m, session.walk_sigma_m)


def bounds_of(session: Session) -> Bounds:
    """Where the device may be: the map's bounds, else a margin around all that is known."""
    if session.header.map.bounds_m is not None:
        return session.header.map.bounds_m
    anchor = np.array([[session.header.anchor.x_m, session.header.anchor.y_m]])
    known = np.concatenate([session.walk_xy_m, anchor])
    low, high = known.min(axis=0) - MARGIN_WITHOUT_MAP_M, known.max(axis=0) + MARGIN_WITHOUT_MAP_M
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def solve_session(
    folder: Path, bounds_m: Bounds | None = None, should_stop: Callable[[], bool] = lambda: False
) -> Solved:
    """Load and solve one folder; SessionError where it cannot even be read.

    Blocking, about a second of work: call it in a thread; it gives up soon after `should_stop` says so.
    """
    session = load_session(folder)
    header = session.header
    walk = walk_of(session)
    if session.t_ns[-1] < walk.t_ns[0] or session.t_ns[0] > walk.t_ns[-1]:
        raise SessionError(
            "the trajectory and the CSI do not overlap in time",
            where=str(folder),
            remedy="Check clock.csi_first_packet_ns and the t_ns column",
        )
    anchor = np.array([header.anchor.x_m, header.anchor.y_m])
    span_s = (int(session.t_ns[-1]) - int(session.t_ns[0])) / 1e9
    if span_s > MAX_SPAN_S:
        raise SessionError(f"the CSI spans {span_s:.0f} s, more than {MAX_SPAN_S:.0f} s", where=str(folder))
    bounds = bounds_m or bounds_of(session)
    if wrong := wrong_bounds(bounds):
        raise SessionError(f"no map to look for the device in: {wrong}", where=str(folder))
    recording = Recording(
        session.t_ns,
        session.csi,
        walk,
        anchor,
        header.anchor.z_m,
        header.radio.carrier_hz,
        header.radio.bandwidth_mhz,
        header.radio.array_end,
    )
    evidence = evidence_from_walk(recording, Grid.over(bounds, GRID_STEP_M), should_stop=should_stop)
    if evidence.posterior is None or evidence.path is None:
        return Solved(session, evidence, None, None)
    paper_m = paper_estimate(evidence.path, walk, anchor, Grid.over(bounds, PAPER_GRID_STEP_M))
    return Solved(session, evidence, place_from_posterior(evidence.posterior), paper_m)


def fuse(solved: Sequence[Solved]) -> list[Fused]:
    """Multiply the sessions of each device (same MAC or name, epoch and grid), in order of first use."""
    groups: dict[tuple[str, int, Grid], list[Solved]] = {}
    for one in solved:
        if one.evidence.posterior is not None:
            device = one.session.header.device
            key = (device.mac or device.name or one.session.header.id, one.session.header.map.epoch)
            groups.setdefault((*key, one.evidence.posterior.grid), []).append(one)
    results = []
    for (device_id, _, grid), members in groups.items():
        terms = [m.evidence.terms for m in members if m.evidence.terms is not None]
        total = reduce(Terms.plus, terms)
        results.append(
            Fused(
                device_id,
                tuple(m.session.header.id for m in members),
                place_from_posterior(total.posterior(grid)),
                members[0].session.truth_m,
                total.height_range_m(),
            )
        )
    return results


def plan_prior(plan: FloorPlan, grid: Grid) -> FloatArray:
    """What the floor plan says of where devices are: log-density (rows, columns) of the grid."""
    fine = Grid.over(grid.bounds_m, PLAN_STEP_M)
    cells = plan.occupancy_at(fine.points_m).reshape(fine.rows, fine.columns)
    return plan_log_prior((cells >= FREE) & (cells < OCCUPIED / 2), fine, grid)


def on_plan(posterior: Posterior, prior: FloatArray) -> Posterior:
    """The posterior of all walks with `plan_prior`; to be used once."""
    return Posterior(posterior.grid, posterior.log_density + prior)
