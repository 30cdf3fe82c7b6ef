"""The one contract of every join source."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

from vad.health import Health
from vad.streams import DropOldestQueue

Kind = Literal["joined", "left", "told", "listed"]


@dataclass(frozen=True, slots=True)
class StationEvent:
    """Something is known of a station.

    Attributes:
        t_ns: when, on the one timeline.
        kind: `joined` and `left` the network; `told`: more is known of a station that may or may not be in;
            `listed`: a person named it, whether it is in or not.
        mac: lower-case text.
        interface: where it was seen; one station may be in on several at once.
        host_name: what the station calls itself when it asks for an address.
        client_id: its DHCP client identifier, hexadecimal bytes with colons.
        ip: its IPv4 address.
        agent: the id of a remote CSI node; None for every other station.
    """

    t_ns: int
    kind: Kind
    mac: str
    interface: str
    host_name: str | None = None
    client_id: str | None = None
    ip: str | None = None
    agent: str | None = None


class JoinSource(Protocol):
    """A source of station events: `run` emits until it is cancelled and reconnects by itself."""

    health: Health

    async def run(self, out: DropOldestQueue[StationEvent]) -> None:
        """Emit events into `out` until cancelled; trouble goes into `health`, never out of here."""
        ...
