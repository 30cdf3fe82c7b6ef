"""A counter onto the timeline."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from vad.clock import COUNTER_RANGE, ClockMap, unwrap_nic_us

BASE_NS = 10**12


def counter_of(t_s: NDArray[np.float64], start: int, skew: float) -> NDArray[np.uint32]:
    return ((start + (t_s * 1e6 * (1 + skew)).astype(np.int64)) % COUNTER_RANGE).astype(np.uint32)


def drive(
    clock: ClockMap, t_s: NDArray[np.float64], counter: NDArray[np.uint32], rng: np.random.Generator
) -> NDArray[np.int64]:
    """Deliver packets as a coalescing receiver does: woken by the first, drained 15 ms later."""
    out, i = [], 0
    while i < len(t_s):
        woken = t_s[i] + rng.exponential(50e-6)
        drained = woken + 0.015 + (0.4 if rng.random() < 0.01 else rng.exponential(1e-4))
        end = max(i + 1, int(np.searchsorted(t_s, drained)))
        arrival = np.full(end - i, BASE_NS + int(drained * 1e9))
        arrival[0] = BASE_NS + int(woken * 1e9)
        out.append(clock.update(counter[i:end], arrival))
        i = end
    return np.concatenate(out)


@settings(max_examples=8, deadline=None)
@given(
    rate_hz=st.sampled_from([30, 300, 1000]),
    skew=st.floats(-60e-6, 60e-6),
    start=st.integers(0, COUNTER_RANGE - 1),
    seed=st.integers(0, 1000),
)
def test_jitter_skew_and_wrap_disappear(rate_hz: int, skew: float, start: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    t_s = np.cumsum(rng.exponential(1 / rate_hz, rate_hz * 60))
    clock = ClockMap()
    error = drive(clock, t_s, counter_of(t_s, start, skew), rng) - (BASE_NS + (t_s * 1e9).astype(np.int64))
    assert np.abs(error).max() < 1_000_000
    assert np.abs(error[t_s > 30]).max() < 100_000
    assert clock.restarts == 0
    assert clock.skew == pytest.approx(-skew, abs=5e-6)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(0, 500_000), min_size=2, max_size=200), st.integers(0, 1000))
def test_output_rises_with_the_counter(steps_us: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    t_s = np.cumsum(steps_us) / 1e6
    out = drive(ClockMap(), t_s, counter_of(t_s, COUNTER_RANGE - 1_000_000, 20e-6), rng)
    assert (np.diff(out) >= 0).all()


@pytest.mark.parametrize("restarted_at", [0, 5, 2**31, 2**32 - 3_000_000])
def test_a_reset_counter_is_found(restarted_at: int) -> None:
    rng = np.random.default_rng(1)
    clock = ClockMap()
    first = np.arange(0, 20, 0.002)
    drive(clock, first, counter_of(first, 3_000_000_000, 0.0), rng)
    second = np.arange(50, 60, 0.002)
    out = drive(clock, second, counter_of(second - 50, restarted_at, 0.0), rng)
    assert clock.restarts == 1
    assert np.abs(out - (BASE_NS + (second * 1e9).astype(np.int64))).max() < 1_000_000


@pytest.mark.parametrize("moved_s", [-4.9, -3.0, -1.5, -0.7, -0.12, 0.12, 0.5, 0.95, 1.5])
@pytest.mark.parametrize("pause_s", [0.0, 7.0])
def test_a_small_jump_of_the_counter_does_not_go_unnoticed(moved_s: float, pause_s: float) -> None:
    """moved_s: how far the counter then is ahead (packets seem early, +) or behind (late, -)."""
    rng = np.random.default_rng(3)
    clock = ClockMap()
    t_s = np.concatenate([np.arange(0, 20, 0.002), 20 + pause_s + np.arange(0, 20, 0.002)])
    late = t_s >= 20
    counter_s = t_s + np.where(late, moved_s, 0.0)
    out = drive(clock, t_s, counter_of(counter_s, 3_000_000_000, 20e-6), rng)
    error = out - (BASE_NS + (t_s * 1e9).astype(np.int64))
    assert clock.restarts == 1
    settled = t_s > 20 + pause_s + (3.0 if moved_s < 0 else 0.1)
    assert np.abs(error[settled]).max() < 1_000_000
    assert np.abs(error[~late]).max() < 1_000_000


def test_a_stalling_receiver_is_no_reset() -> None:
    """400 ms in every second nothing is read; then all of it, and the last packet is in time."""
    clock = ClockMap()
    t_s = np.arange(0, 60, 0.0004)
    counter = counter_of(t_s, 5, 30e-6)
    read_s = np.concatenate([k + np.concatenate([[0.4], np.arange(0.42, 1.0, 0.02)]) for k in range(60)])
    first = 0
    for now_s in read_s:
        end = int(np.searchsorted(t_s, now_s))
        clock.update(counter[first:end], np.full(end - first, BASE_NS + int(now_s * 1e9)))
        first = end
    assert clock.restarts == 0
    assert clock.skew == pytest.approx(-30e-6, abs=15e-6)  # a packet comes every 0.4 ms


def test_a_counter_that_stands_still_gives_arrival_times() -> None:
    clock = ClockMap()
    for k in range(100):
        arrival = np.full(5, BASE_NS + k * 20_000_000)
        out = clock.update(np.full(5, 77, np.uint32), arrival)
        assert clock.still == (k >= 2)
        if clock.still:
            assert (out == arrival).all()
    moving = clock.update(np.array([1000, 2000], np.uint32), np.full(2, BASE_NS + 2_000_000_000))
    assert not clock.still
    assert clock.restarts == 1
    assert (moving - BASE_NS).tolist() == [1_999_000_000, 2_000_000_000]


def test_wraps_while_nothing_came_are_counted_by_arrival() -> None:
    rng = np.random.default_rng(1)
    clock = ClockMap()
    t_s = np.concatenate([np.arange(0, 20, 0.01), 3 * 4294.967296 + np.arange(0, 20, 0.01)])
    out = drive(clock, t_s, counter_of(t_s, 0, 0.0), rng)
    assert clock.restarts == 0
    assert np.abs(out - (BASE_NS + (t_s * 1e9).astype(np.int64))).max() < 1_000_000


def test_drops_and_a_stall_change_nothing() -> None:
    rng = np.random.default_rng(2)
    t_s = np.sort(rng.uniform(0, 60, 20_000))
    t_s = t_s[~((t_s > 20) & (t_s < 29))]
    out = drive(ClockMap(), t_s, counter_of(t_s, 17, 10e-6), rng)
    assert np.abs(out - (BASE_NS + (t_s * 1e9).astype(np.int64))).max() < 1_000_000


def test_a_backlog_read_at_once_lies_in_the_past() -> None:
    counter = np.arange(0, 5_000_000, 1000, dtype=np.uint32)
    out = ClockMap().update(counter, np.full(len(counter), BASE_NS))
    assert out[-1] == BASE_NS
    assert out[0] == BASE_NS - 4_999_000_000


def test_equal_and_swapped_timestamps() -> None:
    clock = ClockMap()
    out = clock.update(np.array([10, 20, 20, 15, 30], np.uint32), np.full(5, BASE_NS))
    assert (out - BASE_NS).tolist() == [-20_000, -10_000, -10_000, -15_000, 0]
    assert clock.update(np.zeros(0, np.uint32), np.zeros(0, np.int64)).tolist() == []


@given(st.lists(st.integers(0, 4_000_000_000), min_size=1, max_size=50), st.integers(0, COUNTER_RANGE - 1))
def test_unwrap_follows_any_forward_steps(steps: list[int], start: int) -> None:
    true = start + np.cumsum(np.array([0, *steps], np.int64))
    assert unwrap_nic_us((true % COUNTER_RANGE).astype(np.uint32)).tolist() == true.tolist()


def test_unwrap_keeps_small_steps_back() -> None:
    assert unwrap_nic_us(np.array([5, 2, COUNTER_RANGE - 1, 4], np.uint32)).tolist() == [5, 2, -1, 4]
    assert unwrap_nic_us(np.zeros(0, np.uint32)).tolist() == []
