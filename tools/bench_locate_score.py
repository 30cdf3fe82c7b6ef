"""Solving one walk as the daemon does, and scoring what comes out against the truth."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from vad.mapping.bound import DopplerBound
from vad.mapping.device_stage import (
    Evidence,
    Recording,
    evidence_from_walk,
    paper_estimate,
    place_from_posterior,
)
from vad.mapping.doppler_likelihood import DopplerModel
from vad.mapping.doppler_line import LineModel
from vad.mapping.doppler_search import OFFSETS_S
from vad.mapping.evidence import Terms
from vad.mapping.paper import THRESHOLD_OFFICE_M, THRESHOLD_OPEN_SPACE_M
from vad.mapping.posterior import Bounds, Grid, Posterior
from vad.robot.floor_plan import FloorPlan
from vad.solve import on_plan, plan_prior

FloatArray = NDArray[np.float64]

GRID_STEP_M = 0.1
PAPER_GRID_STEP_M = 0.2
CONFIDENT_SHARE = 0.9
"""A posterior that gives another room this much is confident of the wrong one."""

ABLATIONS: dict[str, dict[str, float]] = {
    "full": {},
    "kappa known": {"kappa": 1.0, "kappa_sd": 0.0},
    "body taken as a point": {"surface_m": 0.0, "surface_sd_m": 0.0},
    "heights taken as known": {"anchor_sd_m2": 0.0, "device_sd_m2": 0.0},
    "track taken as exact": {"track_share": 0.0},
    "track's errors as large as stated": {"track_share": 1.0},
    "limbs and ghosts ignored": {"clutter_hz": 0.05},
    "without antenna phases": {},
    "time offset taken as known": {"late_sd_s": 0.0},
}
"""What each leaves out: fields of LineModel; antennas are left out by saying that they are elsewhere."""


@dataclass(frozen=True, slots=True)
class Case:
    """One walk to be solved and what is known of it.

    tags: what it is pooled by; wall_x_m, plan: where the next room begins and the floor plan, in homes;
    height_m: the device's, where it is known.
    """

    name: str
    group: str
    tags: tuple[str, ...]
    recording: Recording
    truth_m: FloatArray
    bounds_m: Bounds
    bound: DopplerBound | None = None
    wall_x_m: float | None = None
    plan: FloorPlan | None = None
    height_m: float | None = None


@dataclass(frozen=True, slots=True)
class Score:
    """Of one place. error_m None where refused; outward_m: estimate - truth away from the walk's middle;
    right_room None where there are no rooms; height_told: whether a range was given, height_in: whether it
    holds the truth, None where none was given."""

    name: str
    tags: tuple[str, ...]
    walks: int
    status: str
    error_m: float | None = None
    outward_m: float | None = None
    in50: bool | None = None
    in90: bool | None = None
    radius90_m: float | None = None
    bound_rms_m: float | None = None
    paper_office_m: float | None = None
    paper_open_m: float | None = None
    right_room: bool | None = None
    wrong_room_confident: bool | None = None
    height_told: bool | None = None
    height_in: bool | None = None
    cpu_s: float = 0.0


def solve(case: Case, ablation: str = "full") -> tuple[Score, Evidence]:
    """One walk alone, with the paper's method beside it."""
    model = DopplerModel(line=replace(LineModel(), **ABLATIONS[ablation]))
    recording = case.recording
    if ablation == "without antenna phases":
        recording = replace(recording, array_end="anchor")
    before = time.process_time()
    grid = Grid.over(case.bounds_m, GRID_STEP_M)
    evidence = evidence_from_walk(
        recording,
        grid,
        model=model,
        offsets_s=(0.0,) if ablation == "time offset taken as known" else OFFSETS_S,
    )
    cpu_s = time.process_time() - before
    if evidence.posterior is None:
        return Score(case.name, case.tags, 1, evidence.status, cpu_s=cpu_s), evidence
    told_m = None if evidence.terms is None else evidence.terms.height_range_m()
    score = _score(case.name, [case], evidence.posterior, evidence.status, told_m)
    if ablation == "full" and evidence.path is not None:
        coarse = Grid.over(case.bounds_m, PAPER_GRID_STEP_M)
        office_m, open_m = (
            float(np.linalg.norm(answer - case.truth_m))
            for threshold_m in (THRESHOLD_OFFICE_M, THRESHOLD_OPEN_SPACE_M)
            for answer in [
                paper_estimate(
                    evidence.path, recording.walk, recording.anchor_m, coarse, threshold_m=threshold_m
                )
            ]
        )
        score = replace(score, paper_office_m=office_m, paper_open_m=open_m)
    return replace(score, cpu_s=cpu_s), evidence


