"""Echo requests to whichever device is to be measured, where its address is known."""

from __future__ import annotations

import asyncio
import contextlib

from vad.config import Settings
from vad.csi.traffic import EchoTraffic
from vad.health import Health
from vad.mac import normal_mac


class Traffic:
    """At most one device gets echo requests at a time.

    Attributes:
        health: of the part; its detail tells the device, the rate and the share of replies.
    """

    def __init__(self, settings: Settings) -> None:
        self.health = Health("csi.traffic")
        self._packets_per_s = settings.radio.traffic_packets_per_s
        self._addresses = {normal_mac(d.mac): d.ip for d in settings.devices.static if d.ip is not None}
        self._mac: str | None = None
        self._task: asyncio.Task[None] | None = None
        self.health.ok("nobody is measured")

    def reaches(self, mac: str) -> bool:
        """Whether this device can be made to send."""
        return self._packets_per_s > 0 and mac in self._addresses

    async def towards(self, mac: str) -> None:
        """Make this device send and no other; nothing happens where its address is not known."""
        if mac == self._mac:
            return
        await self.stop()
        if self.reaches(mac):
            traffic = EchoTraffic(self._addresses[mac], self._packets_per_s, self.health)
            self._mac = mac
            self._task = asyncio.create_task(traffic.run(), name="echo traffic")

    async def stop(self) -> None:
        """Send no more."""
        task, self._task, self._mac = self._task, None, None
        if task is not None:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
            self.health.ok("nobody is measured")
