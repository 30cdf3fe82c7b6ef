"""From a foreign thread to the event loop, bounded: what comes too big, too fast or too much is counted.

`loop.call_soon_threadsafe` alone is a queue without an end: a sender that is faster than the loop fills the
memory.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple, Protocol

from vad.limits import RateLimit


class Payload(Protocol):
    """zenoh's ZBytes: tells its length before it is copied."""

    def __len__(self) -> int: ...

    def to_bytes(self) -> bytes: ...


class Intake(NamedTuple):
    """What one key takes. waiting: messages handed over that the loop has not seen yet."""

    max_bytes: int
    per_s: float
    burst: int
    waiting: int = 64


class Handover:
    """Called on any thread with payloads; calls `take(payload, arrival_ns)` on the loop.

    counters: `too_big`, `too_fast`, `overrun`, counted on the loop. A refused message costs the loop nothing
    beyond one count for each batch of them.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        take: Callable[[bytes, int], None],
        intake: Intake,
        counters: Counter[str],
    ) -> None:
        self._loop = loop
        self._take = take
        self._intake = intake
        self._counters = counters
        self._rate = RateLimit(intake.per_s, intake.burst)
        self._lock = threading.Lock()
        self._waiting = 0
        self._refused: Counter[str] = Counter()

    def __call__(self, payload: Payload) -> None:
        """Hand over and return at once."""
        now_ns = time.monotonic_ns()
        size = len(payload)
        with self._lock:
            why = self._why_not(size, now_ns)
            if why is None:
                self._waiting += 1
            else:
                first = not self._refused
                self._refused[why] += 1
        # The loop may have closed in the meantime.
        with suppress(RuntimeError):
            if why is None:
                self._loop.call_soon_threadsafe(self._arrived, payload.to_bytes(), now_ns)
            elif first:
                self._loop.call_soon_threadsafe(self._count)

    def _why_not(self, size: int, now_ns: int) -> str | None:
        if size > self._intake.max_bytes:
            return "too_big"
        if self._waiting >= self._intake.waiting:
            return "overrun"
        return None if self._rate.allows(now_ns) else "too_fast"

    def _arrived(self, payload: bytes, arrival_ns: int) -> None:
        with self._lock:
            self._waiting -= 1
        self._take(payload, arrival_ns)

    def _count(self) -> None:
        with self._lock:
            refused, self._refused = self._refused, Counter()
        self._counters.update(refused)
