"""Made echoes: the spectrogram shows their Doppler with its sign, and its integral is the path they took."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from vad.csi.attribution import Attribution
from vad.csi.logfile import read_log
from vad.mac import mac_from_text
from vad.sensing.path_length import path_length, ridge_hz
from vad.sensing.resample import antenna_ratio, to_uniform
from vad.sensing.spectrogram import MAX_DOPPLER_HZ, SIGNAL_SHARE, WINDOW_S, Spectrogram, combined, spectrogram
from vad.sensing.template import moving_part
from vad.sim.radio import Radio
from vad.sim.scenario import CARRIER_HZ, make_home

pytestmark = pytest.mark.timeout(600)
"""Much work for the processor: a busy machine takes many times as long as an idle one."""

Times = NDArray[np.int64]
Floats = NDArray[np.float64]

SPEED_OF_LIGHT_MPS = 299_792_458.0
WAVELENGTH_M = SPEED_OF_LIGHT_MPS / CARRIER_HZ
STEP_NS = 2_500_000


def echo(path_m: Floats, *, n_rx: int = 3, n_tx: int = 1, seed: int = 0) -> NDArray[np.complex64]:
    """CSI (N, 30, R, T) of still paths and one echo whose path is path_m (N,) long, with the card's noise."""
    rng = np.random.default_rng(seed)
    n, shape = len(path_m), (30, n_rx, n_tx)
    still = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    f_hz = CARRIER_HZ + np.linspace(-8.75e6, 8.75e6, 30)
    turn = np.exp(-2j * np.pi * f_hz * path_m[:, None] / SPEED_OF_LIGHT_MPS)
    chains = np.exp(2j * np.pi * rng.random((n_rx, n_tx)))
    noise = 0.05 * (rng.normal(size=(n, *shape)) + 1j * rng.normal(size=(n, *shape)))
    offset = np.exp(2j * np.pi * rng.random(n)) * rng.uniform(0.8, 1.2, n)
    csi = still + 0.3 * turn[:, :, None, None] * chains + noise
    return np.asarray(csi * offset[:, None, None, None], dtype=np.complex64)


def ratio_spectrogram(t_ns: Times, csi: NDArray[np.complex64]) -> Spectrogram:
    return spectrogram(to_uniform(t_ns, antenna_ratio(csi)))


def template_spectrogram(t_ns: Times, csi: NDArray[np.complex64]) -> Spectrogram:
    return spectrogram(to_uniform(t_ns, moving_part(csi).reshape(len(csi), -1)))


def regular(seconds: float) -> Times:
    return np.arange(0, int(seconds * 1e9), STEP_NS)


doppler_hz = st.floats(8.0, 50.0).flatmap(lambda f: st.sampled_from([f, -f]))


@given(doppler_hz, st.sampled_from([(2, 1), (3, 1), (2, 2), (3, 2)]), st.integers(0, 100))
@settings(max_examples=25, deadline=None)
def test_the_ridge_is_the_doppler_with_its_sign(f_hz: float, antennas: tuple[int, int], seed: int) -> None:
    t_ns = regular(3.0)
    # Approaching, the path shortens: dL/dt = -lambda f.
    path_m = 5.0 - WAVELENGTH_M * f_hz * t_ns / 1e9
    csi = echo(path_m, n_rx=antennas[0], n_tx=antennas[1], seed=seed)
    for made in (ratio_spectrogram(t_ns, csi), template_spectrogram(t_ns, csi)):
        assert np.median(np.abs(ridge_hz(made) - f_hz)) < 1.0
        mirror = np.argmin(np.abs(made.f_hz + f_hz))
        peak = np.argmin(np.abs(made.f_hz - f_hz))
        one_sided_db = 10 * np.log10(made.power[:, peak].mean() / made.power[:, mirror].mean())
        assert one_sided_db > 3.0


def test_one_antenna_is_enough_for_the_template() -> None:
    t_ns = regular(3.0)
    csi = echo(5.0 - WAVELENGTH_M * 20.0 * t_ns / 1e9, n_rx=1)
    assert np.median(np.abs(ridge_hz(template_spectrogram(t_ns, csi)) - 20.0)) < 1.0


@given(st.integers(0, 100), st.floats(200.0, 900.0))
@settings(max_examples=15, deadline=None)
def test_frames_are_powers_and_likelihoods_whatever_the_packets_rate(seed: int, rate_hz: float) -> None:
    rng = np.random.default_rng(seed)
    t_ns = np.rint(np.cumsum(rng.uniform(0.3, 1.7, int(2.5 * rate_hz))) / rate_hz * 1e9).astype(np.int64)
    made = ratio_spectrogram(t_ns, echo(5.0 + 0.7 * t_ns / 1e9, seed=seed))
    assert np.all(np.diff(made.f_hz) > 0)
    assert made.f_hz[0] >= -MAX_DOPPLER_HZ
    assert made.f_hz[-1] <= MAX_DOPPLER_HZ
    assert (made.power >= 0).all()
    # What is smoothed over the edge of the band is missing from the mean of one.
    assert np.all(np.abs(made.power.mean(axis=1) - 1.0) < 0.1)
    np.testing.assert_allclose(np.exp(made.log_likelihood), SIGNAL_SHARE * made.power + 1 - SIGNAL_SHARE)
    assert np.all(np.diff(made.t_ns) == 50_000_000)
    assert t_ns[0] < made.t_ns[0]
    assert made.t_ns[-1] < t_ns[-1]
    assert (made.weight == 1).all()


