"""Identities and smooth paths of people on the floor."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vad.vision.tracks import FloatArray, Track, Tracker, lone_mover, smooth

RATE_HZ = 15.0


def covariance(sigma_m: float, count: int = 1) -> FloatArray:
    return np.repeat(np.eye(2)[None] * sigma_m**2, count, axis=0)


def run(tracker: Tracker, places: list[FloatArray], sigma_m: float = 0.08, start_s: float = 1.0) -> int:
    """Feed frames of (N, 2) places; the time of the last in ns."""
    t_ns = 0
    for k, points in enumerate(places):
        t_ns = int((start_s + k / RATE_HZ) * 1e9)
        tracker.update(t_ns, points, covariance(sigma_m, len(points)))
    return t_ns


@pytest.mark.parametrize("seed", range(5))
def test_two_crossing_walkers_keep_their_identities(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t = np.arange(0, 6, 1 / RATE_HZ)
    a = np.stack([0.8 * t, 0.7 * t], axis=1)
    b = np.stack([0.8 * t, 4.2 - 0.7 * t], axis=1)  # they meet at (2.4, 2.1)
    places = []
    for pa, pb in zip(a, b, strict=True):
        both = np.array([pa, pb]) + rng.normal(0, 0.08, (2, 2))
        places.append(both[rng.permutation(2)] if rng.random() > 0.1 else both[:1])
    tracker = Tracker()
    end_ns = run(tracker, places)
    first, second = tracker.tracks()
    climbs = sorted(float(track.xy_m[-1, 1] - track.xy_m[0, 1]) for track in (first, second))
    assert climbs == pytest.approx([-4.2, 4.2], abs=0.5)
    assert lone_mover(tracker.tracks(), end_ns) is None


def test_a_single_false_point_is_nobody() -> None:
    tracker = Tracker()
    still = np.array([[1.0, 1.0]])
    places = [still] * 10 + [np.array([[1.0, 1.0], [4.0, 4.0]])] + [still] * 10
    run(tracker, places)
    (track,) = tracker.tracks()
    assert len(track.t_ns) == 21


def test_a_track_survives_a_short_gap_and_ends_after_a_long_one() -> None:
    empty, t = np.zeros((0, 2)), np.arange(0, 2, 1 / RATE_HZ)
    path = [np.array([[0.9 * s, 1.0]]) for s in t]
    after = [np.array([[0.9 * (2.8 + s), 1.0]]) for s in t]
    tracker = Tracker()
    end_ns = run(tracker, [*path, *[empty] * 12, *after])
    (track,) = tracker.tracks()
    assert not track.ended
    tracker.update(end_ns + 1_600_000_000, empty, np.zeros((0, 2, 2)))
    (track,) = tracker.tracks()
    assert track.ended
    # After a pause of the frames themselves a newcomer is a new person, even at the old one's place.
    later_ns = end_ns + 9_000_000_000
    for k in range(4):
        tracker.update(later_ns + k * 66_000_000, track.xy_m[-1:], covariance(0.08))
    assert [x.id for x in tracker.tracks() if not x.ended] != [track.id]
    tracker.update(later_ns + 200_000_000_000, empty, np.zeros((0, 2, 2)))
    tracker.update(later_ns + 400_000_000_000, empty, np.zeros((0, 2, 2)))
    assert tracker.tracks() == []


def test_the_one_who_moves_is_named_among_those_who_sit() -> None:
    rng = np.random.default_rng(7)
    t = np.arange(0, 3, 1 / RATE_HZ)
    sitting = np.array([4.0, 4.0])
    tracker = Tracker()
    end_ns = run(tracker, [np.array([[0.9 * s, 1.0], sitting]) + rng.normal(0, 0.05, (2, 2)) for s in t])
    mover = lone_mover(tracker.tracks(), end_ns)
    (named,) = [track for track in tracker.tracks() if track.id == mover]
    assert named.xy_m[-1, 1] == pytest.approx(1.0, abs=0.3)
    assert lone_mover(tracker.tracks(), end_ns + 2_000_000_000) is None


def test_points_at_infinity_are_left_out_and_time_goes_forwards() -> None:
    tracker = Tracker()
    run(tracker, [np.array([[np.nan, 1.0], [1.0, 1.0]])] * 4)
    assert len(tracker.tracks()) == 1
    with pytest.raises(ValueError, match="order of time"):
        tracker.update(0, np.zeros((0, 2)), np.zeros((0, 2, 2)))


@settings(max_examples=40, deadline=None)
@given(st.lists(st.lists(st.tuples(st.floats(-9, 9), st.floats(-9, 9)), max_size=6), max_size=25))
def test_any_points_leave_tracks_in_order(frames: list[list[tuple[float, float]]]) -> None:
    tracker = Tracker()
    run(tracker, [np.array(points, dtype=float).reshape(-1, 2) for points in frames])
    for track in tracker.tracks():
        assert np.all(np.diff(track.t_ns) > 0)
        assert track.xy_m.shape == (len(track.t_ns), 2)


def stepping_walk(seed: int, step_hz: float, sigma_m: float = 0.09) -> tuple[Track, FloatArray]:
    """A measured round walk of 14 s with swing, noise and a slow error; and the true velocity's function."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.uniform(0, 14, 200))
    t_ns = (t * 1e9).astype(np.int64)
    white, swing, slow = (np.sqrt(share) * sigma_m for share in (0.25, 0.5, 0.25))
    phase = rng.uniform(0, 2 * np.pi, 2)
    error = rng.normal(0, white, (len(t), 2)) + rng.normal(0, slow, 2)
    error += np.sqrt(2) * swing * np.cos(2 * np.pi * step_hz * t[:, None] + phase)
    track = Track(1, t_ns, true_path(t) + error, covariance(sigma_m, len(t)), True)
    return track, true_path(t)


