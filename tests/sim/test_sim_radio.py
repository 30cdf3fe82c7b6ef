"""The simulated radio: its records are the card's, its Doppler is the walker's, like real recordings."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from effort import effort
from numpy.typing import NDArray

from vad.csi.attribution import Attribution
from vad.csi.logfile import read_log
from vad.mac import mac_from_text
from vad.sim.radio import HUB_MAC, NEIGHBOUR_MAC, OTHER_MAC, Radio, RadioBatch
from vad.sim.radio_body import BodyTrack
from vad.sim.radio_channel import CEILING_M, LIGHT_MPS, SUBCARRIERS, WAVELENGTH_M, Channel, path_sum
from vad.sim.scenario import Scenario, make_home

FloatArray = NDArray[np.float64]

RECORDINGS = (
    "circle_ccw_t1_rx1",
    "circle_ccw_t2_rx2",
    "diamond_ccw_t1_rx3",
    "diamond_ccw_corridor_t2_rx2",
    "circle_ccw_corridor_t1_rx1",
)


# --- a small Doppler estimator of its own (method.md 2), so that the simulator is not judged by the product


def spectrogram(t_s: FloatArray, csi: NDArray[np.complex64]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Frame times, frequencies and mean normalised power (frames, bins) of csi (N, 30, 3)'s antenna ratio."""
    grid = np.arange(t_s[0], t_s[-1], 1 / 400)
    i = np.clip(np.searchsorted(t_s, grid), 1, len(t_s) - 1)
    h = csi[np.where(grid - t_s[i - 1] < t_s[i] - grid, i - 1, i)].astype(np.complex128)
    strong = int(np.argmax((np.abs(h) ** 2).mean(axis=(0, 1))))
    reference = h[:, :, [strong]]
    ratio = np.delete(h, strong, axis=2) / np.where(np.abs(reference) < 1e-6, 1e-6, reference)
    ratio = ratio.reshape(len(h), -1)
    limit = 6 * np.median(np.abs(ratio), axis=0)
    ratio *= np.minimum(1.0, limit / np.maximum(np.abs(ratio), 1e-9))
    spectrum = np.fft.fft(ratio, axis=0)
    spectrum[np.abs(np.fft.fftfreq(len(ratio), 1 / 400)) > 80] = 0
    ratio = np.fft.ifft(spectrum, axis=0)[::2]
    ratio /= ratio.std(axis=0)
    start = np.arange(0, len(ratio) - 80, 10)
    frames = ratio[start[:, None] + np.arange(80)]
    frames = (frames - frames.mean(axis=1, keepdims=True)) * np.hanning(80)[:, None]
    power = np.abs(np.fft.fftshift(np.fft.fft(frames, 256, axis=1), axes=1)) ** 2
    power = (power / power.sum(axis=1, keepdims=True)).mean(axis=2)
    f_hz = np.fft.fftshift(np.fft.fftfreq(256, 1 / 200))
    kernel = np.exp(-0.5 * (np.arange(-8, 9) * (f_hz[1] - f_hz[0]) / 1.5) ** 2)
    power = np.array([np.convolve(row, kernel / kernel.sum(), "same") for row in power])
    keep = np.abs(f_hz) <= 60
    return grid[0] + (start + 40) / 200, f_hz[keep], power[:, keep]


@dataclass(frozen=True)
class Ridge:
    """error_mps: median PLCR error of the spectrogram's maximum; sign: part of fast frames with the right
    sign; mirror_db, floor_db: power at the true Doppler over that at its negative, over the median."""

    error_mps: float
    sign: float
    mirror_db: float
    floor_db: float


def judge(t_s: FloatArray, csi: NDArray[np.complex64], plcr_t_s: FloatArray, plcr: FloatArray) -> Ridge:
    frame_s, f_hz, power = spectrogram(t_s, csi)
    true = np.interp(frame_s, plcr_t_s, plcr, left=np.nan, right=np.nan)
    moving, fast = np.abs(true) >= 0.25, np.abs(true) >= 0.5
    ridge = -WAVELENGTH_M * f_hz[np.argmax(power, axis=1)]
    # NaN, outside the walk, is in neither set.
    here, mirror = (
        np.array([np.interp(sign * v / WAVELENGTH_M, f_hz, row) for v, row in zip(true, power, strict=True)])
        for sign in (-1, 1)
    )
    return Ridge(
        float(np.median(np.abs(ridge - true)[moving])),
        float((np.sign(ridge) == np.sign(true))[fast].mean()),
        float(10 * np.log10(here[fast].mean() / mirror[fast].mean())),
        float(10 * np.log10(np.median((here / np.median(power, axis=1))[fast]))),
    )


