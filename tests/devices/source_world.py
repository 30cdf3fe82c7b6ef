"""A source of stations that runs beside a test."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Coroutine
from typing import Any, Protocol


class Part(Protocol):
    """Whatever runs until it is cancelled."""

    def run(self, *out: Any) -> Coroutine[Any, Any, None]: ...


@contextlib.asynccontextmanager
async def running(part: Part, *out: object) -> AsyncIterator[None]:
    """It runs inside, and until then; at the end it is cancelled and awaited."""
    task = asyncio.create_task(part.run(*out))
    try:
        yield
    finally:
        assert not task.done(), task
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
