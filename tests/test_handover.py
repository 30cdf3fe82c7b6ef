"""From another thread to the loop: in order, bounded, what is refused is counted."""

from __future__ import annotations

import asyncio
import threading
import tracemalloc
from collections import Counter

from vad.handover import Handover, Intake

ROOMY = Intake(max_bytes=100, per_s=1e9, burst=10**9, waiting=10**6)


class Bytes:
    """As zenoh's: knows its length, is copied on demand."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self.copied = 0

    def __len__(self) -> int:
        return len(self._data)

    def to_bytes(self) -> bytes:
        self.copied += 1
        return self._data


async def settled() -> None:
    """What other threads handed over has been called."""
    done = asyncio.Event()
    asyncio.get_running_loop().call_soon_threadsafe(done.set)
    await done.wait()


async def test_everything_arrives_in_order() -> None:
    taken: list[bytes] = []
    counters: Counter[str] = Counter()
    hand = Handover(asyncio.get_running_loop(), lambda data, _: taken.append(data), ROOMY, counters)

    def send() -> None:
        for i in range(1000):
            hand(Bytes(b"%d" % i))

    await asyncio.to_thread(send)
    await settled()
    assert taken == [b"%d" % i for i in range(1000)]
    assert counters == Counter()


async def test_what_is_too_big_is_never_copied() -> None:
    taken: list[bytes] = []
    counters: Counter[str] = Counter()
    hand = Handover(asyncio.get_running_loop(), lambda data, _: taken.append(data), ROOMY, counters)
    big = Bytes(bytes(101))
    for _ in range(5):
        hand(big)
    hand(Bytes(bytes(100)))
    await settled()
    assert big.copied == 0
    assert taken == [bytes(100)]
    assert counters == Counter(too_big=5)


async def test_a_burst_beyond_the_rate_is_counted() -> None:
    taken: list[bytes] = []
    counters: Counter[str] = Counter()
    slow = Intake(max_bytes=100, per_s=0.001, burst=3)
    hand = Handover(asyncio.get_running_loop(), lambda data, _: taken.append(data), slow, counters)
    for _ in range(10):
        hand(Bytes(b"x"))
    await settled()
    assert len(taken) == 3
    assert counters == Counter(too_fast=7)


async def test_a_loop_that_stands_still_bounds_what_waits() -> None:
    taken: list[bytes] = []
    counters: Counter[str] = Counter()
    few = Intake(max_bytes=10**6, per_s=1e9, burst=10**9, waiting=16)
    hand = Handover(asyncio.get_running_loop(), lambda data, _: taken.append(data), few, counters)

    def flood() -> None:
        for _ in range(2000):
            hand(Bytes(bytes(100_000)))

    tracemalloc.start()
    flooding = threading.Thread(target=flood)
    flooding.start()
    flooding.join()  # the loop does nothing meanwhile
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    await settled()
    assert len(taken) == 16
    assert counters == Counter(overrun=1984)
    assert peak < 40 * 100_000
    hand(Bytes(b"later"))
    await settled()
    assert taken[-1] == b"later", "it goes on afterwards"


async def test_after_the_loop_nothing_is_raised() -> None:
    loop = asyncio.new_event_loop()
    hand = Handover(loop, lambda data, _: None, ROOMY, Counter())
    loop.close()
    hand(Bytes(b"x"))
    hand(Bytes(bytes(101)))