def path_change(xy_m: FloatArray, step_s: float, a_m: FloatArray, b_m: FloatArray, z_m: float) -> FloatArray:
    """d/dt (|P a| + |P b|) of a walker at height z_m."""
    p = np.column_stack([xy_m, np.full(len(xy_m), z_m)])
    length = np.linalg.norm(p - a_m, axis=1) + np.linalg.norm(p - b_m, axis=1)
    speed: FloatArray = np.gradient(length, step_s)
    return speed


def decoded(
    home: Scenario, radio: Radio, t0_s: float, t1_s: float
) -> tuple[FloatArray, NDArray[np.complex64]]:
    """Times and CSI of the device's packets, by way of the log's bytes."""
    batch = radio.generate(t0_s, t1_s)
    packets, _ = read_log(b"".join(data for _, data in radio.log_bytes(batch)))
    mine = batch.mac == mac_from_text(home.device_mac)
    return batch.t_s[mine], packets.csi[mine, :, :, 0]


def simulated_ridge(seed: int) -> Ridge:
    home = make_home(seed, walks=1)
    walk = home.walks[0]
    t_s, csi = decoded(home, Radio(home, seed=seed), walk.start_s - 0.5, walk.end_s + 0.5)
    truth = path_change(
        walk.xy_m, 0.05, np.array(home.device_m), np.array(home.anchor_m), 0.62 * walk.height_m
    )
    return judge(t_s, csi, walk.start_s + 0.05 * np.arange(len(walk.xy_m), dtype=np.float64), truth)


@pytest.mark.parametrize("seed", [0, 1, 2, 3, 4])
def test_doppler_follows_the_walker(seed: int, record_property: Callable[[str, object], None]) -> None:
    ridge = simulated_ridge(seed)
    record_property("ridge", str(ridge))
    assert ridge.error_mps < 0.15
    assert ridge.sign > 0.95
    assert ridge.mirror_db > 6
    assert 5 < ridge.floor_db < 26


@pytest.mark.parametrize("name", RECORDINGS)
def test_real_recordings_have_the_same_sign_and_shape(
    shared_data: Path, name: str, record_property: Callable[[str, object], None]
) -> None:
    folder = shared_data / "csi" / "witraj" / name
    packets, _ = read_log((folder / "csi.dat").read_bytes())
    t_s = np.cumsum(np.diff(packets.nic_us, prepend=packets.nic_us[:1]).astype(np.float64)) * 1e-6
    device = json.loads((folder / "truth.json").read_text())["device"]
    track = np.genfromtxt(folder / "trajectory_all_links.csv", delimiter=",", skip_header=1)
    step_s = float(np.median(np.diff(track[:, 0]))) * 1e-9
    truth = path_change(track[:, 1:3], step_s, np.array([0.0, 0, 1]), np.array([*device.values(), 1.0]), 1.0)
    ridge = judge(t_s, packets.csi[:, :, :, 0], track[:, 0] * 1e-9, truth)
    record_property("ridge", str(ridge))
    assert ridge.error_mps < 0.25
    assert ridge.sign > 0.9
    assert ridge.mirror_db > 6
    assert 5 < ridge.floor_db < 26


# --- the records


@pytest.fixture(scope="module")
def home() -> Scenario:
    return make_home(1, walks=1)


@pytest.fixture(scope="module")
def stretch(home: Scenario) -> RadioBatch:
    return Radio(home, seed=1).generate(home.join_s - 2.0, home.join_s + 12.0)


