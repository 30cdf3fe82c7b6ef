"""Whether everything that has work gets on with it: that is what systemd's watchdog is fed by.

A timer alone would only say that the event loop turns. Here every part of the pipeline shows whether work
waits for it and how much it has done; one for which work waits and which does none of it is stuck, and from
then on nothing is fed until it moves again. systemd then ends the daemon (SIGABRT: every thread's stack goes
into the journal) and starts it anew. In a home where nothing happens no work waits, and all is well.
"""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from vad.daemon.notify import notify
from vad.streams import DropOldestQueue

_log = logging.getLogger(__name__)

FEED_S = 10.0
"""How often it is looked, at most; a third of WatchdogSec where that is shorter."""
PATIENCE_S = 20.0
"""Work that is a matter of milliseconds and was not begun for so long hangs."""


@dataclass(slots=True)
class Worker:
    """A part that works. what: who has not done what; waiting: whether work waits for it; done: a count that
    grows with everything it does; patience_s: how long one piece may take."""

    what: str
    waiting: Callable[[], bool]
    done: Callable[[], int]
    patience_s: float
    seen: int = field(default=-1, init=False)
    waited: bool = field(default=False, init=False)
    stalled_s: float = field(default=0.0, init=False)

    def look(self, passed_s: float) -> bool:
        """Whether it is stuck, `passed_s` after the last look."""
        done, waiting = self.done(), self.waiting()
        untouched = waiting and self.waited and done == self.seen
        self.stalled_s = self.stalled_s + passed_s if untouched else 0.0
        self.seen, self.waited = done, waiting
        return self.stalled_s >= self.patience_s


class Watchdog:
    """Looks at the workers and feeds. Time is what passed between looks that did take place, so that a
    machine that was asleep, or a daemon that was stopped and goes on, does not count as stuck.

    Args:
        feed: called at each look at which nothing is stuck.
        every_s: between two looks.
    """

    def __init__(self, feed: Callable[[], None], *, every_s: float) -> None:
        self.stuck: tuple[str, ...] = ()
        self._feed = feed
        self._every_s = every_s
        self._workers: list[Worker] = []
        self._thread: asyncio.Future[None] | None = None
        self._turns = 0
        self.forget()

    def forget(self) -> None:
        """The core ends: its workers are no more."""
        self._workers = []
        self.add("no thread is free", self._thread_waits, lambda: self._turns)

    def add(
        self, what: str, waiting: Callable[[], bool], done: Callable[[], int], patience_s: float = PATIENCE_S
    ) -> None:
        """Watch a part; see Worker."""
        self._workers.append(Worker(what, waiting, done, patience_s))

    def add_queue(
        self, what: str, queue: DropOldestQueue[Any], excuse: Callable[[], bool] | None = None
    ) -> None:
        """Watch who takes from a queue. excuse: True while he has to wait for something outside."""
        self.add(
            what,
            lambda: len(queue) > 0 and not (excuse is not None and excuse()),
            lambda: queue.accepted - queue.dropped - len(queue),
        )

    async def run(self) -> None:
        """Feed until cancelled."""
        while True:
            self.look(self._every_s)
            await asyncio.sleep(self._every_s)

    def look(self, passed_s: float) -> None:
        """Feed, if nothing is stuck; what is stuck is said once."""
        stuck = tuple(worker.what for worker in self._workers if worker.look(passed_s))
        if stuck != self.stuck:
            self.stuck = stuck
            if stuck:
                _log.error("stuck: %s. The watchdog is fed no more", "; ".join(stuck))
                notify(f"STATUS=stuck: {'; '.join(stuck)}")
            else:
                _log.warning("nothing is stuck any more")
        if not stuck:
            self._feed()
        if self._thread is None or self._thread.done():
            self._turns += 1
            self._thread = asyncio.get_running_loop().run_in_executor(None, _nothing)

    def _thread_waits(self) -> bool:
        return self._thread is not None and not self._thread.done()


def feed() -> None:
    """Tell systemd that all is well."""
    notify("WATCHDOG=1")


def feed_every_s() -> float:
    """How often systemd wants to hear it: three times in WatchdogSec."""
    given = os.environ.get("WATCHDOG_USEC", "")
    return min(FEED_S, int(given) / 3e6) if given.isdigit() and int(given) > 0 else FEED_S


def _nothing() -> None:
    """What a free thread does at once."""