def fuse(name: str, cases: Sequence[Case], evidence: Sequence[Evidence]) -> Score | None:
    """Several walks of one device together; None where all were refused."""
    terms = [e.terms for e in evidence if e.terms is not None]
    if not terms:
        return None
    total = reduce(Terms.plus, terms)
    posterior = total.posterior(Grid.over(cases[0].bounds_m, GRID_STEP_M))
    return _score(name, cases, posterior, place_from_posterior(posterior).status, total.height_range_m())


def _score(
    name: str,
    cases: Sequence[Case],
    posterior: Posterior,
    status: str,
    height90_m: tuple[float, float] | None,
) -> Score:
    first = cases[0]
    if first.plan is not None:
        posterior = on_plan(posterior, plan_prior(first.plan, posterior.grid))
    place = place_from_posterior(posterior)
    off_m = place.xy_m - first.truth_m
    middle = np.mean([c.recording.walk.xy_m.mean(axis=0) for c in cases], axis=0)
    away = first.truth_m - middle
    right_room = confident = None
    if first.wall_x_m is not None:
        behind = first.truth_m[0] > first.wall_x_m
        there = posterior.grid.points_m[:, 0] > first.wall_x_m
        share = float(posterior.probability.ravel()[there != behind].sum())
        right_room = bool((place.xy_m[0] > first.wall_x_m) == behind)
        confident = share >= CONFIDENT_SHARE
    bounds = [c.bound for c in cases if c.bound is not None]
    return Score(
        name,
        tuple(t for t in first.tags if all(t in c.tags for c in cases)),
        len(cases),
        status,
        float(np.linalg.norm(off_m)),
        float(off_m @ away / max(np.linalg.norm(away), 1e-6)),
        _holds(posterior, 0.5, first.truth_m),
        _holds(posterior, 0.9, first.truth_m),
        place.radius90_m,
        reduce(DopplerBound.plus, bounds).rms_m if bounds else None,
        right_room=right_room,
        wrong_room_confident=confident,
        height_told=None if first.height_m is None else height90_m is not None,
        height_in=None
        if first.height_m is None or height90_m is None
        else height90_m[0] <= first.height_m <= height90_m[1],
    )


def _holds(posterior: Posterior, share: float, truth_m: FloatArray) -> bool:
    """Whether the truth's cell belongs to the region."""
    grid = posterior.grid
    column, row = np.rint((truth_m - [grid.x0_m, grid.y0_m]) / grid.step_m).astype(int)
    inside = 0 <= column < grid.columns and 0 <= row < grid.rows
    return bool(inside and posterior.region(share)[row, column])


def summary(scores: Sequence[Score]) -> dict[str, float | int | None]:
    """Everything the table shows of a pool of scores; shares in 0..1, None where there is nothing."""
    placed = [s for s in scores if s.error_m is not None]
    errors = np.array([s.error_m for s in placed])

    def mean(name: str, of: Sequence[Score] = placed) -> float | None:
        values = [v for s in of if (v := getattr(s, name)) is not None]
        return float(np.mean(values)) if values else None

    result: dict[str, float | int | None] = {
        "n": len(scores),
        "refused": sum(s.error_m is None for s in scores),
        "uncertain": sum(s.status == "uncertain" for s in scores),
    }
    if len(errors):
        bounds = [s.bound_rms_m for s in placed if s.bound_rms_m is not None]
        paper = [s.paper_office_m for s in placed if s.paper_office_m is not None]
        rms_m = float(np.sqrt(np.mean(errors**2)))
        bound_m = float(np.sqrt(np.mean(np.square(bounds)))) if bounds else None
        result |= {
            "median_m": float(np.median(errors)),
            "mean_m": float(errors.mean()),
            "rms_m": rms_m,
            "p80_m": float(np.percentile(errors, 80)),
            "p95_m": float(np.percentile(errors, 95)),
            "below_half_metre": float((errors < 0.5).mean()),
            "in50": mean("in50"),
            "in90": mean("in90"),
            "radius90_m": float(np.median([s.radius90_m for s in placed])),
            "outward_m": mean("outward_m"),
            "bound_rms_m": bound_m,
            "rms_per_bound": rms_m / bound_m if bound_m else None,
            "paper_office_mean_m": mean("paper_office_m"),
            "paper_office_median_m": float(np.median(paper)) if paper else None,
            "paper_open_mean_m": mean("paper_open_m"),
            "right_room": mean("right_room", [s for s in placed if s.status == "located"]),
            "wrong_room_confident": mean("wrong_room_confident"),
            "height_told": mean("height_told"),
            "height_in": mean("height_in"),
            "cpu_s": mean("cpu_s", [s for s in scores if s.walks == 1]),
        }
    return result