def test_same_packets_however_time_is_cut(home: Scenario, stretch: RadioBatch) -> None:
    radio = Radio(home, seed=1)
    edges = home.join_s + np.concatenate([[-2.0], np.arange(-1.983, 1.9, 0.0217), [2.0]])
    parts = [radio.generate(float(a), float(b)) for a, b in pairwise(edges)]
    n = sum(map(len, parts))
    assert n > 700
    for name in ("t_s", "csi", "rssi", "agc", "antenna_sel", "rate", "bfee_count", "nic_us", "mac"):
        joined = np.concatenate([getattr(p, name) for p in parts])
        assert (joined == getattr(stretch, name)[:n]).all(), name
    legacy = [frame for p in parts for frame in p.legacy_frames]
    assert legacy == list(stretch.legacy_frames[: len(legacy)])
    assert len(legacy) > 40
    other = Radio(home, seed=2).generate(home.join_s, home.join_s + 1.0)
    assert not np.array_equal(other.csi[:50], stretch.csi[-50:])


def test_log_is_read_back_and_attributed(home: Scenario, stretch: RadioBatch) -> None:
    timed = Radio(home, seed=1).log_bytes(stretch)
    assert all(a[0] <= b[0] for a, b in pairwise(timed))
    packets, stats = read_log(b"".join(data for _, data in timed), Attribution())
    assert len(packets) == len(stretch)
    assert not stats.bad
    assert stats.truncated_bytes == 0
    want = stretch.csi[..., 0].astype(np.float32) + 1j * stretch.csi[..., 1].astype(np.float32)
    assert (packets.csi == want).all()
    for name in ("nic_us", "bfee_count", "rssi", "noise_dbm", "agc", "antenna_sel", "rate"):
        assert (getattr(packets, name) == getattr(stretch, name)).all(), name
    known = packets.mac >= 0
    assert (packets.mac[known] == stretch.mac[known]).all()
    gaps = np.diff(stretch.bfee_count) != 1
    assert (known[1:] == ~gaps).all()
    assert set(stretch.mac.tolist()) == {mac_from_text(home.device_mac), OTHER_MAC}
    assert NEIGHBOUR_MAC not in packets.mac
    assert HUB_MAC not in packets.mac


def test_packet_fields_are_the_cards(home: Scenario, stretch: RadioBatch) -> None:
    device = stretch.mac == mac_from_text(home.device_mac)
    assert stretch.t_s[device].min() >= home.join_s
    assert (stretch.t_s < home.join_s).sum() > 10  # the other station was there before
    assert (np.diff(stretch.t_s) > 0).all()
    seen = 400 * 12.0
    assert 0.005 < 1 - device.sum() / seen < 0.04
    lost = (np.diff(stretch.bfee_count) - np.uint16(1)).sum()
    assert lost == pytest.approx(seen - device.sum(), abs=8)
    nic = np.diff(stretch.nic_us).astype(np.float64) * 1e-6
    assert np.allclose(nic, np.diff(stretch.t_s), atol=2e-6, rtol=5e-5)
    largest = np.abs(stretch.csi.astype(int)).max(axis=(1, 2, 3, 4))
    assert 30 < np.median(largest) < 80
    assert stretch.csi.min() >= -127
    assert len(np.unique(stretch.antenna_sel)) == 2
    total = 10 * np.log10((10 ** (stretch.rssi / 10)).sum(axis=1))
    assert abs(np.median(total) - 40) < 1.5
    assert 0 < stretch.agc.min() < stretch.agc.max() <= 63
    # RSSI is by antenna, as the rows are.
    rows_db = 10 * np.log10((stretch.csi.astype(float) ** 2).sum(axis=(1, 3, 4)))
    d_rssi = stretch.rssi[:, 0].astype(float) - stretch.rssi[:, 1]
    assert np.corrcoef(d_rssi, rows_db[:, 0] - rows_db[:, 1])[0, 1] > 0.7


@pytest.mark.parametrize("n_rx", [1, 2])
def test_fewer_antennas(home: Scenario, n_rx: int) -> None:
    radio = Radio(home, n_rx=n_rx, seed=0)
    batch = radio.generate(home.join_s, home.join_s + 0.3)
    packets, stats = read_log(b"".join(data for _, data in radio.log_bytes(batch)))
    assert not stats.bad
    assert packets.csi.shape[1:] == (30, n_rx, 1)
    assert (batch.rssi[:, n_rx:] == 0).all()


