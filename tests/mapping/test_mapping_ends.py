"""One walk heard at two known ends says more than at either."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from home_walks import recordings

from vad.mapping.device_stage import evidence_from_walk, place_from_posterior
from vad.mapping.evidence import Terms
from vad.mapping.posterior import Grid
from vad.sim.scenario import make_home

pytestmark = pytest.mark.timeout(600)
"""Much work for the processor: a busy machine takes many times as long as an idle one."""

SEED = 1


def test_two_known_ends_of_one_device() -> None:
    home = make_home(SEED, walks=1)
    _, _, x1, y1 = home.room_m
    opposite = replace(home, anchor_m=(x1 - 0.3, y1 - 0.3, 1.2))
    grid = Grid.over(home.plan_m, 0.2)
    terms = []
    for end in (home, opposite):
        (recording,) = recordings(end, SEED)
        told = evidence_from_walk(recording, grid, offsets_s=(0.0,)).terms
        assert isinstance(told, Terms)
        terms.append(told)
    first, second = terms
    alone = [place_from_posterior(told.posterior(grid)) for told in terms]
    both = place_from_posterior(first.plus(second).posterior(grid))
    assert both.radius90_m < 0.9 * min(place.radius90_m for place in alone)
    assert np.linalg.norm(both.xy_m - home.device_m[:2]) < 0.4
