"""Recordings of a simulated home's walks, with an exact track, for tests of the mapping."""

from __future__ import annotations

import numpy as np

from vad.mapping.device_stage import Recording
from vad.mapping.walk import WalkTrack
from vad.sim.radio import OTHER_MAC, Radio
from vad.sim.scenario import CARRIER_HZ, Scenario
from vad.sim.track_error import true_places_m

SIGMA_M = 0.02


def recordings(home: Scenario, seed: int) -> list[Recording]:
    """One for each walk; the antennas are the hub's."""
    radio = Radio(home, seed=seed)
    found = []
    for walk in home.walks:
        batch = radio.generate(walk.start_s, walk.end_s)
        mine = batch.mac != OTHER_MAC
        parts = batch.csi[mine].astype(np.float32)
        t_s = np.arange(walk.start_s, walk.end_s, 0.05)
        found.append(
            Recording(
                np.rint(batch.t_s[mine] * 1e9).astype(np.int64),
                parts[..., 0] + 1j * parts[..., 1],
                WalkTrack(
                    np.rint(t_s * 1e9).astype(np.int64),
                    true_places_m(walk, t_s),
                    np.full(len(t_s), SIGMA_M),
                ),
                np.array(home.anchor_m[:2]),
                home.anchor_m[2],
                CARRIER_HZ,
                array_end="anchor",
            )
        )
    return found
