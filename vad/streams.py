"""Bounded hand-over between tasks: the newest items win, what is dropped is counted."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class DropOldestQueue(Generic[T]):
    """A bounded queue for one consumer whose producer never waits.

    A full queue drops its oldest item, so a slow consumer sees fresh data and `dropped` tells how
    much it missed. Only for use on one event loop's thread; other threads go through
    `loop.call_soon_threadsafe(queue.put, item)`.
    """

    def __init__(self, maxsize: int) -> None:
        if maxsize < 1:
            raise ValueError("maxsize must be at least 1")
        self._items: deque[T] = deque()
        self._maxsize = maxsize
        self._ready = asyncio.Event()
        self.dropped = 0
        self.accepted = 0

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: T) -> None:
        """Append `item`; drop the oldest one when full."""
        if len(self._items) >= self._maxsize:
            self._items.popleft()
            self.dropped += 1
        self._items.append(item)
        self.accepted += 1
        self._ready.set()

    async def get(self) -> T:
        """The oldest item kept; waits for one."""
        while not self._items:
            self._ready.clear()
            await self._ready.wait()
        return self._items.popleft()

    def drain(self) -> list[T]:
        """Everything that waits now, oldest first, without waiting."""
        items = list(self._items)
        self._items.clear()
        return items
