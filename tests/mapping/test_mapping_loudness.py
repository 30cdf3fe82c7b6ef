"""Where a device is, from how the loudness of the walker's echo rises and falls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from vad.mapping.loudness import LoudnessModel, loudness_log_likelihood
from vad.mapping.posterior import Grid, Posterior
from vad.mapping.walk import WalkTrack
from vad.sensing.spectrogram import Spectrogram

ANCHOR = np.array([0.0, 0.0])
DEVICE = np.array([3.0, 2.0])
GRID = Grid.over((-1.0, -1.0, 5.0, 4.0), 0.25)
HOP_S = 0.05


def walk() -> WalkTrack:
    """Twice around the middle of the floor, 20 s."""
    t_s = np.arange(0.0, 20.0, 0.05)
    turn = 2 * np.pi * t_s / 10
    places = np.column_stack([2.0 + 1.3 * np.cos(turn), 1.5 + 1.0 * np.sin(turn)])
    return WalkTrack(np.rint(t_s * 1e9).astype(np.int64), places, np.full(len(t_s), 0.03))


def heard(slope: float, noise_db: float, zero_db: float = -31.0, seed: int = 1) -> Spectrogram:
    """Levels by the radar equation, `slope` of it; noise for half a second at a time."""
    t_ns = np.arange(0, 20_000_000_000 - 100_000_000, round(HOP_S * 1e9)).astype(np.int64)
    places = walk().position_m(t_ns)
    distances = np.linalg.norm(places - ANCHOR, axis=1) * np.linalg.norm(places - DEVICE, axis=1)
    rng = np.random.default_rng(seed)
    noise = np.convolve(rng.normal(size=len(t_ns)), np.ones(10) / np.sqrt(10), mode="same")
    level_db = zero_db - slope * 20 * np.log10(distances) + noise_db * noise
    flat: NDArray[np.float64] = np.ones((len(t_ns), 3))
    return Spectrogram(t_ns, np.array([-1.0, 0.0, 1.0]), flat, 0 * flat, np.ones(len(t_ns)), level_db)


def place(spectra: Spectrogram) -> Posterior:
    found = loudness_log_likelihood(spectra, walk(), ANCHOR, GRID.points_m)
    return Posterior(GRID, found.reshape(GRID.rows, GRID.columns))


@pytest.mark.parametrize("slope", [0.3, 0.6, 0.9])
def test_a_loud_echo_is_near_however_steeply_it_falls(slope: float) -> None:
    posterior = place(heard(slope, 0.5))
    mean, _ = posterior.mean_and_covariance()
    assert np.linalg.norm(mean - DEVICE) < 0.8
    column, row = np.rint((DEVICE - [GRID.x0_m, GRID.y0_m]) / GRID.step_m).astype(int)
    assert posterior.region(0.9)[row, column]


def test_the_zero_of_the_level_says_nothing() -> None:
    quiet, loud = (place(heard(0.5, 1.0, zero)).log_density for zero in (-60.0, 0.0))
    assert quiet - quiet.max() == pytest.approx(loud - loud.max(), abs=1e-6)


def test_what_is_noise_alone_says_little() -> None:
    said = place(heard(0.0, 2.7)).log_density
    assert said.max() - said.min() < 6.0


def test_what_packets_do_not_cover_is_not_asked() -> None:
    spectra = heard(0.5, 0.5)
    holed = replace(
        spectra,
        weight=np.where(np.arange(len(spectra.t_ns)) < 200, 0.0, 1.0),
        level_db=np.where(np.arange(len(spectra.t_ns)) < 200, -120.0, spectra.level_db),
    )
    mean, _ = place(holed).mean_and_covariance()
    assert np.linalg.norm(mean - DEVICE) < 1.0
    nothing = replace(spectra, weight=np.zeros(len(spectra.t_ns)))
    assert not loudness_log_likelihood(nothing, walk(), ANCHOR, GRID.points_m).any()


def test_where_the_known_ends_height_is_not_known_it_is_summed_up_coarsely() -> None:
    points = GRID.points_m
    unknown = loudness_log_likelihood(heard(0.5, 0.5), walk(), ANCHOR, points)
    known = loudness_log_likelihood(heard(0.5, 0.5), walk(), ANCHOR, points, anchor_z_m=0.95)
    assert np.argmax(known) != np.argmin(unknown)
    assert np.corrcoef(known, unknown)[0, 1] > 0.8


def test_a_model_that_expects_no_fall_hears_nothing() -> None:
    deaf = LoudnessModel(slope=0.0, slope_sd=1e-6)
    said = loudness_log_likelihood(heard(0.9, 0.5), walk(), ANCHOR, GRID.points_m, model=deaf)
    assert np.ptp(said) < 1e-3
