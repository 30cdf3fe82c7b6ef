"""What is said in the daemon's own topics: JSON whose members become states and attributes.

Home Assistant drops attributes called `state`, `name`, `icon`, `available` and some more; none is called so.
"""

from __future__ import annotations

from collections.abc import Iterable

import msgspec

from vad.bus import messages as m
from vad.report.words import printable

MAX_TEXT = 255
"""Home Assistant takes no longer state."""
MAX_PROBLEMS = 20


def plain(text: str | None) -> str | None:
    """A text that may come off the air: printable, not too long; None where there is none."""
    if not text:
        return None
    shown = printable(text).strip()
    return (shown if len(shown) <= MAX_TEXT else shown[: MAX_TEXT - 1] + "…") or None


def device_state(device: m.DeviceMessage) -> bytes:
    """JSON of a device, lengths in metres of the map. What is not known is null, which is `unknown` there."""
    return msgspec.json.encode(
        {
            "in_zones": ["zone.home"] if device.in_network else [],
            "room": plain(device.room),
            "mapping": device.state,
            "reason": plain(device.reason),
            "x_m": _centimetre(device.x_m),
            "y_m": _centimetre(device.y_m),
            "sigma_m": _centimetre(device.sigma_m),
            "radius_90_m": _centimetre(device.radius90_m),
            "moved": device.moved,
            "walks": device.walks,
            "method": device.method,
            "source": device.source,
            "mac": device.macs[-1] if device.macs else device.mac,
            "ip": device.ip,
            "host_name": plain(device.host_name),
            "last_seen": device.last_seen,
        }
    )


def camera_state(camera: m.CameraMessage) -> bytes:
    """JSON of a camera: how far its calibration is."""
    return msgspec.json.encode(
        {
            "calibration": camera.state,
            "percent": round(camera.percent),
            "reason": plain(camera.reason),
            "deviation_m": _centimetre(camera.deviation_m),
        }
    )


def status_state(status: m.StatusMessage | None, devices: Iterable[m.DeviceMessage]) -> bytes:
    """JSON of the hub: what it does, what is wrong by part, how many devices have a place."""
    parts = () if status is None else status.parts
    wrong = [part for part in parts if part.state in ("degraded", "failed")][:MAX_PROBLEMS]
    known = list(devices)
    return msgspec.json.encode(
        {
            "step": None if status is None else plain(status.step),
            "problem": "ON" if wrong else "OFF",
            "problems": {part.part: plain(part.detail) for part in wrong},
            "devices": len(known),
            "mapped": sum(device.state == "mapped" for device in known),
        }
    )


def _centimetre(value_m: float | None) -> float | None:
    return None if value_m is None else round(value_m, 2)
