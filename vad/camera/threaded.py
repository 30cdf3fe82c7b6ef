"""Cameras whose library blocks: one thread a camera, reopened when it fails, ended with its task."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from vad.camera.frame import BAD_PICTURES, Frame, FrameQueue
from vad.errors import ProtocolError, SourceError
from vad.health import Health

log = logging.getLogger(__name__)

BACKOFF_FIRST_S = 0.5
BACKOFF_MAX_S = 5.0


@dataclass(frozen=True, slots=True)
class Shot:
    """One picture from a thread. detail: what health says; counts: what to add to the health's counters."""

    t_ns: int
    image: NDArray[np.uint8]
    detail: str
    counts: dict[str, int] = field(default_factory=dict)


Emit = Callable[[Shot], None]
Wants = Callable[[int], bool]
Session = Callable[[threading.Event, Emit, Wants], None]
"""Opens the camera, emits the pictures whose times are wanted until the event is set, closes it. Raises
SourceError, ProtocolError or cv2.error when the camera is not there or has gone; emitting never blocks."""


async def run_reopening(
    session: Session, out: FrameQueue, health: Health, *, name: str, end_s: float
) -> None:
    """Run sessions one after the other in a thread until cancelled.

    Args:
        name: the thread's. end_s: within this a session ends after its event was set.
    """
    loop = asyncio.get_running_loop()
    stop = threading.Event()
    ended = asyncio.Event()
    seq = 0

    def take(shot: Shot) -> None:
        nonlocal seq
        if stop.is_set():
            return
        before = out.dropped
        out.put(Frame(shot.t_ns, seq, shot.image))
        seq += 1
        health.counters["frames"] += 1
        health.counters["dropped"] += out.dropped - before
        if shot.counts.get(BAD_PICTURES) and not health.counters[BAD_PICTURES]:
            log.warning("%s: a picture cannot be decoded; it and the next such are left out", health.part)
        health.counters.update(shot.counts)
        health.counters["unwanted"] = out.unwanted
        health.ok(shot.detail)

    def trouble(reason: str) -> None:
        log.log(logging.WARNING if health.trouble(reason) else logging.DEBUG, "%s: %s", health.part, reason)
        health.counters["reopens"] += 1

    def work() -> None:
        # A RuntimeError: the loop has gone, and nobody waits any more.
        with contextlib.suppress(RuntimeError):
            try:
                _repeat(session, out.wants, stop, loop, take, trouble)
            finally:
                loop.call_soon_threadsafe(ended.set)

    thread = threading.Thread(target=work, name=name, daemon=True)
    thread.start()
    try:
        await ended.wait()
    finally:
        stop.set()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(end_s):
                await ended.wait()
            thread.join(timeout=end_s)


def _repeat(
    session: Session,
    wants: Wants,
    stop: threading.Event,
    loop: asyncio.AbstractEventLoop,
    take: Callable[[Shot], None],
    trouble: Callable[[str], None],
) -> None:
    backoff_s = BACKOFF_FIRST_S
    while not stop.is_set():
        shots = 0

        def emit(shot: Shot) -> None:
            nonlocal shots
            shots += 1
            loop.call_soon_threadsafe(take, shot)

        try:
            session(stop, emit, wants)
        except (SourceError, ProtocolError, cv2.error) as error:
            if not stop.is_set():
                loop.call_soon_threadsafe(trouble, str(error))
        if shots:
            backoff_s = BACKOFF_FIRST_S
        stop.wait(backoff_s)
        backoff_s = min(2.0 * backoff_s, BACKOFF_MAX_S)
