"""The solving process: it answers, it dies and comes back, it ends with its owner and when idle."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from waiting import until
from walk_sessions import record_walk

from vad.daemon.solver import Solver
from vad.daemon.solver_child import solved_walk
from vad.errors import SessionError
from vad.sim.scenario import make_home

HOME = make_home(1, walks=1)


@asynccontextmanager
async def solving(**arguments: float) -> AsyncIterator[Solver]:
    solver = Solver(**arguments)
    try:
        yield solver
    finally:
        await solver.close()


def alive(pid: int) -> bool:
    """Whether the process runs; one that ended and was not waited for does not."""
    try:
        return " Z " not in Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False


async def test_it_answers_what_solving_here_answers_and_goes_on_after_a_broken_folder(tmp_path: Path) -> None:
    folder = await asyncio.to_thread(record_walk, tmp_path / "walk", HOME, packets_per_s=100.0)
    here = await asyncio.to_thread(solved_walk, folder)
    async with solving() as solver:
        with pytest.raises(SessionError, match="no such session folder"):
            await solver.solve(tmp_path / "none")
        there = await solver.solve(folder)
        assert solver.health.counters["started"] == 1
    assert there.posterior is not None
    assert here.posterior is not None
    assert there.posterior.grid == here.posterior.grid
    assert abs(there.posterior.probability - here.posterior.probability).max() < 1e-6
    assert (there.status, there.packets, there.walk_s, there.epoch) == (
        here.status,
        here.packets,
        here.walk_s,
        here.epoch,
    )


async def test_a_process_that_dies_is_an_error_of_that_session_only(tmp_path: Path) -> None:
    async with solving() as solver:
        with pytest.raises(SessionError, match="no such"):
            await solver.solve(tmp_path / "a")
        assert solver.pid is not None
        os.kill(solver.pid, signal.SIGSTOP)  # it takes the request and says nothing
        asked = asyncio.create_task(solver.solve(tmp_path / "b"))
        await until(lambda: solver.health.detail == "solving b", "it is asked")
        os.kill(solver.pid, signal.SIGKILL)
        with pytest.raises(SessionError, match="the process that solves died"):
            await asked
        assert solver.health.state == "degraded"
        with pytest.raises(SessionError, match="no such"):
            await solver.solve(tmp_path / "c")
        assert solver.health.counters["started"] == 2


async def test_a_session_that_takes_for_ever_is_given_up(tmp_path: Path) -> None:
    async with solving(timeout_s=1.0) as solver:
        os.mkfifo(tmp_path / "session.json")  # who opens it waits for a writer
        with pytest.raises(SessionError, match="took too long"):
            await solver.solve(tmp_path)
        assert solver.pid is None


async def test_cancelling_and_closing_leave_no_process(tmp_path: Path) -> None:
    solver = Solver()
    os.mkfifo(tmp_path / "session.json")
    asked = asyncio.create_task(solver.solve(tmp_path))
    await until(lambda: solver.pid is not None, "it runs")
    pid = solver.pid
    assert pid is not None
    asked.cancel()
    with pytest.raises(asyncio.CancelledError):
        await asked
    assert not alive(pid)
    with pytest.raises(SessionError, match="no such"):
        await solver.solve(tmp_path / "none")
    pid = solver.pid
    assert pid is not None
    assert alive(pid)
    await solver.close()
    await solver.close()
    assert not alive(pid)


async def test_idle_it_gives_its_memory_back(tmp_path: Path) -> None:
    async with solving(idle_s=0.05) as solver:
        with pytest.raises(SessionError, match="no such"):
            await solver.solve(tmp_path / "none")
        await until(lambda: solver.pid is None, "the process ends")
        with pytest.raises(SessionError, match="no such"):
            await solver.solve(tmp_path / "none")


async def test_who_asks_as_the_idle_process_ends_is_answered(tmp_path: Path) -> None:
    async with solving() as solver:
        with pytest.raises(SessionError, match="no such"):
            await solver.solve(tmp_path / "none")
        solver._let_go()  # it takes a moment until its end is noticed
        with pytest.raises(SessionError, match="no such"):
            await solver.solve(tmp_path / "none")
        assert solver.health.counters["started"] == 2
        assert solver.health.state == "ok"
