"""The store in trouble: damage, migrations behind backups, a full disk; and what it remembers of the past."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import resource
import sqlite3
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from waiting import until

from vad.store.migrations import MIGRATIONS
from vad.store.opening import BACKUPS_KEPT
from vad.store.records import DeviceRecord, Estimate, HistoryRecord, PastRecord, PosteriorRecord
from vad.store.store import HISTORY_KEPT, Store, StoreError
from vad.store.worker import StoreWorker

MAC = "aa:bb:cc:dd:ee:01"
T0, T1, T2, T3 = (f"2026-05-01T10:0{i}:00.000Z" for i in range(4))
WAITING = DeviceRecord(MAC, "waiting", T0, T0, name="lamp", epoch=3)
PLACE = Estimate(1.25, -0.5, ((0.04, 0.01), (0.01, 0.09)), 0.61, ((0.0, 0.0), (1.0, 0.0)), "Hall", "doppler")
MAPPED = replace(WAITING, state="mapped", walks=2, estimate=PLACE)


def many(count: int, **changes: object) -> list[DeviceRecord]:
    return [
        replace(MAPPED, mac=f"aa:bb:cc:00:{i >> 8:02x}:{i & 255:02x}", **changes)  # type: ignore[arg-type]
        for i in range(count)
    ]


def posterior(mac: str, side: int = 40) -> PosteriorRecord:
    grid = np.random.default_rng(1).normal(size=(side, side)).astype(np.float32)
    return PosteriorRecord(mac, 3, (0.0, 0.0, 4.0, 4.0), 0.1, 2, grid, T1)


@contextmanager
def files_limited_to(size: int) -> Iterator[None]:
    """No file of this process grows beyond `size` bytes: what the disk does that has no room left."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def old_file(path: Path) -> None:
    """A database of version 1, with a device and what was said of it."""
    with contextlib.closing(sqlite3.connect(path)) as db:
        db.executescript(
            f"CREATE TABLE schema_version (version INTEGER NOT NULL); INSERT INTO schema_version VALUES (1);"
            f"{MIGRATIONS[0]};"
            f"INSERT INTO devices VALUES ('{MAC}', 'lamp', 'mapped', '', 3, 2, '{{}}', 1.25, -0.5, 0.04,"
            f" 0.01, 0.09, 0.61, '[[0, 0], [1, 0]]', 'Hall', 'doppler', '{T0}', '{T0}');"
            f"INSERT INTO history (mac, at, state, epoch, x_m, y_m, radius90_m) VALUES ('{MAC}', '{T0}',"
            f" 'mapped', 3, 1.25, -0.5, 0.61);"
        )


def test_a_file_of_the_first_version_is_brought_up_behind_a_backup(tmp_path: Path) -> None:
    path = tmp_path / "vad.db"
    old_file(path)
    with Store(path) as store:
        assert store.version == len(MIGRATIONS)
        assert store.devices() == [MAPPED]
        assert store.history(MAC) == [HistoryRecord(MAC, T0, "mapped", 3, 1.25, -0.5, 0.61)]
        assert store.backup is not None
        assert store.backup.name.startswith("vad.db.v1-")
        assert stat.S_IMODE(store.backup.stat().st_mode) == 0o600
        with contextlib.closing(sqlite3.connect(store.backup)) as copy:
            assert copy.execute("SELECT version FROM schema_version").fetchone() == (1,)
            assert copy.execute("SELECT mac FROM devices").fetchall() == [(MAC,)]
            assert copy.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    with Store(path) as store:
        assert store.backup is None, "nothing to migrate, nothing to back up"


def test_only_the_last_backups_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "vad.db"
    Store(path).close()
    longer = MIGRATIONS
    for i in range(BACKUPS_KEPT + 2):
        longer = (*longer, f"CREATE TABLE later_{i} (a INTEGER)")
        Store(path, migrations=longer).close()
        for backup in tmp_path.glob("*.bak"):  # as where they were copied, or made within a tick of the clock
            os.utime(backup, (1e9 - i, 1e9 - i))
    versions = [int(backup.name.split(".v")[1].split("-")[0]) for backup in tmp_path.glob("*.bak")]
    assert sorted(versions) == [len(longer) - k for k in range(BACKUPS_KEPT, 0, -1)]


def test_without_room_for_the_backup_nothing_is_migrated(tmp_path: Path) -> None:
    path = tmp_path / "vad.db"
    old_file(path)
    before = path.read_bytes()
    with files_limited_to(8192), pytest.raises(StoreError, match="Check the disk's space"):
        Store(path)
    assert path.read_bytes()[100:] == before[100:], "only the journal mode in the header may differ"
    assert sorted(p.name for p in tmp_path.iterdir() if p.suffix in (".bak", ".new")) == []
    with Store(path) as store:
        assert store.devices() == [MAPPED]


