"""Depth and rate: what is over the limit is refused, what is not is not, for any message."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vad.limits import MAX_DEPTH, LimitError, RateLimit, check_depth

S = 1_000_000_000

values = st.recursive(
    st.none() | st.integers() | st.text(alphabet='[]{}"\\a', max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=30,
)


def depth(value: Any) -> int:
    if isinstance(value, dict):
        return 1 + max(map(depth, value.values()), default=0)
    if isinstance(value, list):
        return 1 + max(map(depth, value), default=0)
    return 0


@given(values, st.integers(0, 6))
def test_depth_is_the_depth_of_the_values(value: Any, limit: int) -> None:
    text = json.dumps(value).encode()
    if depth(value) <= limit:
        check_depth(text, limit)
    else:
        with pytest.raises(LimitError, match="nested deeper"):
            check_depth(text, limit)


@given(st.binary(max_size=200))
def test_any_bytes_pass_or_are_refused(data: bytes) -> None:
    try:
        check_depth(data, 3)
    except LimitError:
        assert data.count(b"[") + data.count(b"{") > 3


def test_a_tower_of_brackets_is_refused() -> None:
    check_depth(b"[" * MAX_DEPTH)
    with pytest.raises(LimitError):
        check_depth(b"[" * (MAX_DEPTH + 1))
    check_depth(b'{"text": "' + b"[" * 1000 + b'"}')


@given(st.integers(1, 50), st.integers(1, 20), st.lists(st.integers(0, S), max_size=60))
def test_a_rate_is_never_exceeded(per_s: int, burst: int, gaps: list[int]) -> None:
    limit, now_ns, allowed = RateLimit(per_s, burst), 0, 0
    for gap_ns in gaps:
        now_ns += gap_ns
        allowed += limit.allows(now_ns)
        assert allowed <= burst + per_s * now_ns / S + 1e-6
    assert allowed + limit.refused == len(gaps)


def test_who_keeps_to_the_rate_is_never_refused() -> None:
    limit = RateLimit(100, 1)
    assert all(limit.allows(i * S // 100 + i) for i in range(1000))


def test_a_clock_that_goes_back_gives_nothing() -> None:
    limit = RateLimit(1, 1)
    assert limit.allows(10 * S)
    assert not limit.allows(9 * S)
    assert not limit.allows(9 * S + S // 2)
    assert limit.allows(11 * S)


@pytest.mark.parametrize(("per_s", "burst"), [(0, 1), (-1, 1), (float("nan"), 1), (1, 0)])
def test_a_limit_that_is_none_is_refused(per_s: float, burst: int) -> None:
    with pytest.raises(ValueError, match="must be"):
        RateLimit(per_s, burst)
