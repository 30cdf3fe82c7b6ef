"""The one contract of every join source."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

from vad.health import Health
from vad.streams import DropOldestQueue


@dataclass(frozen=True, slots=True)
class StationEvent:
    """A station came or went. mac: lower-case text; interface: where it was seen; name: if known."""

    t_ns: int
    kind: Literal["joined", "left"]
    mac: str
    interface: str
    name: str | None = None


class JoinSource(Protocol):
    """A source of station events: `run` emits until it is cancelled and reconnects by itself."""

    health: Health

    async def run(self, out: DropOldestQueue[StationEvent]) -> None:
        """Emit events into `out` until cancelled; trouble goes into `health`, never out of here."""
        ...