@pytest.mark.parametrize("page", [3, 10, 14, 23])
def test_what_is_whole_in_a_damaged_file_is_taken_over(
    tmp_path: Path, page: int, caplog: pytest.LogCaptureFixture
) -> None:
    """One page of many is torn: the devices on all others are there afterwards, before it and behind it."""
    path = tmp_path / "vad.db"
    devices = many(120)
    with Store(path) as store:
        store.save_devices(devices)
        for device in devices[:5]:
            store.save_device(device, posterior(device.mac))
    whole = path.read_bytes()
    assert len(whole) >= 24 * 4096
    path.write_bytes(whole[: page * 4096] + b"\xa5" * 4096 + whole[(page + 1) * 4096 :])
    with caplog.at_level(logging.WARNING), Store(path) as store:
        assert store.set_aside is not None
        kept = store.devices()
        assert all(one in devices for one in kept)
        assert store.saved.get("devices", 0) == len(kept)
        assert len(kept) >= 90
        assert all(store.posterior(device.mac) is None or device in kept for device in devices[:5])
    assert "was damaged: it was set aside as" in caplog.text
    assert f"{len(kept)} of its devices could be read" in caplog.text
    with Store(path) as store:
        assert store.set_aside is None
        assert store.devices() == kept


async def test_a_damaged_file_shows_in_the_health_until_the_next_start(tmp_path: Path) -> None:
    path = tmp_path / "vad.db"
    path.write_bytes(b"this is no database " * 100)
    async with StoreWorker(path) as store:
        assert store.health.state == "degraded"
        await store.save_device(WAITING)
        assert store.health.state == "degraded"
        assert "set aside as" in store.health.detail
        assert "nothing could be read of it" in store.health.detail
    async with StoreWorker(path) as store:
        assert (store.health.state, store.health.detail) == ("ok", "1 devices known at the start")


async def test_a_full_disk_holds_writes_back_and_nothing_else(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with StoreWorker(tmp_path / "vad.db", retry_s=0.01) as store:
        await store.save_device(WAITING)
        with files_limited_to((tmp_path / "vad.db-wal").stat().st_size):
            writes = [
                asyncio.create_task(store.save_device(replace(MAPPED, walks=i), posterior(MAC)))
                for i in range(1, 4)
            ]
            await until(lambda: store.health.counters["writes_refused"] >= 3, "tried again and again")
            assert not any(task.done() for task in writes), "not kept, so not acknowledged"
            assert store.health.state == "failed"
            assert "what is learned now waits to be kept" in store.health.detail
            assert await store.devices() == [WAITING], "questions are answered meanwhile"
        async with asyncio.timeout(40):
            await asyncio.gather(*writes)
        assert store.health.state == "ok"
        assert store.health.counters["writes"] == 4
        assert (await store.devices())[0].walks == 3, "in the order they were made"
    assert [r.message for r in caplog.records if "writes again" in r.message]
    assert len([r for r in caplog.records if "waits to be kept" in r.message]) == 1, "said once"


async def test_a_write_that_waits_for_room_can_be_given_up(tmp_path: Path) -> None:
    async with StoreWorker(tmp_path / "vad.db", retry_s=0.01) as store:
        await store.save_device(WAITING)
        with files_limited_to((tmp_path / "vad.db-wal").stat().st_size):
            write = asyncio.create_task(store.save_device(MAPPED, posterior(MAC)))
            await until(lambda: store.health.counters["writes_refused"] > 0, "refused")
            write.cancel()
            with pytest.raises(asyncio.CancelledError):
                await write
        await store.save_device(replace(WAITING, name="other"))
    with Store(tmp_path / "vad.db") as again:
        assert again.devices() == [replace(WAITING, name="other")]


def test_every_commit_reaches_the_disk(tmp_path: Path) -> None:
    with Store(tmp_path / "vad.db") as store:
        assert store._db.execute("PRAGMA synchronous").fetchone() == (2,), "FULL"
        assert store._db.execute("PRAGMA journal_mode").fetchone() == ("wal",)


def test_how_a_device_was_at_a_time(tmp_path: Path) -> None:
    times = iter([T0, T1, T1, T2])
    with Store(tmp_path / "vad.db", now=times.__next__) as store:
        store.save_device(WAITING)
        store.save_device(MAPPED)
        store.save_device(replace(MAPPED, reason="only the reason"))
        store.save_device(replace(MAPPED, state="stale"))

        def state_at(at: str) -> str | None:
            (past,) = store.past(at, MAC)
            return past.said and past.said.state

        assert store.past("2026-05-01T09:59:59.999Z") == [], "not discovered yet"
        assert [state_at(at) for at in (T0, "2026-05-01T10:00:59.999Z", T1, T2, T3)] == [
            "waiting",
            "waiting",
            "mapped",
            "stale",
            "stale",
        ]
        assert store.past(T3, "aa:bb:cc:dd:ee:99") == []
        assert [row.state for row in store.history(MAC, since=T0, until=T1)] == ["mapped"]
        assert [row.state for row in store.history(MAC, 2)] == ["stale", "mapped"]


def test_what_history_no_longer_reaches_is_said(tmp_path: Path) -> None:
    seconds = iter(range(10**6))

    def now() -> str:
        second = next(seconds)
        return f"2026-05-01T1{second // 3600}:{second // 60 % 60:02}:{second % 60:02}.000Z"

    with Store(tmp_path / "vad.db", now=now) as store:
        store._db.execute("PRAGMA synchronous = OFF")  # 1000 durable writes would only test the disk
        for i in range(HISTORY_KEPT + 61):
            store.save_device(replace(WAITING, epoch=i))
        assert store.past(T0, MAC) == [PastRecord(MAC, None, "2026-05-01T10:01:01.000Z")]
        (first_kept,) = store.past("2026-05-01T10:01:01.000Z", MAC)
        assert first_kept.said is not None
        assert first_kept.said.epoch == 61
