"""The spectrogram likelihood: made Doppler leads to the place; unusable data are refused with a reason."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from vad.mapping.device_stage import ArrayEnd, Recording, evidence_from_walk, place_from_posterior
from vad.mapping.doppler_likelihood import SPEED_OF_LIGHT_MPS
from vad.mapping.doppler_line import LineModel, predicted_doppler_hz
from vad.mapping.posterior import Grid
from vad.mapping.walk import WalkTrack
from vad.sensing.path_length import path_length
from vad.sensing.resample import antenna_ratio, to_uniform
from vad.sensing.spectrogram import spectrogram
from vad.sensing.template import moving_part

pytestmark = pytest.mark.timeout(600)
"""Much work for the processor: a busy machine takes many times as long as an idle one."""

CARRIER_HZ = 5.24e9
WAVELENGTH_M = SPEED_OF_LIGHT_MPS / CARRIER_HZ
ANCHOR = np.array([0.0, 0.0])
DEVICE = np.array([3.6, 0.4])
SHOWN = 0.95
"""Share of the body's speed that its echo shows: legs and arms are part of it."""
GRID = Grid.over((-2.0, -2.0, 6.0, 6.0), 0.1)


def circle_walk(seconds: float = 14.0, speed_mps: float = 0.9) -> WalkTrack:
    t_s = np.arange(0.0, seconds, 0.1)
    angle = speed_mps * t_s / 1.5
    xy = np.stack([2.0 + 1.5 * np.cos(angle), 2.4 + 1.5 * np.sin(angle)], axis=1)
    return WalkTrack((t_s * 1e9).astype(np.int64), xy, np.full(len(t_s), 0.03))


