"""What the tests of the live sources share."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator

import numpy as np
from waiting import until

from vad.csi.bfee import encode_bodies
from vad.csi.packets import CsiBatch, CsiSource
from vad.streams import DropOldestQueue


def bodies(n: int, first: int = 0) -> list[bytes]:
    """0xBB bodies of a 3x1 link at 1000 packets/s, counted from `first`."""
    count = np.arange(first, first + n)
    csi = np.ones((n, 30, 3, 1, 2), np.int8)
    return encode_bodies(csi, nic_us=1000 * count, bfee_count=count, rssi=(30, 31, 32))


@contextlib.asynccontextmanager
async def running(source: CsiSource) -> AsyncIterator[DropOldestQueue[CsiBatch]]:
    """The queue of a source that runs meanwhile."""
    out: DropOldestQueue[CsiBatch] = DropOldestQueue(1000)
    task = asyncio.create_task(source.run(out))
    try:
        await until(lambda: source.health.state != "starting")
        yield out
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
