"""The bound is what an unbiased estimator reaches, and behaves as geometry and noise say."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from vad.mapping.bound import TrackNoise, doppler_bound
from vad.sim.track_error import track_error_m

FloatArray = NDArray[np.float64]

T_S = np.arange(0.0, 12.0, 0.1)
ANCHOR_M = np.array([3.0, 0.0, 1.4])
DEVICE_M = np.array([3.0, 2.4, 0.9])


def circle(middle_x_m: float = 1.2, middle_y_m: float = 1.5) -> FloatArray:
    angle = 2 * np.pi * T_S / 7.0
    return np.column_stack(
        [middle_x_m + 1.2 * np.cos(angle), middle_y_m + 1.2 * np.sin(angle), np.full(len(T_S), 1.05)]
    )


def path_m(walk_m: FloatArray, device_m: FloatArray) -> FloatArray:
    ends = (np.linalg.norm(walk_m - end, axis=1) for end in (ANCHOR_M, device_m))
    return np.sum(list(ends), axis=0)


def test_least_squares_with_the_true_covariance_reaches_the_bound() -> None:
    walk, noise = circle(), TrackNoise(0.01, 0.02)
    bound = doppler_bound(T_S, walk, ANCHOR_M, DEVICE_M, noise)
    rng = np.random.default_rng(3)
    true_plc = path_m(walk, DEVICE_M)
    units = [(walk - end) / np.linalg.norm(walk - end, axis=1)[:, None] for end in (ANCHOR_M, DEVICE_M)]
    g = (units[0] + units[1])[:, :2]
    weight = np.linalg.inv((g @ g.T) * noise.covariance_m2(T_S) + 1e-6 * np.eye(len(T_S)))
    errors = []
    for _ in range(300):
        seen = walk.copy()
        seen[:, :2] += track_error_m(noise, T_S, rng)
        guess = DEVICE_M.copy()
        for _ in range(6):  # Gauss-Newton
            offset = seen - guess
            slope = -offset[:, :2] / np.linalg.norm(offset, axis=1)[:, None]
            a = np.column_stack([slope, np.ones(len(T_S))])
            residual = true_plc - path_m(seen, guess)
            guess[:2] += np.linalg.solve(a.T @ weight @ a, a.T @ weight @ residual)[:2]
        errors.append(guess[:2] - DEVICE_M[:2])
    rms_m = np.sqrt((np.array(errors) ** 2).sum(axis=1).mean())
    assert rms_m == pytest.approx(bound.rms_m, rel=0.12)
    spread = np.cov(np.array(errors).T)
    assert np.sqrt(np.linalg.eigvalsh(spread)) == pytest.approx(
        np.sqrt(np.linalg.eigvalsh(bound.covariance_m2)), rel=0.15
    )


@given(st.floats(0.005, 0.05), st.floats(0.005, 0.08), st.floats(1.1, 3.0))
@settings(max_examples=25, deadline=None)
def test_error_grows_in_step_with_the_noise(white_m: float, slow_m: float, times: float) -> None:
    walk = circle()
    one = doppler_bound(T_S, walk, ANCHOR_M, DEVICE_M, TrackNoise(white_m, slow_m)).rms_m
    more = doppler_bound(T_S, walk, ANCHOR_M, DEVICE_M, TrackNoise(times * white_m, times * slow_m)).rms_m
    assert more / one == pytest.approx(times, rel=0.02)


def test_doppler_noise_only_adds() -> None:
    walk, noise = circle(), TrackNoise(0.03, 0.02)
    rms_m = [
        doppler_bound(T_S, walk, ANCHOR_M, DEVICE_M, noise, doppler_sigma_mps=sigma).rms_m
        for sigma in (0.0, 0.05, 0.2)
    ]
    assert rms_m == sorted(rms_m)
    assert rms_m[2] > 1.1 * rms_m[0]


def test_the_bound_turns_with_the_map() -> None:
    walk, noise, turn = circle(), TrackNoise(0.03, 0.06), np.eye(3)
    turn[:2, :2] = [[0.6, -0.8], [0.8, 0.6]]
    here = doppler_bound(T_S, walk, ANCHOR_M, DEVICE_M, noise).covariance_m2
    there = doppler_bound(T_S, walk @ turn.T, turn @ ANCHOR_M, turn @ DEVICE_M, noise).covariance_m2
    assert there == pytest.approx(turn[:2, :2] @ here @ turn[:2, :2].T)


def test_far_devices_are_worse_and_worst_in_range() -> None:
    noise, walk = TrackNoise(0.03, 0.02), circle()
    near = doppler_bound(T_S, walk, ANCHOR_M, DEVICE_M, noise)
    away = np.array([1.2 + 8.0, 1.5, 0.9])
    far = doppler_bound(T_S, walk, ANCHOR_M, away, noise)
    assert far.rms_m > 4 * near.rms_m
    variance, axes = np.linalg.eigh(far.covariance_m2)
    assert abs(axes[0, 1]) > 0.95
    assert variance[1] > 4 * variance[0]


def test_two_walks_know_more_than_one() -> None:
    noise = TrackNoise(0.03, 0.06)
    one = doppler_bound(T_S, circle(), ANCHOR_M, DEVICE_M, noise)
    assert one.plus(one).rms_m == pytest.approx(one.rms_m / np.sqrt(2))


def test_standing_still_tells_nothing() -> None:
    still = np.tile([1.0, 1.0, 1.05], (len(T_S), 1))
    assert np.isinf(doppler_bound(T_S, still, ANCHOR_M, DEVICE_M, TrackNoise(0.03, 0.02)).rms_m)
