"""Session folders out of the simulator: one walk of a scenario as the daemon would have recorded it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from vad.capture.session import (
    SCHEMA,
    SessionAnchor,
    SessionDevice,
    SessionHeader,
    SessionMap,
    SessionRadio,
)
from vad.capture.session_writer import SessionWriter
from vad.csi.logfile import LogReader
from vad.sim.radio import Radio
from vad.sim.scenario import CARRIER_HZ, Scenario

TRACK_SIGMA_M = 0.03
TRACK_HZ = 10.0


def record_walk(
    folder: Path, scenario: Scenario, number: int = 0, *, packets_per_s: float = 400.0, n_rx: int = 3
) -> Path:
    """Write walk `number` of the scenario into `folder`, the truth beside it; returns the folder."""
    walk = scenario.walks[number]
    radio = Radio(scenario, packets_per_s=packets_per_s, n_rx=n_rx, seed=scenario.seed)
    heard = radio.generate(walk.start_s, walk.end_s)
    raw = b"".join(data for _, data in radio.log_bytes(heard))
    batch = LogReader().feed(raw)
    arrival_ns = np.rint(heard.t_s * 1e9).astype(np.int64)
    writer = SessionWriter(folder, _header(folder.name, scenario))
    writer.append(replace(batch, packets=replace(batch.packets, arrival_ns=arrival_ns)))

    t_s = np.arange(walk.start_s, walk.end_s, 1 / TRACK_HZ)
    states = [state for t in t_s if (state := walk.state(t)) is not None]
    noise = np.random.default_rng([scenario.seed, number]).normal(0.0, TRACK_SIGMA_M, (len(states), 2))
    xy_m = np.array([[s.x_m, s.y_m] for s in states]) + noise
    t_ns = np.rint(t_s[: len(states)] * 1e9).astype(np.int64)
    writer.close(t_ns, xy_m, np.full(len(states), TRACK_SIGMA_M), 1)
    x_m, y_m, z_m = scenario.device_m
    (folder / "truth.json").write_text(json.dumps({"device": {"x_m": x_m, "y_m": y_m, "z_m": z_m}}))
    return folder


def _header(name: str, scenario: Scenario) -> SessionHeader:
    return SessionHeader(
        schema=SCHEMA,
        id=name,
        source="simulated",
        device=SessionDevice(scenario.device_mac, "lamp"),
        anchor=SessionAnchor(*scenario.anchor_m),
        radio=SessionRadio(carrier_hz=CARRIER_HZ),
        map=SessionMap(1, scenario.plan_m),
    )
