"""DropOldestQueue: the newest win, the count is exact."""

from __future__ import annotations

import asyncio

from hypothesis import given
from hypothesis import strategies as st

from vad.streams import DropOldestQueue


@given(st.lists(st.integers()), st.integers(1, 5))
def test_keeps_the_newest_and_counts_the_rest(items: list[int], size: int) -> None:
    queue: DropOldestQueue[int] = DropOldestQueue(size)
    for item in items:
        queue.put(item)
    assert queue.dropped == max(0, len(items) - size)
    assert queue.accepted == len(items)
    assert queue.drain() == items[-size:]
    assert len(queue) == 0


async def test_get_waits_for_an_item() -> None:
    queue: DropOldestQueue[str] = DropOldestQueue(2)
    waiting = asyncio.create_task(queue.get())
    await asyncio.sleep(0)
    assert not waiting.done()
    queue.put("a")
    assert await waiting == "a"
