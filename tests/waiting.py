"""What asynchronous tests wait with."""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import functools
import random
import socket
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from typing import Any

POLL_S = 0.005


async def until(condition: Callable[[], object], what: str = "", timeout_s: float = 40.0) -> None:
    """Wait for what has no event; AssertionError, with the words for it, where it does not come."""
    try:
        async with asyncio.timeout(timeout_s):
            while not condition():  # noqa: ASYNC110 - what is waited for has no event
                await asyncio.sleep(POLL_S)
    except TimeoutError:
        raise AssertionError(f"not in {timeout_s:g} s: {what or 'what the test waits for'}") from None


def wait_until(condition: Callable[[], object], what: str = "", timeout_s: float = 40.0) -> None:
    """`until` for a test that runs no event loop."""
    ends_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < ends_s, f"not in {timeout_s:g} s: {what or 'what the test waits for'}"
        time.sleep(POLL_S)


@contextlib.asynccontextmanager
async def running(*parts: Coroutine[Any, Any, None]) -> AsyncIterator[None]:
    """They run inside, and are cancelled and awaited at the end; none may have failed."""
    tasks = [asyncio.create_task(part) for part in parts]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        failed = [task.exception() for task in tasks if not task.cancelled() and task.exception()]
        assert not failed, failed


# Below the ports that the kernel gives to those who ask for any: none of them is handed out there.
_OWN_PORTS = range(20_000, 32_000)
# Above the kernel's own, below the driver's, which simulated homes play in.
_OWN_GROUPS = range(11, 25)
_claims: list[socket.socket] = []


def free_port() -> int:
    """A TCP port of the loopback interface that nobody listens on, nor will unless told this number."""

    def is_free(port: int) -> bool:
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                return False
        return True

    return _claimed("port", _OWN_PORTS, is_free)


@functools.cache
def free_group() -> int:
    """This process's group of the kernel connector: nothing of other test processes is heard in it."""
    return _claimed("connector group", _OWN_GROUPS, lambda group: True)


def _claimed(kind: str, numbers: range, is_free: Callable[[int], bool]) -> int:
    """One that no other test run on this machine is given while this process lives.

    A name that the kernel knows, and forgets with the process, stands for each.
    """
    for number in random.SystemRandom().sample(numbers, len(numbers)):
        claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            claim.bind(f"\0vad test {kind} {number}")
        except OSError:
            claim.close()
            continue
        if is_free(number):
            _claims.append(claim)
            return number
        claim.close()
    raise AssertionError(f"every {kind} is taken")


@atexit.register
def _give_back() -> None:
    while _claims:
        _claims.pop().close()
