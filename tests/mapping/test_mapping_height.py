"""How high a device stands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from home_walks import recordings

from vad.mapping.device_stage import Evidence, evidence_from_walk
from vad.mapping.evidence import Terms
from vad.mapping.height import OFF_TORSO_M, height_range_m
from vad.mapping.posterior import Grid
from vad.sim.scenario import make_home

pytestmark = pytest.mark.timeout(600)
"""Much work for the processor: a busy machine takes many times as long as an idle one."""

TORSO_M = 0.95
SEED = 3


def test_what_no_walk_tells_is_not_told() -> None:
    assert height_range_m(np.zeros(7), TORSO_M) is None


def test_a_device_at_the_torsos_height_is_told_from_both_sides() -> None:
    low, high = height_range_m(-((OFF_TORSO_M / 0.2) ** 2), TORSO_M) or (0.0, 0.0)
    assert low == pytest.approx(TORSO_M - 0.25, abs=0.1)
    assert high == pytest.approx(TORSO_M + 0.25, abs=0.1)


def test_one_on_a_high_shelf_cannot_be_below_the_floor() -> None:
    low, high = height_range_m(-(((OFF_TORSO_M - 1.25) / 0.1) ** 2), TORSO_M) or (0.0, 0.0)
    assert low > 2.0
    assert high <= 2.31


def test_above_and_below_are_not_told_apart() -> None:
    """0.3 m and 1.6 m alike: too far apart to say anything of use."""
    assert height_range_m(-(((OFF_TORSO_M - 0.8) / 0.05) ** 2), TORSO_M) is None


def solved(*, anchor_known: bool = True) -> tuple[list[Evidence], float]:
    home = make_home(SEED, walks=2)
    grid = Grid.over(home.room_m, 0.2)
    found = [
        evidence_from_walk(walk if anchor_known else replace(walk, anchor_z_m=None), grid, offsets_s=(0.0,))
        for walk in recordings(home, SEED)
    ]
    return found, float(home.device_m[2])


def test_walks_by_a_device_bound_its_height() -> None:
    walks, height_m = solved()
    first, second = (walk.terms for walk in walks)
    assert isinstance(first, Terms)
    assert isinstance(second, Terms)
    low, high = first.plus(second).height_range_m() or (9.0, 0.0)
    assert low <= height_m <= high
    assert high - low < 1.3
    untold = replace(second, height=None)
    assert first.plus(untold).height_range_m() is not None


def test_without_the_hubs_height_there_is_none() -> None:
    walks, _ = solved(anchor_known=False)
    terms = walks[0].terms
    assert terms is not None
    assert terms.height is None
    assert terms.height_range_m() is None
