"""What arrives by itself: events and changes, read from samples. No I/O."""

from __future__ import annotations

from dataclasses import dataclass

from vad.bus import messages as m
from vad.client.questions import decoded


@dataclass(frozen=True, slots=True)
class Arrived:
    """A sample taken out of zenoh's hands. payload: None for a delete; gone: the daemon went away."""

    key: str = ""
    payload: bytes | None = None
    gone: bool = False


@dataclass(frozen=True, slots=True)
class Change:
    """A device changed. device: what it is now; None where it was forgotten."""

    mac: str
    device: m.DeviceMessage | None


def event_of(arrived: Arrived) -> m.EventMessage | None:
    """An event; None for what is none (a delete)."""
    return None if arrived.payload is None else decoded(arrived.payload, m.EventMessage, arrived.key)


def change_of(arrived: Arrived) -> Change | None:
    """What became of a device."""
    mac = arrived.key.rpartition("/")[2]
    if arrived.payload is None:
        return Change(mac, None)
    return Change(mac, decoded(arrived.payload, m.DeviceMessage, arrived.key))