def test_bad_arguments(home: Scenario) -> None:
    with pytest.raises(ValueError, match="antennas"):
        Radio(home, n_rx=4, seed=0)
    with pytest.raises(ValueError, match="positive"):
        Radio(home, packets_per_s=0.0, seed=0)
    assert len(Radio(home, seed=0).generate(-1.0, 0.0)) == 0


def test_a_second_costs_little(home: Scenario) -> None:
    radio = Radio(home, seed=1)

    def play(t_s: float) -> None:
        radio.log_bytes(radio.generate(t_s, t_s + 1.0))

    t0_s = home.walks[0].start_s
    assert effort(*(partial(play, t0_s + k) for k in range(5))) < 12


# --- the physics


def test_phase_of_a_path() -> None:
    length = np.array([[[3.0, 3.0 + WAVELENGTH_M / 4]]])
    h = path_sum(np.array([[2.0]]), length)[0]
    carrier = 2 * np.exp(-2j * np.pi * np.array([0.0, 0.25]))
    middle = h[:, 14] * h[:, 15]  # subcarriers -1 and 1
    assert np.allclose(middle[1] / middle[0], (carrier[1] / carrier[0]) ** 2, atol=1e-3)
    slope = np.polyfit(SUBCARRIERS, np.unwrap(np.angle(h[0])), 1)[0]
    assert slope == pytest.approx(-2 * np.pi * 312_500 * 3.0 / LIGHT_MPS, rel=0.01)


def test_body_moves_smoothly_along_the_scenarios_path(home: Scenario) -> None:
    walk = home.walks[0]
    t_s = np.arange(walk.start_s, walk.end_s, 0.0025)
    body = BodyTrack(walk).at(t_s)
    states = [home.walker_at(float(t)) for t in t_s]
    feet = np.array([(s.x_m, s.y_m) for s in states if s is not None])
    assert np.linalg.norm(body.centre_m[:, :2] - feet, axis=1).max() < 0.03
    # The acceleration is the path's own and the gait's, and continuous: the phase has no kinks.
    acceleration = np.diff(body.centre_m[:, :2], 2, axis=0) / 0.0025**2
    of_path = np.abs(np.diff(walk.xy_m, 2, axis=0)).max() / 0.05**2
    assert np.abs(acceleration).max() < of_path + 3
    assert np.abs(np.diff(acceleration, axis=0)).max() < 0.15 * of_path
    assert (body.fade[[0, -1]] < 0.01).all()
    assert body.fade.max() == 1
    gait = np.array([s.phase_rad for s in states if s is not None])
    assert np.abs(gait - body.gait_rad).max() < 0.3
    torso, broad = body.torso_m(np.array([[50.0, 0, 1]]), np.array([[50.0, 1, 1]]))
    ahead = torso[:, 0] - body.centre_m
    assert ((ahead[:, 0] > 0.12) & (ahead[:, 0] < 0.19)).all()  # in front of the body, towards the link
    assert ((broad > 0.69) & (broad <= 1.0)).all()


def test_body_on_the_line_of_sight_blocks_it(home: Scenario) -> None:
    walk = home.walks[0]
    rx = np.array([[-50.0, 0.0, 1.0]])
    t_s = np.arange(walk.start_s + 1, walk.end_s - 1, 0.05)
    body = BodyTrack(walk).at(t_s)
    tx = 2 * body.centre_m[100] - rx[0]
    tx[2] = 1.0
    low = Channel(home, tx, rx, np.random.default_rng(0)).shadow(body)
    assert low[100] == pytest.approx(0.75, abs=0.02)
    assert low.min() < 0.01
    over_head = np.array([0.0, 0.0, CEILING_M])
    assert Channel(home, tx + over_head, rx + over_head, np.random.default_rng(0)).shadow(body).max() < 1e-3


def test_empty_room_is_still(home: Scenario) -> None:
    rx = np.array(home.anchor_m) + np.arange(3)[:, None] * np.array([WAVELENGTH_M / 2, 0, 0])
    channel = Channel(home, np.array(home.device_m), rx, np.random.default_rng(0))
    before = channel.response(np.linspace(0, 1, 5))
    assert (before == before[0]).all()
    during = channel.response(home.walks[0].start_s + np.linspace(2, 3, 50))
    assert np.abs(during - before[0]).max() > 0.01 * np.sqrt(channel.still_power)