@given(st.floats(0.15, 0.8))
@settings(max_examples=15, deadline=None)
def test_frames_that_touch_a_hole_carry_no_weight_and_the_ridge_goes_on(hole_s: float) -> None:
    t_ns = regular(4.0)
    f_hz = 15.0
    csi = echo(5.0 - WAVELENGTH_M * f_hz * t_ns / 1e9)
    kept = (t_ns < 1.5e9) | (t_ns > (1.5 + hole_s) * 1e9)
    made = ratio_spectrogram(t_ns[kept], csi[kept])
    half_s = WINDOW_S / 2
    centre_s = made.t_ns / 1e9
    inside = (centre_s > 1.5 - half_s + 0.1) & (centre_s < 1.5 + hole_s + half_s - 0.1)
    clear = (centre_s < 1.5 - half_s - 0.01) | (centre_s > 1.5 + hole_s + half_s + 0.01)
    assert (made.weight[inside] == 0).all()
    assert (made.weight[clear] == 1).all()
    assert np.median(np.abs(ridge_hz(made)[clear] - f_hz)) < 1.0


def test_two_views_are_averaged_and_trusted_no_more_than_the_worse() -> None:
    t_ns = regular(2.0)
    csi = echo(5.0 + 0.8 * t_ns / 1e9)
    one, two = ratio_spectrogram(t_ns, csi), template_spectrogram(t_ns, csi)
    one.weight[3] = 0.0
    both = combined(one, two)
    np.testing.assert_allclose(both.power, (one.power + two.power) / 2)
    assert both.weight[3] == 0
    assert (both.weight[4:] == 1).all()


@given(st.floats(0.5, 2.0), st.floats(0.15, 0.4), st.floats(0.0, 6.0), st.sampled_from([2, 3]))
@settings(max_examples=20, deadline=None)
def test_the_integral_is_the_change_of_the_path(
    speed_mps: float, turn_hz: float, phase: float, n_rx: int
) -> None:
    t_ns = regular(6.0)
    omega = 2 * np.pi * turn_hz
    path_m = 6.0 + speed_mps / omega * np.sin(omega * t_ns / 1e9 + phase)
    found = path_length(ratio_spectrogram(t_ns, echo(path_m, n_rx=n_rx)), wavelength_m=WAVELENGTH_M)
    assert found.plc_m[0] == 0.0
    true_m = np.interp(found.t_ns, t_ns, path_m)
    off_m = found.plc_m - (true_m - true_m[0])
    # Near a turn the echo is as slow as what stands still, and is lost for a moment.
    assert np.abs(off_m).max() < 0.2
    assert np.ptp(found.plc_m) == pytest.approx(np.ptp(true_m), rel=0.1, abs=0.15)


def test_a_path_that_grows_has_a_negative_doppler_and_a_positive_change() -> None:
    t_ns = regular(4.0)
    found = path_length(ratio_spectrogram(t_ns, echo(4.0 + 1.0 * t_ns / 1e9)), wavelength_m=WAVELENGTH_M)
    assert np.median(found.f_hz) == pytest.approx(-1.0 / WAVELENGTH_M, abs=0.5)
    seconds = (found.t_ns[-1] - found.t_ns[0]) / 1e9
    assert found.plc_m[-1] == pytest.approx(1.0 * seconds, rel=0.05)


def test_packets_that_never_change_break_nothing() -> None:
    t_ns = regular(2.0)
    still = np.tile(echo(np.full(1, 5.0))[:1], (len(t_ns), 1, 1, 1))
    made = ratio_spectrogram(t_ns, still)
    assert np.isfinite(made.log_likelihood).all()
    assert len(ridge_hz(made)) == len(made.t_ns)


def test_a_record_shorter_than_a_window_has_no_weight() -> None:
    t_ns = regular(0.2)
    made = ratio_spectrogram(t_ns, echo(5.0 + t_ns / 1e9))
    assert (made.weight == 0).all()
    found = path_length(made, wavelength_m=WAVELENGTH_M)
    assert len(found.plc_m) == len(made.t_ns)


@pytest.mark.parametrize("n_rx", [2, 3])
def test_the_simulated_home_shows_its_walkers_doppler(n_rx: int) -> None:
    home = make_home(2, walks=1)
    walk = home.walks[0]
    radio = Radio(home, n_rx=n_rx, seed=1)
    heard = radio.generate(walk.start_s + 1.5, walk.end_s - 1.5)
    packets, _ = read_log(b"".join(data for _, data in radio.log_bytes(heard)), Attribution())
    mine = packets.mac == mac_from_text(home.device_mac)
    t_ns = np.rint(heard.t_s[mine] * 1e9).astype(np.int64)
    made = ratio_spectrogram(t_ns, packets.csi[mine])

    def path_m(t_s: float) -> float:
        state = walk.state(t_s)
        assert state is not None
        body = np.array([state.x_m, state.y_m, 1.0])
        return float(np.linalg.norm(body - home.anchor_m) + np.linalg.norm(body - home.device_m))

    centre_s = made.t_ns / 1e9
    rate_mps = np.array([(path_m(t + 0.05) - path_m(t - 0.05)) / 0.1 for t in centre_s])
    expected_hz = -rate_mps / WAVELENGTH_M
    moving = np.abs(expected_hz) > 6.0
    off_hz = ridge_hz(made)[moving] - expected_hz[moving]
    assert np.count_nonzero(moving) > 100
    assert np.mean(np.sign(ridge_hz(made)[moving]) == np.sign(expected_hz[moving])) > 0.95
    assert np.median(np.abs(off_hz)) < 3.0
