"""Work in threads that outlives a cancellation in an orderly way."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


async def to_the_end(work: Callable[[], T]) -> T:
    """Run `work`, some milliseconds of writing, in a thread; a cancellation waits until it is through.

    Else the thread would go on writing beside whoever tidies up after the cancellation.
    """
    running = asyncio.get_running_loop().run_in_executor(None, work)
    try:
        return await asyncio.shield(running)
    except asyncio.CancelledError:
        await asyncio.wait({running})
        raise
