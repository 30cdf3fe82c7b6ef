"""The end of a process of our own."""

from __future__ import annotations

import asyncio
from contextlib import suppress

from vad.finish import finished

_READ_BYTES = 65_536


async def end_child(process: asyncio.subprocess.Process) -> None:
    """Kill it and wait until it is gone with its pipes, also where whoever waits is cancelled meanwhile."""
    with suppress(ProcessLookupError):
        process.kill()
    await finished(asyncio.ensure_future(gone_with_pipes(process)))


async def gone_with_pipes(process: asyncio.subprocess.Process) -> None:
    """Wait to the last of its pipes: `wait` alone leaves them open where the process had ended by itself."""
    if process.stdin is not None:
        process.stdin.close()
    if process.stdout is not None:
        with suppress(ConnectionError):
            while await process.stdout.read(_READ_BYTES):
                pass
    await process.wait()
    if process.stdin is not None:
        with suppress(ConnectionError):
            await process.stdin.wait_closed()
