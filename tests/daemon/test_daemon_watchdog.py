"""The watchdog: what has work and does it is fed, an idle home too; what hangs stops the feeding."""

from __future__ import annotations

import asyncio
import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st
from waiting import until

from vad.daemon.watchdog import FEED_S, PATIENCE_S, Watchdog, Worker, feed_every_s
from vad.streams import DropOldestQueue

LOOKS = int(PATIENCE_S / FEED_S)
"""At so many looks in a row work has to have waited untouched."""


class Fed:
    """Counts how often it was fed."""

    def __init__(self) -> None:
        self.times = 0
        self.watchdog = Watchdog(self._feed, every_s=FEED_S)

    def _feed(self) -> None:
        self.times += 1

    async def look(self) -> bool:
        """Whether the next look feeds; the thread that it asked for has had its turn."""
        before = self.times
        self.watchdog.look(FEED_S)
        await self.thread()
        return self.times > before

    async def thread(self) -> None:
        """Wait for the thread that the last look asked for: others are no sign of it."""
        assert self.watchdog._thread is not None
        await self.watchdog._thread


async def test_an_idle_home_is_fed() -> None:
    fed, queue = Fed(), DropOldestQueue[int](2)
    fed.watchdog.add_queue("pictures wait", queue)
    assert [await fed.look() for _ in range(20)] == [True] * 20


async def test_work_that_is_done_is_fed_even_where_some_always_waits() -> None:
    fed, queue = Fed(), DropOldestQueue[int](2)
    fed.watchdog.add_queue("pictures wait", queue)
    for picture in range(20):
        queue.put(picture)
        queue.put(picture)
        await queue.get()
        assert await fed.look()


async def test_who_takes_nothing_is_stuck_and_is_fed_again_when_he_does(
    caplog: pytest.LogCaptureFixture,
) -> None:
    fed, queue = Fed(), DropOldestQueue[int](2)
    fed.watchdog.add_queue("pictures wait", queue)
    assert await fed.look()
    looks = []
    for picture in range(LOOKS + 3):
        queue.put(picture)  # they go on coming, and the oldest are dropped: that is not being taken
        looks.append(await fed.look())
    # The first look with something in the queue is where the clock starts.
    assert looks == [True] * LOOKS + [False] * 3
    assert fed.watchdog.stuck == ("pictures wait",)
    assert [record.levelname for record in caplog.records] == ["ERROR"]
    queue.drain()
    assert await fed.look()
    assert fed.watchdog.stuck == ()


async def test_who_waits_for_the_disk_is_not_stuck() -> None:
    fed, queue, full = Fed(), DropOldestQueue[int](8), True
    fed.watchdog.add_queue("devices wait", queue, lambda: full)
    queue.put(1)
    assert [await fed.look() for _ in range(10)] == [True] * 10
    full = False
    assert [await fed.look() for _ in range(LOOKS + 2)][-1] is False


async def test_threads_that_are_all_taken_are_noticed() -> None:
    fed, release = Fed(), threading.Event()
    loop = asyncio.get_running_loop()
    try:
        assert await fed.look()
        taken = [loop.run_in_executor(None, release.wait) for _ in range(64)]
        looks = []
        for _ in range(LOOKS + 3):
            before = fed.times
            fed.watchdog.look(FEED_S)
            looks.append(fed.times > before)
        assert looks[-1] is False
        assert fed.watchdog.stuck == ("no thread is free",)
    finally:
        release.set()
    await asyncio.gather(*taken)
    await fed.thread()
    fed.watchdog.look(FEED_S)
    assert fed.watchdog.stuck == ()


async def test_an_event_loop_that_stands_still_feeds_nothing() -> None:
    fed = Fed()
    watchdog = Watchdog(lambda: setattr(fed, "times", fed.times + 1), every_s=0.01)
    feeding = asyncio.create_task(watchdog.run())
    try:
        await until(lambda: fed.times >= 3, "it is fed")
        before = fed.times
        threading.Event().wait(0.1)  # blocks the loop
        assert fed.times == before
        await until(lambda: fed.times > before, "it is fed again")
    finally:
        feeding.cancel()
        await asyncio.wait({feeding})


async def test_a_machine_that_slept_is_not_stuck() -> None:
    """Only looks that took place count: whatever the clocks say, the first one after a pause bites nobody."""
    fed, queue = Fed(), DropOldestQueue[int](2)
    fed.watchdog.add_queue("pictures wait", queue)
    queue.put(1)
    assert await fed.look()
    # An hour passes; nobody has had the time to take anything when the next look comes.
    assert await fed.look()


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 2)), max_size=60))
def test_stuck_means_untouched_work_at_enough_looks_in_a_row(story: list[tuple[bool, int]]) -> None:
    waiting, done = False, 0
    worker = Worker("it", lambda: waiting, lambda: done, PATIENCE_S)
    untouched, waited = 0, False
    worker.look(FEED_S)
    for waiting, steps in story:
        done += steps
        untouched = untouched + 1 if waiting and waited and not steps else 0
        waited = waiting
        assert worker.look(FEED_S) == (untouched * FEED_S >= PATIENCE_S)


@pytest.mark.parametrize(
    ("usec", "every_s"), [("30000000", FEED_S), ("3000000", 1.0), ("", FEED_S), ("0", FEED_S), ("x", FEED_S)]
)
def test_it_is_fed_three_times_in_watchdogsec(
    monkeypatch: pytest.MonkeyPatch, usec: str, every_s: float
) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", usec)
    assert feed_every_s() == every_s
