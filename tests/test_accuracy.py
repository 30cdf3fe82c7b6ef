"""A small seeded part of tools/bench locate against stored limits: places do not get worse unseen."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest

from vad.sim.paper_setups import Setup

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

from bench_locate import run_unit
from bench_locate_cases import home_cases, paper_cases, recorded
from bench_locate_score import Case, Score


def judged(cases: Callable[[], Iterator[list[Case]]], tag: str) -> tuple[list[Score], Score]:
    """The scores of the cases with this tag: each walk, and all together."""
    chosen = ([c for c in some if tag in c.tags] for some in cases())
    scores = run_unit(lambda: chosen, ("full",))["full"]
    (fused,) = [s for s in scores if s.walks > 1]
    return [s for s in scores if s.walks == 1], fused


def worst_m(scores: list[Score]) -> float:
    """The largest error; a refusal is one without limit."""
    return max(float("inf") if s.error_m is None else s.error_m for s in scores)


def error_m(score: Score) -> float:
    """The error of one place; a refusal is one without limit."""
    return worst_m([score])


@pytest.mark.parametrize(("setup", "single_m", "together_m"), [("office", 1.9, 0.6), ("open", 1.0, 0.3)])
def test_paper_setups(setup: Setup, single_m: float, together_m: float) -> None:
    """An L, a rectangle and a circle with 3 cm of white and 6 cm of slow track error."""
    single, fused = judged(partial(paper_cases, setup, 0, 3), "slow 6 cm")
    assert worst_m(single) < single_m
    assert error_m(fused) < together_m
    assert fused.in90


def test_a_home() -> None:
    """Three visits, the antennas at the hub: Doppler alone."""
    single, fused = judged(partial(home_cases, 1), "same room")
    assert worst_m(single) < 1.2
    assert error_m(fused) < 0.9
    assert not fused.wrong_room_confident


@pytest.mark.usefixtures("shared_data")
def test_recordings() -> None:
    """Three real walks around one receiver in the plain room."""
    single, fused = judged(partial(recorded, ("plain", "rx1"), 3), "as recorded")
    assert worst_m(single) < 0.8
    assert error_m(fused) < 0.45
    assert sum(bool(s.in90) for s in single) >= 2
