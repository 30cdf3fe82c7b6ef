"""Identities of people on the floor, and who of them moves alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vad.vision.movers import lone_mover, moving
from vad.vision.standing import Standing
from vad.vision.tracks import FloatArray, Track, Tracker

RATE_HZ = 15.0


def standing_at(points: FloatArray, sigma_m: float = 0.08) -> list[Standing]:
    return [Standing(point, np.eye(2) * sigma_m**2, None, True) for point in points]


def run(tracker: Tracker, places: list[FloatArray], sigma_m: float = 0.08, start_s: float = 1.0) -> int:
    """Feed frames of (N, 2) places; the time of the last in ns."""
    t_ns = 0
    for k, points in enumerate(places):
        t_ns = int((start_s + k / RATE_HZ) * 1e9)
        tracker.update(t_ns, standing_at(points, sigma_m))
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
    alone = lone_mover(tracker.tracks(), end_ns)
    assert alone is not None
    assert alone.probability < 0.01


@pytest.mark.parametrize("turns", [False, True])
def test_two_who_meet_and_turn_back_are_told_apart_by_their_clothes(turns: bool) -> None:
    """They stand together for 2 s as one blob of places; only the colours tell who leaves to which side."""
    rng = np.random.default_rng(4)
    dark, jeans = np.array([20.0, 130, 128, 5, 128, 128]), np.array([25.0, 130, 128, 95, 128, 115])
    tracker = Tracker()
    t = np.arange(0, 8, 1 / RATE_HZ)
    come, go = np.clip(3.0 - t, 0.0, 3.0), np.clip(t - 5.0, 0.0, 3.0)
    left = -(come + go) if turns else -come + go
    for k, s in enumerate(t):
        places = np.array([[left[k], 0.0], [-left[k], 0.02]]) + rng.normal(0, 0.08, (2, 2))
        people = [
            Standing(place, np.eye(2) * 0.08**2, None, True, colour + rng.normal(0, 5, 6))
            for place, colour in zip(places, (dark, jeans), strict=True)
        ]
        tracker.update(int((1 + s) * 1e9), people[:: rng.choice([-1, 1])])
    first, second = tracker.tracks()
    for track in (first, second):
        stays = np.sign(track.xy_m[0, 0]) == np.sign(track.xy_m[-1, 0])
        assert stays == turns


def test_six_people_at_once_keep_their_identities() -> None:
    rng = np.random.default_rng(3)
    lanes = np.arange(6) * 0.7
    tracker = Tracker()
    frames = []
    for t in np.arange(0, 5, 1 / RATE_HZ):
        along = np.where(np.arange(6) % 2, 0.9 * t, 4.5 - 0.9 * t)
        places = np.stack([along, lanes], axis=1) + rng.normal(0, 0.06, (6, 2))
        frames.append(places[rng.permutation(6)][rng.random(6) > 0.1])
    run(tracker, frames)
    tracks = tracker.tracks()
    assert len(tracks) == 6
    for track in tracks:
        assert np.ptp(track.xy_m[:, 1]) < 0.5


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
    tracker.update(end_ns + 1_600_000_000, [])
    (track,) = tracker.tracks()
    assert track.ended
    # After a pause of the frames themselves a newcomer is a new person, even at the old one's place.
    later_ns = end_ns + 9_000_000_000
    for k in range(4):
        tracker.update(later_ns + k * 66_000_000, standing_at(track.xy_m[-1:]))
    assert [x.id for x in tracker.tracks() if not x.ended] != [track.id]
    tracker.update(later_ns + 200_000_000_000, [])
    tracker.update(later_ns + 400_000_000_000, [])
    assert tracker.tracks() == []


def test_a_part_of_a_track_keeps_what_belongs_together() -> None:
    tracker = Tracker()
    run(tracker, [np.array([[0.1 * k, 1.0]]) for k in range(20)])
    (track,) = tracker.tracks()
    part = track.within(int(track.t_ns[5]), int(track.t_ns[9]))
    assert np.array_equal(part.t_ns, track.t_ns[5:10])
    assert np.array_equal(part.xy_m, track.xy_m[5:10])
    assert len(part.bodies) == 5


# -- who moves ---------------------------------------------------------------------------------------


def scene(seed: int, *speeds_mps: float, sigma_m: float = 0.05) -> tuple[list[Track], int]:
    """People at 2 m from one another who go at these speeds for 3 s; the tracks and the end."""
    rng = np.random.default_rng(seed)
    tracker = Tracker()
    frames = [
        np.array([[v * s, 2.0 * k] for k, v in enumerate(speeds_mps)])
        + rng.normal(0, sigma_m, (len(speeds_mps), 2))
        for s in np.arange(0, 3, 1 / RATE_HZ)
    ]
    end_ns = run(tracker, frames, sigma_m)
    return tracker.tracks(), end_ns


@pytest.mark.parametrize("seed", range(4))
def test_the_one_who_moves_is_named_among_those_who_sit(seed: int) -> None:
    tracks, end_ns = scene(seed, 0.0, 0.9, 0.0)
    found = lone_mover(tracks, end_ns)
    assert found is not None
    (named,) = [track for track in tracks if track.id == found.track]
    assert named.xy_m[-1, 1] == pytest.approx(2.0, abs=0.3)
    assert found.probability > 0.9
    assert lone_mover(tracks, end_ns + 2_000_000_000) is None


def test_two_who_move_are_no_lone_mover_and_nobody_who_sits_is_one() -> None:
    for speeds in ((0.9, 0.9), (0.0, 0.0)):
        found = lone_mover(*scene(1, *speeds))
        assert found is not None
        assert found.probability < 0.1


def test_the_probability_of_moving_rises_with_the_speed() -> None:
    seen = []
    for speed in (0.0, 0.15, 0.25, 0.4, 0.9):
        scenes = [scene(seed, speed, sigma_m=0.08) for seed in range(10)]
        seen.append(np.mean([moving(tracks, end_ns)[tracks[0].id] for tracks, end_ns in scenes]))
    assert seen == sorted(seen)
    assert seen[0] < 0.15
    assert 0.3 < seen[2] < 0.7
    assert seen[-1] > 0.95


def test_somebody_without_a_place_makes_it_less_likely_that_the_walker_is_alone() -> None:
    tracks, end_ns = scene(2, 0.9)
    sure, doubtful = lone_mover(tracks, end_ns), lone_mover(tracks, end_ns, unplaced=1)
    assert sure is not None
    assert doubtful is not None
    assert doubtful.probability == pytest.approx(0.5 * sure.probability)


def test_who_goes_behind_something_still_counts_until_the_track_ends() -> None:
    tracks, end_ns = scene(2, 0.9, 0.9)
    hidden = lone_mover(tracks, end_ns + 1_200_000_000)
    assert hidden is not None
    assert hidden.probability < 0.1


# -- robustness --------------------------------------------------------------------------------------


def test_points_at_infinity_are_left_out_and_time_goes_forwards() -> None:
    tracker = Tracker()
    run(tracker, [np.array([[np.nan, 1.0], [1.0, 1.0]])] * 4)
    assert len(tracker.tracks()) == 1
    with pytest.raises(ValueError, match="order of time"):
        tracker.update(0, [])


@settings(max_examples=40, deadline=None)
@given(st.lists(st.lists(st.tuples(st.floats(-9, 9), st.floats(-9, 9)), max_size=6), max_size=25))
def test_any_points_leave_tracks_in_order(frames: list[list[tuple[float, float]]]) -> None:
    tracker = Tracker()
    end_ns = run(tracker, [np.array(points, dtype=float).reshape(-1, 2) for points in frames])
    for track in tracker.tracks():
        assert np.all(np.diff(track.t_ns) > 0)
        assert track.xy_m.shape == (len(track.t_ns), 2)
        assert len(track.bodies) == len(track.t_ns)
    assert all(0.0 <= p <= 1.0 for p in moving(tracker.tracks(), end_ns).values())
