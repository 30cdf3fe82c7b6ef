"""Logs that grow."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from csi_tools import bodies, running
from waiting import until

from vad.csi import follow
from vad.csi.follow import FollowLog
from vad.csi.logfile import record
from vad.csi.packets import CsiBatch
from vad.csi.select import join_packets
from vad.streams import DropOldestQueue


def log_of(n: int, first: int = 0) -> bytes:
    return b"".join(record(0xBB, body) for body in bodies(n, first))


def counts(out: DropOldestQueue[CsiBatch]) -> list[int]:
    return join_packets([b.packets for b in out.drain()]).bfee_count.tolist()


async def test_a_file_that_grows(tmp_path: Path) -> None:
    path = tmp_path / "csi.dat"
    log = log_of(2000)
    path.write_bytes(log[:100_001])
    source = FollowLog(path)
    async with running(source) as out:
        await until(lambda: source.health.counters["bytes"] == 100_001)
        with path.open("ab") as file:
            file.write(log[100_001:])
        await until(lambda: source.health.counters["packets"] == 2000)
        batches = out.drain()
        assert b"".join(b.raw for b in batches) == log
        arrival = np.concatenate([b.packets.arrival_ns for b in batches])
        assert (np.diff(batches[-1].packets.arrival_ns) == 1_000_000).all()
        assert (arrival > 0).all()


async def test_a_file_that_is_cut_or_replaced_starts_over(tmp_path: Path) -> None:
    path = tmp_path / "csi.dat"
    path.write_bytes(log_of(10) + b"\0\xff")
    source = FollowLog(path)
    async with running(source) as out:
        await until(lambda: source.health.counters["packets"] == 10)
        path.write_bytes(log_of(3, first=100))
        await until(lambda: source.health.counters["packets"] == 13)
        fresh = tmp_path / "fresh"
        fresh.write_bytes(log_of(20, first=200))
        fresh.rename(path)
        await until(lambda: source.health.counters["packets"] == 33)
        assert counts(out) == [*range(10), *range(100, 103), *range(200, 220)]
    assert source.health.counters["opened"] == 3
    assert source.health.counters["truncated_bytes"] == 2


async def test_a_fifo_with_one_writer_after_the_other(tmp_path: Path) -> None:
    path = tmp_path / "fifo"
    os.mkfifo(path)
    source = FollowLog(path)
    async with running(source) as out:
        for turn in range(3):
            with path.open("wb", buffering=0) as writer:
                writer.write(log_of(100, first=1000 * turn) + b"\x00\x10\xbb")
                await until(lambda turn=turn: source.health.counters["packets"] == 100 * (turn + 1))
            await until(lambda turn=turn: source.health.counters["opened"] == turn + 2)
        assert counts(out) == [1000 * turn + i for turn in range(3) for i in range(100)]
    assert source.health.counters["truncated_bytes"] == 9


async def test_a_log_that_is_not_there_yet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(follow, "RETRY_S", 0.01)
    path = tmp_path / "later.dat"
    source = FollowLog(path)
    async with running(source) as out:
        assert source.health.state == "degraded"
        await until(lambda: sum(r.levelname == "WARNING" for r in caplog.records) >= 1)
        path.write_bytes(log_of(5))
        await until(lambda: source.health.counters["packets"] == 5)
        assert source.health.state == "ok"
        assert counts(out) == list(range(5))
    assert [r.levelname for r in caplog.records].count("WARNING") == 1


async def test_a_log_that_goes_away_and_comes_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(follow, "RETRY_S", 0.01)
    path = tmp_path / "csi.dat"
    path.write_bytes(log_of(5) + b"\0\xff\xbb")
    source = FollowLog(path)
    async with running(source) as out:
        await until(lambda: source.health.counters["packets"] == 5)
        path.unlink()
        await until(lambda: source.health.state == "degraded")
        path.write_bytes(log_of(5, first=50))
        await until(lambda: source.health.counters["packets"] == 10)
        assert counts(out) == [*range(5), *range(50, 55)]
    assert source.health.counters["truncated_bytes"] == 3


async def test_a_folder_is_no_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(follow, "RETRY_S", 0.001)
    caplog.set_level("DEBUG", logger="vad.csi.follow")
    async with running(FollowLog(tmp_path)):
        await until(lambda: len(caplog.records) >= 3)
    levels = [r.levelname for r in caplog.records if r.name == "vad.csi.follow"]
    assert levels[0] == "WARNING"
    assert set(levels[1:]) == {"DEBUG"}
