"""Work that outlives a cancellation in an orderly way: whoever is cancelled waits until it is through."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


async def finished(work: asyncio.Future[T]) -> T:
    """What `work` comes to; a cancellation waits until it has ended."""
    try:
        return await asyncio.shield(work)
    except asyncio.CancelledError:
        await asyncio.wait({work})
        raise


async def to_the_end(work: Callable[[], T]) -> T:
    """Run `work`, some milliseconds of writing, in a thread; a cancellation waits until it is through.

    Else the thread would go on writing beside whoever tidies up after the cancellation.
    """
    return await finished(asyncio.get_running_loop().run_in_executor(None, work))
