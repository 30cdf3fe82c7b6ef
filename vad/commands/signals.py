"""SIGINT and SIGTERM, which vad.cli holds back while the program loads, and how a program ends on them."""

from __future__ import annotations

import asyncio
import contextlib
import signal
from collections.abc import Coroutine
from typing import Any

ENDINGS = (signal.SIGINT, signal.SIGTERM)


def release() -> None:
    """Deliver the signals again, those that waited at once."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDINGS)


async def until_ended(work: Coroutine[Any, Any, None]) -> None:
    """Await `work`, the program; the first signal cancels it, later ones change nothing."""
    loop = asyncio.get_running_loop()
    running = asyncio.ensure_future(work)
    for number in ENDINGS:
        loop.add_signal_handler(number, _end, running)  # closing the loop removes them
    release()
    with contextlib.suppress(asyncio.CancelledError):
        await running


def _end(running: asyncio.Task[None]) -> None:
    if not running.cancelling():  # a second cancellation would cut the cleaning up short
        running.cancel()
