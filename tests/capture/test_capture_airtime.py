"""The budget of provoked packets: never more than its share of an hour, whatever is asked."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vad.capture.airtime import ECHO_AIRTIME_S, Airtime

S = 1_000_000_000


def test_it_starts_full_is_spent_and_fills_again() -> None:
    budget = Airtime(0.02, 0)
    assert budget.left_s(0) == pytest.approx(72.0)
    assert budget.allows(0, 400.0, 30.0)
    budget.spend(0, 140_000)
    assert not budget.allows(0, 400.0, 30.0)
    assert budget.left_s(100 * S) == pytest.approx(4.0)
    assert budget.allows(200 * S, 400.0, 30.0)
    assert budget.left_s(10**6 * S) == pytest.approx(72.0), "it does not pile up"


def test_no_share_allows_nothing() -> None:
    assert not Airtime(0.0, 0).allows(10**12, 1.0, 1.0)
    assert Airtime(0.0, 0).allows(10**12, 0.0, 30.0), "what costs nothing is allowed"


@given(st.lists(st.integers(0, 600), max_size=60), st.floats(0.001, 0.2))
def test_over_any_time_no_more_is_used_than_the_share_and_one_hour_of_it(
    pauses_s: list[int], share: float
) -> None:
    budget, now_ns, used_s = Airtime(share, 0), 0, 0.0
    for pause_s in pauses_s:
        now_ns += pause_s * S
        if budget.allows(now_ns, 400.0, 30.0):
            budget.spend(now_ns, 12_000)
            used_s += 12_000 * ECHO_AIRTIME_S
    assert used_s <= share * (3600.0 + now_ns / S) + 1e-6
