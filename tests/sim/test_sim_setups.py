"""The paper's set-ups as scenarios, the array at either end, the camera's errors: what they claim holds."""

from __future__ import annotations

import numpy as np
import pytest

from vad.mac import mac_from_text
from vad.mapping.bound import TrackNoise
from vad.sim.paper_setups import DURATION_S, SETUPS, SHAPES, WALKERS, Setup, paper_setup
from vad.sim.radio import HUB_MAC, OTHER_MAC, Radio
from vad.sim.radio_channel import FURNISHED, WAVELENGTH_M, Channel, Surroundings
from vad.sim.scenario import make_home
from vad.sim.track_error import seen_walk, track_error_m, true_places_m


@pytest.mark.parametrize("setup", SETUPS)
@pytest.mark.parametrize("seed", range(5))
def test_set_ups_are_the_papers(setup: Setup, seed: int) -> None:
    scenario, kinds = paper_setup(setup, seed)
    across_m = {"office": 3.0, "open": 2.4}[setup]
    assert scenario.anchor_m[:2] == (across_m, 0.0)
    assert scenario.device_m[:2] == (across_m, 2.4)
    assert [(k.shape, k.walker) for k in kinds] == [(s, w) for w in range(len(WALKERS)) for s in SHAPES]
    x0, y0, x1, y1 = scenario.room_m
    for kind, walk in zip(kinds, scenario.walks, strict=True):
        assert DURATION_S[0] - 0.2 <= walk.end_s - walk.start_s <= DURATION_S[1]
        assert walk.height_m == WALKERS[kind.walker].height_m
        assert (walk.xy_m > [x0 + 0.3, y0 + 0.3]).all()
        assert (walk.xy_m < [x1 - 0.3, y1 - 0.3]).all()
        velocity = np.diff(walk.xy_m, axis=0) / 0.05
        assert np.linalg.norm(velocity, axis=1).max() < 1.2 * WALKERS[kind.walker].pace_mps
        assert np.linalg.norm(np.diff(velocity, axis=0) / 0.05, axis=1).max() < 5.0
        for end in (scenario.anchor_m, scenario.device_m):
            assert np.linalg.norm(walk.xy_m - end[:2], axis=1).min() > 0.3
    again, _ = paper_setup(setup, seed)
    assert all((a.xy_m == b.xy_m).all() for a, b in zip(scenario.walks, again.walks, strict=True))


def test_surroundings_that_say_nothing_leave_the_line_of_sight() -> None:
    home = make_home(0, walks=1)
    hub, device = np.array(home.anchor_m), np.array([home.room_m[2] - 0.3, home.room_m[1] + 1.0, 1.0])
    free_space = 1 / np.linalg.norm(hub - device) ** 2
    off = {}
    for name, surroundings in (("none", Surroundings((0.0, 0.0), (0, 1))), ("furnished", FURNISHED)):
        channel = Channel(home, device, hub[None], np.random.default_rng(0), surroundings)
        off[name] = abs(channel.still_power / free_space - 1)
    assert off["none"] < 1e-4
    assert off["furnished"] > 0.02


def test_the_array_is_where_it_is_said_to_be() -> None:
    home = make_home(3, walks=1)
    for end, middle, sender in (
        ("hub", home.anchor_m, mac_from_text(home.device_mac)),
        ("device", home.device_m, HUB_MAC),
    ):
        radio = Radio(home, seed=3, array_end=end)  # type: ignore[arg-type]
        assert radio.antennas_m.mean(axis=0) == pytest.approx(np.array(middle))
        spacing = np.linalg.norm(np.diff(radio.antennas_m, axis=0), axis=1)
        assert spacing == pytest.approx([WAVELENGTH_M / 2] * 2)
        batch = radio.generate(home.join_s, home.join_s + 1.0)
        assert set(batch.mac.tolist()) == {sender, OTHER_MAC}


@pytest.mark.parametrize("seed", range(6))
def test_the_channel_is_reciprocal(seed: int) -> None:
    home = make_home(seed, walks=1)
    device, hub = np.array(home.device_m), np.array(home.anchor_m)
    t_s = home.walks[0].start_s + np.linspace(2.0, 4.0, 20)
    there = Channel(home, device, hub[None], np.random.default_rng(7)).response(t_s)
    back = Channel(home, hub, device[None], np.random.default_rng(7)).response(t_s)
    assert np.abs(there - back).max() < 1e-3 * np.abs(there).max()


def test_track_errors_have_their_sizes_and_their_memory() -> None:
    noise = TrackNoise(0.03, 0.06, 1.0)
    t_s = np.arange(0, 4000, 0.1)
    error = track_error_m(noise, t_s, np.random.default_rng(1))
    assert error.std(axis=0) == pytest.approx([noise.sigma_m] * 2, rel=0.05)
    for lag, want in ((1, 0.06**2 * np.exp(-0.1)), (10, 0.06**2 * np.exp(-1.0)), (50, 0.0)):
        assert (error[lag:] * error[:-lag]).mean(axis=0) == pytest.approx([want] * 2, abs=3e-4)
    assert np.corrcoef(error.T)[0, 1] == pytest.approx(0.0, abs=0.05)


def test_a_seen_walk_is_the_walk_with_these_errors() -> None:
    scenario, _ = paper_setup("open", 1)
    walk, noise = scenario.walks[2], TrackNoise(0.03, 0.02)
    seen = seen_walk(walk, noise, np.random.default_rng(0))
    off = seen.xy_m - true_places_m(walk, seen.t_ns / 1e9)
    assert off.std() == pytest.approx(noise.sigma_m, rel=0.2)
    assert np.median(np.diff(seen.t_ns)) == 100_000_000
    assert seen.sigma_m == pytest.approx(noise.sigma_m)
    exact = seen_walk(walk, TrackNoise(0.0, 0.0), np.random.default_rng(0))
    states = [walk.state(t) for t in exact.t_ns[:-1] / 1e9]
    assert exact.xy_m[:-1] == pytest.approx(
        np.array([(s.x_m, s.y_m) for s in states if s is not None]), abs=1e-6
    )
