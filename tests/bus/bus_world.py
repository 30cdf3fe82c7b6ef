"""What the tests of the bus share: devices to publish, questions without our client, waiting."""

from __future__ import annotations

from pathlib import Path

import zenoh

from vad.bus import messages as m
from vad.bus.session import BusSettings, open_session

ROOT = Path(__file__).parents[2]
PATIENCE_S = 40
"""What is answered at all is answered in this time."""
STARTED_S = 120
"""A busy machine takes its time to load a program, and a gate is one."""


def mac(i: int) -> str:
    return f"aa:bb:cc:dd:{i >> 8:02x}:{i & 255:02x}"


def device(i: int = 0, **changes: object) -> m.DeviceMessage:
    fields: dict[str, object] = {
        "source": "simulated",
        "mac": mac(i),
        "state": "mapped",
        "x_m": float(i),
        "y_m": 1.0,
        "covariance_m2": ((0.01, 0.0), (0.0, 0.01 * (i + 1))),
        "radius90_m": 0.3,
        "room": "Kitchen" if i % 2 else "Living room",
    }
    return m.DeviceMessage(**(fields | changes))  # type: ignore[arg-type]


BROKEN_HEATMAP = m.HeatmapMessage(
    source="live",
    mac=mac(0),
    epoch=1,
    bounds_m=(0, 0, 3, 2),
    step_m=1,
    width=3,
    height=2,
    probability=b"no zlib",
)
"""What only a fault of ours could publish."""


def settings(endpoint: str, hub: str = "home") -> BusSettings:
    return BusSettings(hub=hub, listen=(endpoint,))


def ask_raw(endpoint: str, selector: str) -> list[zenoh.Reply]:
    with open_session(BusSettings(mode="client", connect=(endpoint,))) as session:
        return list(session.get(selector, target=zenoh.QueryTarget.ALL, timeout=PATIENCE_S))
