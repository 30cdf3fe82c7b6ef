"""A small seeded part of tools/bench locate against stored limits: places do not get worse unseen."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from vad.sim.paper_setups import Setup

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

from bench_locate import run_unit
from bench_locate_cases import home_cases, paper_cases, recorded
from bench_locate_score import Case, Score, solve

pytestmark = pytest.mark.timeout(600)
"""Much work for the processor: a busy machine takes many times as long as an idle one."""


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
    single, fused = judged(partial(paper_cases, setup, 0, 3, (0.06,)), "slow 6 cm")
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
    assert worst_m(single) < 1.1
    assert error_m(fused) < 0.45
    assert sum(bool(s.in90) for s in single) >= 2


def damaged() -> Iterator[tuple[str, Case]]:
    """One walk of the open-space set-up, each time with something missing."""
    case = next(paper_cases("open", 0, 2, (0.02,)))[0]
    recording, rng = case.recording, np.random.default_rng(3)
    t_ns, csi, walk = recording.t_ns, recording.csi, recording.walk
    middle_ns = int(t_ns[len(t_ns) // 2])
    for name, kept in (
        ("whole", np.full(len(t_ns), True)),
        ("30 % lost", rng.random(len(t_ns)) > 0.3),
        ("a hole of 2 s", np.abs(t_ns - middle_ns) > 1_000_000_000),
        ("cut off halfway", t_ns < middle_ns),
    ):
        yield name, replace(case, recording=replace(recording, t_ns=t_ns[kept], csi=csi[kept]))
    for name, stands in (("stands still", (0.0, 0.0)), ("straight", (0.12, 0.05))):
        steps = np.arange(len(walk.t_ns))[:, None] * np.array(stands) * 0.5
        track = replace(walk, xy_m=walk.xy_m[:1] + steps)
        yield name, replace(case, recording=replace(recording, walk=track))


def test_what_is_missing_widens_the_region_or_is_refused() -> None:
    """Never a confident wrong point (the walk that does not fit the packets at all has no truth to hold)."""
    radius_m = {}
    for name, case in damaged():
        score, evidence = solve(case)
        radius_m[name] = score.radius90_m
        if name in ("stands still", "straight"):
            assert score.status != "located", name
            assert evidence.reason
        else:
            assert score.in90, name
    whole_m, half_m = radius_m["whole"], radius_m["cut off halfway"]
    assert whole_m is not None
    assert half_m is not None
    assert half_m > whole_m
