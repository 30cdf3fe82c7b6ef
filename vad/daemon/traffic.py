"""Echo requests to the devices that are to be measured, where their addresses are known."""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from vad.csi.traffic import EchoTraffic
from vad.health import Health


@dataclass(frozen=True, slots=True)
class _Flow:
    address: str
    packets_per_s: float
    traffic: EchoTraffic
    task: asyncio.Task[None]


class Traffic:
    """Makes devices send, all of them together at no more than the given rate.

    Args:
        packets_per_s: echo requests, of all devices together; 0 = none.
        address_of: the IPv4 address of a device, None where it is not known.

    Attributes:
        health: of the part; its detail tells the devices and their rates, its counters are of all of them.
    """

    def __init__(self, packets_per_s: float, address_of: Callable[[str], str | None]) -> None:
        self.health = Health("csi.traffic")
        self._packets_per_s = packets_per_s
        self._address_of = address_of
        self._flows: dict[str, _Flow] = {}
        self._ended: Counter[str] = Counter()
        self._told_sent = 0
        self.health.ok("nobody is measured")

    def reaches(self, mac: str) -> bool:
        """Whether this device can be made to send."""
        return self._packets_per_s > 0 and self._address_of(mac) is not None

    async def towards(self, macs: Sequence[str]) -> None:
        """Make these devices send and no others; those whose address is not known are left out."""
        wanted = {mac: address for mac in macs if (address := self._address_of(mac)) is not None}
        rate = self._packets_per_s / max(1, len(wanted))
        for mac, flow in list(self._flows.items()):
            if wanted.get(mac) != flow.address or flow.packets_per_s != rate:
                await self._end(mac)
        for mac, address in wanted.items():
            if mac not in self._flows and rate > 0:
                traffic = EchoTraffic(address, rate, Health("csi.traffic"))
                task = asyncio.create_task(traffic.run(), name=f"echo traffic to {mac}")
                self._flows[mac] = _Flow(address, rate, traffic, task)
        self._tell()

    async def stop(self) -> None:
        """Send no more."""
        await self.towards(())

    def sent(self) -> int:
        """Echo requests sent since the last call."""
        self._tell()
        new = self.health.counters["sent"] - self._told_sent
        self._told_sent += new
        return new

    async def _end(self, mac: str) -> None:
        flow = self._flows.pop(mac)
        flow.task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await flow.task
        self._ended.update(flow.traffic.health.counters)

    def _tell(self) -> None:
        """Add up what the flows say of themselves."""
        total = Counter(self._ended)
        for flow in self._flows.values():
            total.update(flow.traffic.health.counters)
        self.health.counters.clear()
        self.health.counters.update(total)
        healths = [flow.traffic.health for flow in self._flows.values()]
        troubled = [health for health in healths if health.state in ("degraded", "failed")]
        if troubled:
            self.health.trouble(troubled[0].detail, failed=troubled[0].state == "failed")
        else:
            self.health.ok("; ".join(h.detail for h in healths if h.detail) or "nobody is measured")
