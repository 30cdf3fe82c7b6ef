"""The agent's program: the card's packets go to the hub, whatever becomes of the network meanwhile."""

from __future__ import annotations

import asyncio
import logging
import secrets
import time

from vad.agent.collector import Collector
from vad.agent.info import AgentInfo
from vad.agent.link import HubLink
from vad.bus.session import BusSettings
from vad.csi.packets import CsiBatch, CsiSource
from vad.streams import DropOldestQueue

log = logging.getLogger(__name__)

TICK_S = 0.1
SAY_EVERY_S = 60.0
QUEUED_BATCHES = 1024


class Node:
    """One agent. `run` until cancelled.

    Args:
        bus: a client of the hub.
        info: who this is.
        source: the CSI card.
        batch_s: packets are collected for this long into one message.
        buffer_bytes: how much may wait for the hub; beyond, the oldest is dropped and counted.
        transmitter: packets known to be of somebody else are left out.

    Attributes:
        batches: what the card has sent and is not collected yet.
    """

    def __init__(
        self,
        bus: BusSettings,
        info: AgentInfo,
        source: CsiSource,
        *,
        batch_s: float,
        buffer_bytes: int,
        transmitter: int | None = None,
    ) -> None:
        stream = secrets.randbits(62)
        self.collector = Collector(
            info, source.health, stream=stream, limit_bytes=buffer_bytes, transmitter=transmitter
        )
        self.link = HubLink(bus, info, self.collector)
        self.batches: DropOldestQueue[CsiBatch] = DropOldestQueue(QUEUED_BATCHES)
        self._source = source
        self._batch_s = batch_s

    async def run(self) -> None:
        """Collect and send until cancelled."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._source.run(self.batches), name="csi")
            group.create_task(self._collect(), name="collect")
            group.create_task(self._tick(), name="tick")
            group.create_task(self.link.run(), name="link")
            group.create_task(self._say(), name="say")

    async def _collect(self) -> None:
        while True:
            first = await self.batches.get()
            await asyncio.sleep(self._batch_s)
            self.collector.take([first, *self.batches.drain()], time.monotonic_ns())
            self.link.wake()

    async def _tick(self) -> None:
        while True:
            await asyncio.sleep(TICK_S)
            waiting = len(self.collector.outbox)
            self.collector.tick(time.monotonic_ns())
            if len(self.collector.outbox) > waiting:
                self.link.wake()

    async def _say(self) -> None:
        """A line in the log now and then."""
        before = 0
        while True:
            await asyncio.sleep(SAY_EVERY_S)
            outbox, clock = self.collector.outbox, self.collector.clock
            rate = (outbox.packets - before) / SAY_EVERY_S
            before = outbox.packets
            doubt = f"±{clock.error_ns(time.monotonic_ns()) / 1e6:.2f} ms" if clock.known else "unknown"
            log.info(
                "%.0f packets/s, %d frames wait, %d packets dropped, hub's clock %s",
                rate,
                len(outbox),
                outbox.dropped_packets,
                doubt,
            )
