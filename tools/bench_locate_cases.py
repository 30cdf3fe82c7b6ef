"""The walks that the benchmark solves: recorded ones, the paper's set-ups and homes simulated."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from bench_locate_score import Case
from numpy.typing import NDArray

from vad.capture.session import load_session
from vad.mapping.bound import DopplerBound, TrackNoise, doppler_bound
from vad.mapping.device_stage import Recording
from vad.sim.home import floor_plan
from vad.sim.paper_setups import WALKERS, Setup, paper_radio, paper_setup
from vad.sim.radio import OTHER_MAC, Radio
from vad.sim.radio_body import TORSO_HEIGHT
from vad.sim.scenario import CARRIER_HZ, Scenario, Walk, make_home
from vad.sim.track_error import TRACK_HZ, seen_walk, true_places_m
from vad.solve import bounds_of, walk_of

RECORDINGS = Path(__file__).resolve().parents[2] / "shared" / "data" / "csi" / "witraj"
WHITE_M = 0.03
SLOW_M = (0.0, 0.02, 0.06)
HOME_SLOW_M = 0.03
WIDER_M = 2.0
LATE_S = 0.3
HOME_WALKS = 3


def recorded_groups() -> list[tuple[str, str]]:
    """(room, receiver) of the recordings that are there."""
    names = sorted(p.name for p in RECORDINGS.glob("*_rx*")) if RECORDINGS.is_dir() else []
    return sorted({(_room(name), name.rsplit("_", 1)[1]) for name in names}, reverse=True)


def _room(name: str) -> str:
    return "corridor" if "corridor" in name else "plain"


def recorded(group: tuple[str, str], limit: int | None = None) -> Iterator[list[Case]]:
    """Each recording of a receiver in a room: as it is, with wider bounds, with its track early and late."""
    room, receiver = group
    folders = sorted(p for p in RECORDINGS.glob(f"*_{receiver}") if _room(p.name) == room)
    for folder in folders[:limit]:
        session = load_session(folder)
        header = session.header
        anchor_m = np.array([header.anchor.x_m, header.anchor.y_m])
        recording = Recording(
            session.t_ns,
            session.csi,
            walk_of(session),
            anchor_m,
            header.anchor.z_m,
            header.radio.carrier_hz,
            header.radio.bandwidth_mhz,
            header.radio.array_end,
        )
        if session.truth_m is None:
            continue
        name = f"{room} {receiver}"
        x0, y0, x1, y1 = bounds_of(session)
        case = Case(
            folder.name, name, ("as recorded", room, receiver), recording, session.truth_m, (x0, y0, x1, y1)
        )
        wide = (x0 - WIDER_M, y0 - WIDER_M, x1 + WIDER_M, y1 + WIDER_M)
        cases = [case, replace(case, bounds_m=wide, group=f"{name} wide", tags=("bounds 2 m wider",))]
        for late_s in (LATE_S, -LATE_S):
            shifted = replace(recording, walk=recording.walk.later(late_s))
            tag = f"track {late_s:+.1f} s"
            cases.append(replace(case, recording=shifted, group=f"{name} {tag}", tags=(tag,)))
        yield cases


def paper_cases(
    setup: Setup, seed: int, limit: int | None = None, slow_errors_m: tuple[float, ...] = SLOW_M
) -> Iterator[list[Case]]:
    """Each walk of a set-up, seen by a camera for each of the slow errors."""
    scenario, walks = paper_setup(setup, seed)
    radio = paper_radio(setup, scenario)
    for kind in walks[:limit]:
        walk = scenario.walks[kind.number]
        t_ns, csi = heard(radio, walk)
        who = f"{WALKERS[kind.walker].height_m:.2f} m tall"
        cases = []
        for slow_m in slow_errors_m:
            noise = TrackNoise(WHITE_M, slow_m)
            seen = seen_walk(walk, noise, np.random.default_rng([seed, kind.number, round(slow_m * 100)]))
            tags = (f"slow {slow_m * 100:.0f} cm", f"slow {slow_m * 100:.0f} cm, {kind.shape}")
            recording = Recording(
                t_ns,
                csi,
                seen,
                np.array(scenario.anchor_m[:2]),
                scenario.anchor_m[2],
                CARRIER_HZ,
            )
            cases.append(
                Case(
                    f"{setup} {seed} {kind.shape}, {who}",
                    f"{setup} {seed} {slow_m} {kind.number // 3}",
                    (*tags, f"slow {slow_m * 100:.0f} cm, {who}"),
                    recording,
                    np.array(scenario.device_m[:2]),
                    scenario.room_m,
                    bound_of(scenario, walk, noise),
                    height_m=scenario.device_m[2],
                )
            )
        yield cases


def home_cases(seed: int) -> Iterator[list[Case]]:
    """The first walks of a home; the array is the hub's."""
    scenario = make_home(seed, walks=HOME_WALKS)
    radio = Radio(scenario, seed=seed)
    noise = TrackNoise(WHITE_M, HOME_SLOW_M)
    plan = floor_plan(scenario)
    where = "next room" if scenario.device_m[0] > scenario.room_m[2] else "same room"
    for number, walk in enumerate(scenario.walks):
        t_ns, csi = heard(radio, walk)
        seen = seen_walk(walk, noise, np.random.default_rng([seed, number]))
        recording = Recording(
            t_ns,
            csi,
            seen,
            np.array(scenario.anchor_m[:2]),
            scenario.anchor_m[2],
            CARRIER_HZ,
            array_end="anchor",
        )
        yield [
            Case(
                f"home {seed} walk {number}",
                f"home {seed}",
                ("all", where),
                recording,
                np.array(scenario.device_m[:2]),
                scenario.plan_m,
                bound_of(scenario, walk, noise),
                scenario.room_m[2],
                plan,
                scenario.device_m[2],
            )
        ]


def heard(radio: Radio, walk: Walk) -> tuple[NDArray[np.int64], NDArray[np.complex64]]:
    """The link's packets during a walk: t_ns (N,), csi (N, 30, R, 1) in the card's integers."""
    batch = radio.generate(walk.start_s, walk.end_s)
    mine = batch.mac != OTHER_MAC
    parts = batch.csi[mine].astype(np.float32)
    return np.rint(batch.t_s[mine] * 1e9).astype(np.int64), parts[..., 0] + 1j * parts[..., 1]


def bound_of(scenario: Scenario, walk: Walk, noise: TrackNoise) -> DopplerBound:
    """The least error that this walk and this camera allow, the path length change being perfect."""
    t_s = np.arange(walk.start_s, walk.end_s, 1 / TRACK_HZ)
    places = true_places_m(walk, t_s)
    body = np.column_stack([places, np.full(len(t_s), TORSO_HEIGHT * walk.height_m)])
    return doppler_bound(t_s, body, np.array(scenario.anchor_m), np.array(scenario.device_m), noise)
