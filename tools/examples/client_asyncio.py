#!/usr/bin/env python3
"""Every change of a device as it happens, and its history: the asyncio client.

python tools/examples/client_asyncio.py [ENDPOINT]
"""

import asyncio
import sys

from vad.client import AsyncVadClient, UnreachableError

ENDPOINT = sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:7447"


async def follow(client: AsyncVadClient) -> None:
    """Print changes until the daemon goes away."""
    async for change in client.changes():
        if change.device is None:
            print(f"{change.mac} was forgotten")
        else:
            print(f"{change.mac} {change.device.state} {change.device.reason}", flush=True)


async def main() -> None:
    """Follow; come back when the daemon does."""
    async with AsyncVadClient(ENDPOINT) as client:
        known = await client.devices()
        histories = await asyncio.gather(*(client.history(device.mac, limit=3) for device in known))
        for device, history in zip(known, histories, strict=True):
            states = [entry.state for entry in history.entries] if history else []
            print(f"{device.mac} {' <- '.join(states)}", flush=True)
        while True:
            try:
                await follow(client)
            except UnreachableError:
                print("the daemon is gone; waiting", flush=True)
                await asyncio.sleep(2)


asyncio.run(main())