def path_m(body_m: NDArray[np.float64], device_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Anchor - body's surface - device, (N,), a body 0.1 m thick, 1 m and 0.8 m lower."""
    to_anchor, to_device = body_m - ANCHOR, body_m - device_m
    anchor, device = np.sqrt((to_anchor**2).sum(1) + 1.0), np.sqrt((to_device**2).sum(1) + 0.64)
    bisector = to_anchor / anchor[:, None] + to_device / device[:, None]
    return np.asarray(SHOWN * (anchor + device - 0.1 * np.linalg.norm(bisector, axis=1)))


def made_csi(
    walk: WalkTrack, device_m: NDArray[np.float64], *, n_rx: int = 3, rate_hz: float = 400.0, seed: int = 1
) -> tuple[NDArray[np.int64], NDArray[np.complex64]]:
    """Static paths, one body reflection, a random phase per packet, noise at 20 dB."""
    rng = np.random.default_rng(seed)
    t_ns = np.arange(walk.t_ns[0], walk.t_ns[-1], int(1e9 / rate_hz))
    fine = WalkTrack(walk.t_ns, walk.xy_m, walk.sigma_m).position_m(t_ns)
    length = path_m(fine, device_m)
    subcarrier_hz = np.linspace(-8.75e6, 8.75e6, 30)
    static = rng.normal(size=(30, n_rx)) + 1j * rng.normal(size=(30, n_rx))
    chain = np.exp(1j * rng.uniform(0, 2 * np.pi, n_rx))
    # Longer path, later phase: exp(-j 2 pi f L / c), the sign of the real recordings.
    turn = np.exp(-2j * np.pi * (CARRIER_HZ + subcarrier_hz) * length[:, None] / SPEED_OF_LIGHT_MPS)
    csi = static + 0.3 * turn[:, :, None] * chain
    noise = rng.normal(size=csi.shape) + 1j * rng.normal(size=csi.shape)
    common = np.exp(1j * rng.uniform(0, 2 * np.pi, len(t_ns)))
    return t_ns, ((csi + 0.1 * noise) * common[:, None, None])[..., None].astype(np.complex64)


def recording(
    t_ns: NDArray[np.int64], csi: NDArray[np.complex64], walk: WalkTrack, array_end: ArrayEnd = "anchor"
) -> Recording:
    """The made packets say nothing of directions: their antennas stand at the known end."""
    return Recording(t_ns, csi, walk, ANCHOR, carrier_hz=CARRIER_HZ, array_end=array_end)


@pytest.mark.parametrize("n_rx", [1, 2, 3])
def test_made_doppler_leads_to_the_device(n_rx: int) -> None:
    walk = circle_walk()
    t_ns, csi = made_csi(walk, DEVICE, n_rx=n_rx)
    evidence = evidence_from_walk(recording(t_ns, csi, walk), GRID)
    assert evidence.status == "located"
    assert evidence.posterior is not None
    place = place_from_posterior(evidence.posterior)
    assert np.linalg.norm(place.xy_m - DEVICE) < 0.5
    cell = int(np.argmin(np.linalg.norm(GRID.points_m - DEVICE, axis=1)))
    assert evidence.posterior.region(0.9).ravel()[cell]


def test_the_known_end_may_send_or_receive() -> None:
    """T and R are symmetric: the prediction does not change when they are exchanged (heights alike)."""
    walk = circle_walk()
    t_ns = walk.t_ns[5:-5]
    model = LineModel(unknown_device_m2=1.0)
    there = predicted_doppler_hz(DEVICE[None], walk, ANCHOR, t_ns, wavelength_m=WAVELENGTH_M, model=model)
    back = predicted_doppler_hz(ANCHOR[None], walk, DEVICE, t_ns, wavelength_m=WAVELENGTH_M, model=model)
    assert there == pytest.approx(back, abs=1e-6)


def test_the_ridge_follows_the_path_length() -> None:
    walk = circle_walk()
    t_ns, csi = made_csi(walk, DEVICE)
    spectra = spectrogram(to_uniform(t_ns, antenna_ratio(csi)))
    path = path_length(spectra, wavelength_m=WAVELENGTH_M)
    true_hz = predicted_doppler_hz(DEVICE[None], walk, ANCHOR, spectra.t_ns, wavelength_m=WAVELENGTH_M)[:, 0]
    assert np.median(np.abs(path.f_hz - true_hz)) * WAVELENGTH_M < 0.1
    fast = np.abs(true_hz) > 8
    assert np.mean(np.sign(path.f_hz[fast]) == np.sign(true_hz[fast])) > 0.95


def test_a_hole_in_the_packets_carries_no_weight() -> None:
    walk = circle_walk()
    t_ns, csi = made_csi(walk, DEVICE)
    keep = (t_ns < 5_000_000_000) | (t_ns > 7_000_000_000)
    spectra = spectrogram(to_uniform(t_ns[keep], antenna_ratio(csi[keep])))
    inside = (spectra.t_ns > 5_200_000_000) & (spectra.t_ns < 6_800_000_000)
    assert np.all(spectra.weight[inside] == 0)
    assert np.all(np.isfinite(spectra.log_likelihood))
    evidence = evidence_from_walk(recording(t_ns[keep], csi[keep], walk), GRID)
    assert evidence.posterior is not None


def test_what_cannot_be_solved_is_refused_with_its_reason() -> None:
    walk = circle_walk()
    t_ns, csi = made_csi(walk, DEVICE)
    still = WalkTrack(walk.t_ns, np.full_like(walk.xy_m, 2.0), walk.sigma_m)
    cases = [
        (t_ns[:100], csi[:100], walk, "overlap"),
        (t_ns[::20], csi[::20], walk, "packets/s are too few"),
        (t_ns, csi, still, "moved 0.0 m only"),
        (t_ns[:0], csi[:0], walk, "no CSI packets"),
    ]
    for times, values, track, reason in cases:
        evidence = evidence_from_walk(recording(times, values, track), GRID)
        assert evidence.status == "refused"
        assert reason in evidence.reason
        assert evidence.posterior is None


def test_a_straight_walk_is_not_a_confident_point() -> None:
    t_s = np.arange(0.0, 8.0, 0.1)
    straight = WalkTrack(
        (t_s * 1e9).astype(np.int64),
        np.stack([0.5 + 0.6 * t_s, np.full_like(t_s, 2.0)], axis=1),
        np.full(len(t_s), 0.03),
    )
    t_ns, csi = made_csi(straight, DEVICE)
    evidence = evidence_from_walk(recording(t_ns, csi, straight), GRID)
    assert evidence.status == "uncertain"
    assert "mirror" in evidence.reason


def test_asked_to_stop_it_stops() -> None:
    walk = circle_walk()
    t_ns, csi = made_csi(walk, DEVICE)
    evidence = evidence_from_walk(recording(t_ns, csi, walk), GRID, should_stop=lambda: True)
    assert evidence.status == "refused"
    assert evidence.posterior is None


def test_a_walk_with_late_stamps_is_put_right() -> None:
    walk = circle_walk()
    t_ns, csi = made_csi(walk, DEVICE)
    late = WalkTrack(walk.t_ns + 300_000_000, walk.xy_m, walk.sigma_m)
    errors = []
    for track in (walk, late):
        evidence = evidence_from_walk(recording(t_ns, csi, track), GRID)
        assert evidence.posterior is not None
        errors.append(np.linalg.norm(place_from_posterior(evidence.posterior).xy_m - DEVICE))
    assert errors[1] < errors[0] + 0.15


def test_the_antennas_of_the_device_tell_the_direction() -> None:
    """Packets whose phases turn with the direction to the walker, as a device with antennas sees them."""
    walk = circle_walk()
    t_ns, _ = made_csi(walk, DEVICE)
    position = walk.position_m(t_ns)
    towards = (position - DEVICE) / np.linalg.norm(position - DEVICE, axis=1, keepdims=True)
    places = np.array([[0.0, 0.0], [0.028, 0.0], [0.028, 0.028]])
    length = path_m(position, DEVICE)
    lead = towards @ places.T
    rng = np.random.default_rng(3)
    static = rng.normal(size=(30, 3)) + 1j * rng.normal(size=(30, 3))
    f_hz = CARRIER_HZ + np.linspace(-8.75e6, 8.75e6, 30)
    turn = -2j * np.pi / SPEED_OF_LIGHT_MPS
    echo = np.exp(turn * f_hz[None, :, None] * (length[:, None] - lead)[:, None, :])
    noise = rng.normal(size=echo.shape) + 1j * rng.normal(size=echo.shape)
    values = (static + 0.3 * echo + 0.05 * noise).astype(np.complex64)[..., None]
    spread = {}
    ends: tuple[ArrayEnd, ArrayEnd] = ("device", "anchor")
    for end in ends:
        evidence = evidence_from_walk(recording(t_ns, values, walk, end), GRID)
        assert evidence.posterior is not None
        place = place_from_posterior(evidence.posterior)
        assert np.linalg.norm(place.xy_m - DEVICE) < place.radius90_m
        spread[end] = place.radius90_m
    assert spread["device"] < spread["anchor"]


def test_what_stands_still_is_taken_out_and_what_moves_stays() -> None:
    walk = circle_walk()
    t_ns, csi = made_csi(walk, DEVICE)
    moving = moving_part(csi)
    assert moving.shape == csi.shape
    still = np.repeat(csi[:1], 500, axis=0)
    assert np.abs(moving_part(still)).max() < 1e-3
    path = path_length(
        spectrogram(to_uniform(t_ns, moving.reshape(len(moving), -1))), wavelength_m=WAVELENGTH_M
    )
    true_hz = predicted_doppler_hz(DEVICE[None], walk, ANCHOR, path.t_ns, wavelength_m=WAVELENGTH_M)[:, 0]
    assert np.median(np.abs(path.f_hz - true_hz)) * WAVELENGTH_M < 0.12
