"""Packets at their own times onto a uniform clock, and the NIC's phase noise out of them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from vad.sensing.resample import CLIP_MEDIANS, MAX_GAP_S, RATE_HZ, antenna_ratio, to_uniform, without_outliers
from vad.sensing.template import moving_part, subcarriers

pytestmark = pytest.mark.timeout(600)
"""Much work for the processor: a busy machine takes many times as long as an idle one."""

Times = NDArray[np.int64]
Csi = NDArray[np.complex64]

START_NS = 7_000_000_000_000


def irregular(seconds: float, rate_hz: float, seed: int) -> Times:
    """Packet times of a mean rate, no two alike, as a busy channel makes them."""
    rng = np.random.default_rng(seed)
    steps = rng.uniform(0.2, 1.8, int(seconds * rate_hz)) / rate_hz
    return START_NS + np.rint(np.cumsum(steps) * 1e9).astype(np.int64)


def tone(t_ns: Times, f_hz: float) -> Csi:
    """exp(2 pi i f t), t from START_NS on."""
    return np.exp(2j * np.pi * f_hz * (t_ns - START_NS) / 1e9).astype(np.complex64)[:, None]


def some_csi(n: int, n_rx: int, n_tx: int, seed: int = 0) -> Csi:
    rng = np.random.default_rng(seed)
    shape = (n, 30, n_rx, n_tx)
    still = rng.normal(size=shape[1:]) + 1j * rng.normal(size=shape[1:]) + 2.0
    moving = 0.1 * (rng.normal(size=shape) + 1j * rng.normal(size=shape))
    loudness = np.array([1.0, 1.6, 0.7])[:n_rx, None]  # which antenna is the strongest is not in doubt
    return ((still + moving) * loudness).astype(np.complex64)


@given(st.floats(-45.0, 45.0), st.integers(0, 1000), st.sampled_from([250.0, 400.0, 1000.0]))
@settings(max_examples=40, deadline=None)
def test_a_tone_sampled_irregularly_is_the_same_tone_on_the_clock(
    f_hz: float, seed: int, rate: float
) -> None:
    t_ns = irregular(3.0, rate, seed)
    streams = to_uniform(t_ns, tone(t_ns, f_hz))
    assert np.all(np.abs(np.diff(streams.t_ns) - 1e9 / RATE_HZ) <= 1)
    assert streams.t_ns[0] == t_ns[0]
    assert streams.t_ns[-1] <= t_ns[-1]
    assert streams.covered.all()
    inside = slice(40, -40)  # the ends are where a filter has only one side
    off = streams.values[inside] / tone(streams.t_ns[inside], f_hz)
    assert np.abs(np.angle(off)).max() < 0.25, "no delay"
    # Linear interpolation between packets that are 1/250 s apart takes a little of a fast tone.
    assert 0.8 < np.abs(off).mean() <= 1.01


@given(st.floats(100.0, 180.0), st.booleans())
@settings(max_examples=20, deadline=None)
def test_what_is_too_fast_for_a_body_is_taken_out(f_hz: float, backwards: bool) -> None:
    t_ns = START_NS + np.arange(0, 3 * 10**9, 10**6)
    streams = to_uniform(t_ns, tone(t_ns, -f_hz if backwards else f_hz))
    assert np.abs(streams.values[40:-40]).max() < 0.1


@given(st.floats(0.07, 0.8), st.floats(0.5, 1.5))
@settings(max_examples=30, deadline=None)
def test_a_hole_in_the_packets_is_marked_and_nothing_else(hole_s: float, at_s: float) -> None:
    t_ns = START_NS + np.arange(0, 3 * 10**9, 2_500_000)
    t_s = (t_ns - START_NS) / 1e9
    t_ns = t_ns[(t_s <= at_s) | (t_s >= at_s + hole_s)]
    streams = to_uniform(t_ns, tone(t_ns, 10.0))
    uniform_s = (streams.t_ns - START_NS) / 1e9
    in_hole = (uniform_s > at_s + 0.003) & (uniform_s < at_s + hole_s - 0.003)
    outside = (uniform_s < at_s - 0.003) | (uniform_s > at_s + hole_s + 0.003)
    assert not streams.covered[in_hole].any()
    assert streams.covered[outside].all()


def test_a_short_hole_is_bridged() -> None:
    t_ns = START_NS + np.arange(0, 2 * 10**9, 2_500_000)
    t_ns = np.delete(t_ns, slice(400, 400 + int(MAX_GAP_S / 0.0025) - 2))
    assert to_uniform(t_ns, tone(t_ns, 5.0)).covered.all()


@pytest.mark.parametrize("count", [2, 3, 10])
def test_a_handful_of_packets_is_enough_to_answer(count: int) -> None:
    t_ns = START_NS + np.arange(count, dtype=np.int64) * 2_500_000
    streams = to_uniform(t_ns, tone(t_ns, 5.0))
    assert len(streams.t_ns) == len(streams.values) == len(streams.covered)
    assert np.isfinite(streams.values).all()


@given(st.sampled_from([2, 3]), st.sampled_from([1, 2]), st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_the_antenna_ratio_knows_nothing_of_what_the_chains_share(n_rx: int, n_tx: int, seed: int) -> None:
    csi = some_csi(200, n_rx, n_tx, seed)
    rng = np.random.default_rng(seed)
    gain = rng.uniform(0.7, 1.4, 200) * np.exp(2j * np.pi * rng.random(200))
    slope = np.exp(1j * rng.uniform(-0.3, 0.3, 200)[:, None] * np.arange(30))
    spoilt = (csi * gain[:, None, None, None] * slope[:, :, None, None]).astype(np.complex64)
    ratio = antenna_ratio(csi)
    assert ratio.shape == (200, (n_rx - 1) * 30 * n_tx)
    assert ratio.dtype == np.complex64
    np.testing.assert_allclose(antenna_ratio(spoilt), ratio, rtol=1e-2, atol=1e-3)


@given(st.sampled_from([1, 2, 3]), st.sampled_from([1, 2]), st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_the_moving_part_knows_nothing_of_gain_offset_and_slope(n_rx: int, n_tx: int, seed: int) -> None:
    csi = some_csi(200, n_rx, n_tx, seed)
    rng = np.random.default_rng(seed)
    gain = rng.uniform(0.7, 1.4, 200) * np.exp(2j * np.pi * rng.random(200))
    turn = np.exp(1j * rng.uniform(-0.02, 0.02, 200)[:, None] * subcarriers(20))
    spoilt = (csi * gain[:, None, None, None] * turn[:, :, None, None]).astype(np.complex64)
    clean, found = moving_part(csi), moving_part(spoilt)
    assert clean.shape == csi.shape
    # Phases are those of the packet that the template began with; what moves, and how much, is the same.
    left = np.abs(found) - np.abs(clean)
    assert np.linalg.norm(left) < 0.1 * np.linalg.norm(clean)


def test_packets_in_which_the_reference_fades_do_not_blow_up() -> None:
    csi = some_csi(300, 3, 1)
    reference = int(np.argmax(np.mean(np.abs(csi) ** 2, axis=(0, 1, 3))))
    csi[50:60, :, reference] *= 1e-6
    csi[100] = 0
    ratio = antenna_ratio(csi)
    assert np.isfinite(ratio).all()
    assert np.abs(ratio).max() < 2 * CLIP_MEDIANS * np.median(np.abs(ratio), axis=0).max()
    assert np.isfinite(moving_part(csi)).all()


def test_outliers_keep_their_phase() -> None:
    values = np.ones((100, 2), np.complex64)
    values[7] = 1000j
    clipped = without_outliers(values)
    np.testing.assert_allclose(clipped[7], CLIP_MEDIANS * 1j, rtol=1e-6)
    np.testing.assert_array_equal(clipped[8:], values[8:])
