"""The time of a simulated home in the test's own process: real time, which waits where a machine is behind.

Everything in the daemon that has to do with a walk asks `time.monotonic_ns`. On a busy machine a walk then
takes longer, and has as many pictures and as many packets between two of them as on an idle one.
"""

from __future__ import annotations

import asyncio
import itertools
import time
from collections.abc import Awaitable, Callable
from typing import Self

from waiting import POLL_S

STEP_NS = 100_000_000
"""Between two pictures."""
LATENCY_NS = 50_000_000
"""Between a picture's exposure and its arrival: what is heard up to the exposure has come by then."""


class HomeTime:
    """While this is entered, `time.monotonic_ns` is `now_ns`."""

    def __init__(self) -> None:
        self._real_ns = time.monotonic_ns
        self._behind_ns = 0
        self._until_ns: int | None = None

    def __enter__(self) -> Self:
        time.monotonic_ns = self.now_ns
        return self

    def __exit__(self, *_: object) -> None:
        time.monotonic_ns = self._real_ns

    def now_ns(self) -> int:
        """It never goes back, and stands at the moment up to which it may run."""
        now_ns = self._real_ns() - self._behind_ns
        return now_ns if self._until_ns is None else min(now_ns, self._until_ns)

    def run_until(self, t_ns: int) -> None:
        """Go on from now, at the pace of real time, up to t_ns."""
        now_ns = self.now_ns()
        self._behind_ns = self._real_ns() - now_ns
        self._until_ns = t_ns

    def stand(self) -> None:
        """Wait here."""
        self.run_until(self.now_ns())

    async def play(self, show: Callable[[int], Awaitable[None]], kept_up: Callable[[], bool]) -> None:
        """Call `await show(t_ns)` every STEP_NS from now on, until cancelled.

        The home goes on when what was shown has been taken in: `kept_up` is asked again and again.
        """
        self.stand()
        for t_ns in itertools.count(self.now_ns(), STEP_NS):
            await show(t_ns)
            while not kept_up():  # noqa: ASYNC110 - what is waited for has no event
                await asyncio.sleep(POLL_S)
            self.run_until(t_ns + STEP_NS)
            while self.now_ns() < t_ns + STEP_NS:  # noqa: ASYNC110 - the clock has none, either
                await asyncio.sleep(POLL_S)
