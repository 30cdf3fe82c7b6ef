"""How a program that runs until it is told to stop ends on SIGINT and SIGTERM."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Coroutine
from typing import Any

from vad.commands.loading import ENDINGS


async def until_ended(work: Coroutine[Any, Any, None]) -> None:
    """Await `work`, the program; the first signal cancels it, later ones change nothing."""
    loop = asyncio.get_running_loop()
    running = asyncio.ensure_future(work)
    for number in ENDINGS:
        loop.add_signal_handler(number, _end, running)  # closing the loop removes them
    with contextlib.suppress(asyncio.CancelledError):
        await running


def _end(running: asyncio.Task[None]) -> None:
    if not running.cancelling():  # a second cancellation would cut the cleaning up short
        running.cancel()
