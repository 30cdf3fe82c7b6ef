"""Asking a vad daemon: typed, plain (VadClient) and for asyncio (AsyncVadClient).

with VadClient() as client:
    for device in client.devices(state="mapped"):
        print(device.mac, device.x_m, device.y_m, device.radius90_m)

async with AsyncVadClient() as client:
    async for event in client.events():
        print(event.text)
"""

from vad.client.aio import AsyncVadClient
from vad.client.plain import VadClient
from vad.client.questions import QUERY_TIMEOUT_S, QueryError, UnreachableError
from vad.client.subscriptions import Change

__all__ = [
    "QUERY_TIMEOUT_S",
    "AsyncVadClient",
    "Change",
    "QueryError",
    "UnreachableError",
    "VadClient",
]
