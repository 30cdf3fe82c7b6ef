"""How often a consumer wants a picture, and which ones a camera then leaves undecoded."""

from __future__ import annotations

import itertools

from hypothesis import given
from hypothesis import strategies as st

from vad.camera.frame import FrameQueue

times = st.lists(st.integers(0, 2_000_000_000), min_size=1, max_size=60)


@given(times, st.integers(0, 500_000_000))
def test_no_two_wanted_come_sooner_than_asked(t_ns: list[int], step_ns: int) -> None:
    queue = FrameQueue(1)
    queue.step_ns = step_ns
    wanted = [t for t in sorted(t_ns) if queue.wants(t)]
    assert wanted[0] == min(t_ns)
    assert all(b - a >= step_ns for a, b in itertools.pairwise(wanted))
    # None is left out without need.
    for t in t_ns:
        assert t in wanted or any(0 <= t - w < step_ns for w in wanted)


def test_a_clock_that_went_back_starts_anew() -> None:
    queue = FrameQueue(1)
    queue.step_ns = 100
    assert queue.wants(10_000)
    assert not queue.wants(10_050)
    assert queue.wants(3_000)
    assert not queue.wants(3_050)
