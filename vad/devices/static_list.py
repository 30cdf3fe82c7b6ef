"""Devices named in the settings, for networks whose access point tells nothing."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence

from vad.devices.station import StationEvent
from vad.health import Health
from vad.mac import normal_mac
from vad.streams import DropOldestQueue


class StaticList:
    """A JoinSource that lists every MAC once, at its start; VadError for text that is no MAC."""

    def __init__(self, macs: Sequence[str]) -> None:
        self.health = Health("static devices")
        self._macs = tuple(dict.fromkeys(normal_mac(mac) for mac in macs))

    async def run(self, out: DropOldestQueue[StationEvent]) -> None:
        """Emit all devices, then wait until cancelled."""
        for mac in self._macs:
            out.put(StationEvent(time.monotonic_ns(), "listed", mac, "settings"))
            self.health.counters["listed"] += 1
        self.health.ok(f"{len(self._macs)} devices")
        await asyncio.get_running_loop().create_future()
