"""When a record goes on, ends, or is void."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vad.capture.enough import STALE_GROUND_S, Ground, Progress, judge

S = 1_000_000_000


@pytest.mark.parametrize(
    ("progress", "act", "why"),
    [
        (Progress(3.0), "go on", ""),
        (Progress(20.0), "go on", ""),
        (Progress(30.0), "finish", "time is up"),
        (Progress(10.0, sharp=True), "finish", "sharp enough"),
        (Progress(4.0, sharp=True), "go on", ""),
        (Progress(12.0, covered=True), "finish", "ground is covered"),
        (Progress(4.0, unseen_s=2.0), "abort", "left after a few seconds"),
        (Progress(6.5, unseen_s=2.0), "abort", "left after a few seconds"),
        (Progress(12.0, unseen_s=2.0), "finish", "the walker left"),
        (Progress(4.0, alone=False), "abort", "somebody else moved"),
        (Progress(12.0, alone=False), "finish", "the walk up to there"),
        (Progress(5.0, unheard_s=4.0), "abort", "ceased to send"),
        (Progress(15.0, unheard_s=4.0), "finish", "packets ceased"),
    ],
)
def test_each_rule(progress: Progress, act: str, why: str) -> None:
    judgement = judge(progress, min_s=6.0, max_s=30.0)
    assert judgement.act == act
    assert why in judgement.reason
    assert judgement.its_fault == ("ceased to send" in why)


@given(
    st.builds(
        Progress,
        st.floats(0, 100),
        st.floats(0, 100),
        st.booleans(),
        st.floats(0, 100),
        st.booleans(),
        st.booleans(),
    )
)
def test_a_record_never_goes_on_past_its_time_and_is_never_used_too_short(progress: Progress) -> None:
    judgement = judge(progress, min_s=6.0, max_s=30.0)
    assert (judgement.act == "go on") == (not judgement.reason)
    if progress.seconds >= 30.0:
        assert judgement.act != "go on"
    if progress.seconds < 6.0:
        assert judgement.act != "finish"


def test_a_circle_is_covered_after_the_second_round() -> None:
    ground, covered_s = Ground(), None
    for k in range(600):
        t_s = k / 10
        angle = 2 * np.pi * t_s / 12.0
        ground.add(int(t_s * S), 1.5 * np.cos(angle), 1.5 * np.sin(angle))
        if covered_s is None and ground.covered(int(t_s * S)):
            covered_s = t_s
    assert covered_s is not None
    assert 12.0 + STALE_GROUND_S - 2.0 < covered_s < 12.0 + STALE_GROUND_S + 1.0


def test_pacing_up_and_down_never_covers_the_ground() -> None:
    ground = Ground()
    for k in range(600):
        ground.add(k * S // 10, 1.0 + np.sin(k / 20), 0.2)
    assert not ground.covered(60 * S)
    assert not Ground().covered(60 * S)
