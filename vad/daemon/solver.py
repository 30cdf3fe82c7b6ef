"""Solves sessions in a process of its own: the event loop, the eyes and the bus go on meanwhile.

The process starts with the first session, is started anew where it dies, and ends when there was nothing to
solve for a while, so that its memory goes back.
"""

from __future__ import annotations

import asyncio
import logging
import os
import pickle
import sys
import time
from pathlib import Path

import msgspec

from vad.child import end_child
from vad.daemon.solver_child import SolvedWalk, SolveRequest
from vad.errors import SessionError
from vad.health import Health

_log = logging.getLogger(__name__)

PROGRAM = "from vad.daemon.solver_child import main; main()"
IDLE_S = 120.0
"""Nothing to solve for so long: the process ends."""
SOLVE_TIMEOUT_S = 120.0
"""A second of work is what a session takes; on a busy hub some. After this long it hangs."""


class Solver:
    """One session at a time, in the order of the calls. Used on one event loop; `close` it."""

    def __init__(self, *, idle_s: float = IDLE_S, timeout_s: float = SOLVE_TIMEOUT_S) -> None:
        self.health = Health("solver")
        self.health.ok("nothing is being solved")
        self._idle_s = idle_s
        self._timeout_s = timeout_s
        self._turn = asyncio.Lock()
        self._process: asyncio.subprocess.Process | None = None
        self._was_let_go = False
        self._retire: asyncio.TimerHandle | None = None

    @property
    def pid(self) -> int | None:
        """Of the process while there is one."""
        process = self._process
        return None if process is None or process.returncode is not None else process.pid

    async def solve(self, folder: Path) -> SolvedWalk:
        """Solve a session folder; SessionError where it cannot be read, or where solving it goes wrong."""
        async with self._turn:
            self._stay()
            self.health.ok(f"solving {folder.name}")
            started = time.monotonic()
            try:
                answer = await asyncio.wait_for(self._ask(folder), self._timeout_s)
            except (TimeoutError, EOFError, OSError) as error:
                await self._end()
                why = "took too long" if isinstance(error, TimeoutError) else "died"
                reason = f"the process that solves {why}"
                self.health.counters["died"] += 1
                if self.health.trouble(reason):
                    _log.warning("%s at %s", reason, folder)
                raise SessionError(reason, where=str(folder)) from error
            except asyncio.CancelledError:
                await self._end()  # it is at work on what nobody waits for
                raise
            self.health.counters["solved"] += 1
            self.health.ok(f"the last session took {time.monotonic() - started:.1f} s")
            self._retire = asyncio.get_running_loop().call_later(self._idle_s, self._let_go)
        if isinstance(answer, SolvedWalk):
            return answer
        what, where, remedy = answer
        raise SessionError(what, where=where, remedy=remedy)

    async def close(self) -> None:
        """End the process, whatever it does; safe to call twice."""
        self._stay()
        await self._end()

    async def _ask(self, folder: Path) -> SolvedWalk | tuple[str, str, str]:
        process = await self._running()
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(msgspec.json.encode(SolveRequest(str(folder))) + b"\n")
        await process.stdin.drain()
        length = int.from_bytes(await process.stdout.readexactly(8), "big")
        answer: SolvedWalk | tuple[str, str, str] = pickle.loads(await process.stdout.readexactly(length))
        return answer

    async def _running(self) -> asyncio.subprocess.Process:
        """The process, a new one where there is none or it has ended."""
        if self._process is not None and self._process.returncode is None and not self._was_let_go:
            return self._process
        await self._end()  # one that was let go may still be ending
        self._process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-c",
            PROGRAM,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            # One thread, and no part in what the terminal sends to the daemon.
            env=os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            start_new_session=True,
        )
        self.health.counters["started"] += 1
        return self._process

    def _stay(self) -> None:
        if self._retire is not None:
            self._retire.cancel()
            self._retire = None

    def _let_go(self) -> None:
        """Idle for long: the process ends; whoever asks next finds it gone."""
        if self._process is not None and self._process.returncode is None:
            self._process.kill()
            self._was_let_go = True
            self.health.ok("nothing is being solved")

    async def _end(self) -> None:
        process, self._process, self._was_let_go = self._process, None, False
        if process is not None:
            await end_child(process)