def true_path(t: FloatArray) -> FloatArray:
    angle = 2 * np.pi * t / 12
    return np.stack([1.6 * np.cos(angle), 1.3 * np.sin(angle) + 0.2 * np.sin(2 * angle)], axis=1)


@pytest.mark.parametrize("step_hz", [1.3, 1.8])
def test_smoothing_removes_the_steps_and_its_covariance_is_true_within_a_factor_of_2(step_hz: float) -> None:
    errors, ratios, raw, speed_errors = [], [], [], []
    for seed in range(25):
        track, truth = stepping_walk(seed, step_hz)
        result = smooth(track)
        at_s = result.t_ns * 1e-9
        error = result.xy_m - true_path(at_s)
        weight = np.linalg.inv(result.covariance_m2)
        ratios.append(np.einsum("ni,nij,nj->n", error, weight, error).mean() / 2)
        errors.append(np.mean(error**2))
        raw.append(np.mean((track.xy_m - truth) ** 2))
        velocity = (true_path(at_s + 0.01) - true_path(at_s - 0.01)) / 0.02
        speed_errors.append(np.mean((result.velocity_mps - velocity) ** 2))
        assert np.all(np.linalg.eigvalsh(result.covariance_m2 - result.slow_covariance_m2) > 0)
    assert 0.5 < np.mean(ratios) < 2.0
    assert np.sqrt(np.mean(errors)) < 0.7 * np.sqrt(np.mean(raw))
    assert np.sqrt(np.mean(speed_errors)) < 0.15


def test_one_wild_point_hardly_bends_the_path() -> None:
    track, _ = stepping_walk(3, 1.8)
    xy = track.xy_m.copy()
    xy[100] += (0.9, -0.7)
    bent = smooth(Track(1, track.t_ns, xy, track.covariance_m2, True))
    assert np.abs(bent.xy_m - smooth(track).xy_m).max() < 0.15


def test_a_single_point_has_no_path() -> None:
    track = Track(1, np.array([5], dtype=np.int64), np.zeros((1, 2)), covariance(0.1), False)
    with pytest.raises(ValueError, match="fewer than two"):
        smooth(track)
