"""Closing a zenoh session without waiting for who does not read."""

from __future__ import annotations

import asyncio
import logging
import threading
from contextlib import suppress

import zenoh

log = logging.getLogger(__name__)

CLOSE_TIMEOUT_S = 0.8


async def close_in_time(session: zenoh.Session) -> None:
    """Close `session`; leave it to the process's end where a reader that stopped reading holds it up.

    zenoh tries for 10 s to say goodbye on such a link. The thread is a daemon one, so that it cannot hold up
    the end of the process.
    """
    loop = asyncio.get_running_loop()
    closed = asyncio.Event()

    def close() -> None:
        try:
            session.close()  # type: ignore[no-untyped-call]
        except zenoh.ZError as error:
            log.debug("closing: %s", error)
        with suppress(RuntimeError):  # the loop ended before: nobody waits any more
            loop.call_soon_threadsafe(closed.set)

    threading.Thread(target=close, name="vad-bus-close", daemon=True).start()
    try:
        await asyncio.wait_for(closed.wait(), CLOSE_TIMEOUT_S)
    except TimeoutError:
        log.warning("zenoh did not close within %s s: the other end does not read", CLOSE_TIMEOUT_S)
