"""A zenoh session for a robot, and subscriptions whose samples come out on the event loop (formats.md, 7)."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Any, TypeVar

import zenoh
import zenoh.ext

from vad.handover import Handover, Intake
from vad.streams import DropOldestQueue

RETRY = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2}
"""When the session knocks again after the robot's router went away."""
OPEN_JOIN_S = 0.9
_HISTORY = 1

T = TypeVar("T")

Arrived = Callable[[bytes, int], None]


def client_config(endpoint: str) -> zenoh.Config:
    """A client of one router: finds nothing by itself, listens nowhere."""
    config = zenoh.Config()
    for key, value in {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/retry": RETRY,
        "listen/endpoints": [],
        "scouting/delay": 0,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return config


@contextlib.asynccontextmanager
async def opened(link: zenoh.Session | str) -> AsyncIterator[zenoh.Session]:
    """The session itself, which stays the caller's, or one of our own to an endpoint.

    Raises zenoh.ZError where nobody answers there.
    """
    if not isinstance(link, str):
        yield link
        return
    opening = asyncio.ensure_future(asyncio.to_thread(zenoh.open, client_config(link)))
    try:
        session = await asyncio.shield(opening)
    except asyncio.CancelledError:
        # A session that opens after all must not live on unseen.
        with contextlib.suppress(zenoh.ZError, TimeoutError):
            async with asyncio.timeout(OPEN_JOIN_S):
                await _close(await opening)
        raise
    try:
        yield session
    finally:
        await _close(session)


def put_counted(inbox: DropOldestQueue[T], counters: Counter[str], item: T) -> None:
    """Put, and count what had to go for it."""
    before = inbox.dropped
    inbox.put(item)
    counters["overrun"] += inbox.dropped - before


async def _close(session: zenoh.Session) -> None:
    with contextlib.suppress(zenoh.ZError):
        await asyncio.to_thread(session.close)


@contextlib.contextmanager
def subscribed(
    session: zenoh.Session,
    key_expr: str,
    arrived: Arrived,
    *,
    intake: Intake,
    counters: Counter[str],
    latched: bool = False,
) -> Iterator[None]:
    """Calls `arrived(payload, arrival_ns)` on the running loop with what `intake` lets through.

    counters: where the rest is counted (vad.handover). latched: asks for the last sample, too.
    """
    take = Handover(asyncio.get_running_loop(), arrived, intake, counters)

    def on_sample(sample: zenoh.Sample) -> None:
        take(sample.payload)

    handler = zenoh.handlers.Callback(on_sample, None, indirect=False)
    subscriber: Any
    # Not in a thread: a cancellation in between would leave a subscription nobody can undeclare.
    if latched:
        history = zenoh.ext.HistoryConfig(max_samples=_HISTORY, detect_late_publishers=True)
        subscriber = zenoh.ext.declare_advanced_subscriber(session, key_expr, handler, history=history)
    else:
        subscriber = session.declare_subscriber(key_expr, handler)
    try:
        yield
    finally:
        # The session may be closed already.
        with contextlib.suppress(zenoh.ZError):
            subscriber.undeclare()
