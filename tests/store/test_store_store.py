"""The store's promise: what was written is there after a restart, and damage is said, not hidden."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import stat
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vad.store.migrations import MIGRATIONS
from vad.store.records import (
    AgentRecord,
    CameraRecord,
    DeviceRecord,
    EpochRecord,
    Estimate,
    HistoryRecord,
    PosteriorRecord,
)
from vad.store.store import HISTORY_KEPT, Store, StoreError
from vad.store.worker import StoreWorker

ROOT = Path(__file__).parents[2]
MAC = "aa:bb:cc:dd:ee:01"
T0 = "2024-05-01T10:00:00.000Z"
T1 = "2024-05-01T10:05:00.000Z"

WAITING = DeviceRecord(MAC, "waiting", T0, T0, name="lamp", reason="nobody walks", epoch=3)
MAPPED = replace(
    WAITING,
    state="mapped",
    reason="",
    updated_at=T1,
    walks=2,
    evidence={"packets": 12000.0, "seconds": 31.5},
    estimate=Estimate(
        1.25,
        -0.5,
        ((0.04, 0.01), (0.01, 0.09)),
        0.61,
        ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0)),
        "Küche",
        "doppler",
        (0.4, 1.5),
    ),
)


def posterior(seed: int = 1) -> PosteriorRecord:
    grid = np.random.default_rng(seed).normal(size=(40, 60)).astype(np.float32)
    grid[0, 0] = -np.inf
    return PosteriorRecord(MAC, 3, (-1.0, 0.0, 5.0, 4.0), 0.1, 2, grid, T1, grid + 1, (0.0, -0.5))


def test_everything_written_is_there_after_a_restart(tmp_path: Path) -> None:
    path = tmp_path / "state" / "vad.db"
    camera = CameraRecord("front", 3, {"map_from_image": [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]}, T1)
    with Store(path, now=iter([T0, T1]).__next__) as store:
        store.save_device(WAITING)
        store.save_device(MAPPED, posterior())
        store.save_agent(AgentRecord("attic", {"csi": "intel5300"}, T0, T0))
        store.save_agent(AgentRecord("attic", {"csi": "intel5300", "wired": True}, T1, T1))
        store.save_camera(camera)
        store.save_camera(replace(camera, epoch=2))
        store.save_epoch(EpochRecord(2, "old", T0))
        store.save_epoch(EpochRecord(3, "new", T1))
    with Store(path) as store:
        assert store.set_aside is None
        assert store.devices() == [MAPPED]
        assert store.device(MAC) == MAPPED
        assert store.device("aa:bb:cc:dd:ee:99") is None
        kept = store.posterior(MAC)
        assert kept is not None
        expected = posterior()
        np.testing.assert_array_equal(kept.log_posterior, expected.log_posterior)
        assert kept.log_heard is not None
        np.testing.assert_array_equal(kept.log_heard, expected.log_posterior + 1)
        assert kept.height == expected.height
        assert kept.log_posterior.dtype == np.float32
        assert (kept.bounds_m, kept.step_m, kept.walks) == (expected.bounds_m, expected.step_m, 2)
        assert store.cameras(3) == [camera]
        assert store.cameras(4) == []
        assert store.last_epoch() == EpochRecord(3, "new", T1)
        assert store.history(MAC) == [
            HistoryRecord(
                MAC, T1, "mapped", 3, 1.25, -0.5, 0.61, "lamp", "Küche", 2, ((0.04, 0.01), (0.01, 0.09))
            ),
            HistoryRecord(MAC, T0, "waiting", 3, name="lamp"),
        ]
        assert store.agents() == [AgentRecord("attic", {"csi": "intel5300", "wired": True}, T0, T1)]


def test_the_file_is_readable_by_its_owner_only(tmp_path: Path) -> None:
    with Store(tmp_path / "vad.db"):
        assert stat.S_IMODE((tmp_path / "vad.db").stat().st_mode) == 0o600


def test_saving_a_device_again_keeps_its_posterior(tmp_path: Path) -> None:
    with Store(tmp_path / "vad.db") as store:
        store.save_device(MAPPED, posterior())
        store.save_device(replace(MAPPED, name="floor lamp"))
        assert store.posterior(MAC) is not None
        assert len(store.history(MAC)) == 1, "a name is no news of where it is"


def test_forgetting_a_device_takes_all_of_it(tmp_path: Path) -> None:
    with Store(tmp_path / "vad.db") as store:
        store.save_device(MAPPED, posterior())
        assert store.forget_device(MAC)
        assert not store.forget_device(MAC)
        assert (store.devices(), store.posterior(MAC), store.history(MAC)) == ([], None, [])


def test_a_device_and_its_posterior_are_written_together_or_not_at_all(tmp_path: Path) -> None:
    broken = replace(posterior(), updated_at=None)  # type: ignore[arg-type]
    with Store(tmp_path / "vad.db") as store:
        store.save_device(WAITING)
        with pytest.raises(StoreError, match="NOT NULL"):
            store.save_device(MAPPED, broken)
        assert store.device(MAC) == WAITING
        with pytest.raises(ValueError, match="cannot be kept with"):
            store.save_device(replace(MAPPED, mac="aa:bb:cc:dd:ee:02"), posterior())


def test_history_is_bounded(tmp_path: Path) -> None:
    with Store(tmp_path / "vad.db") as store:
        store._db.execute("PRAGMA synchronous = OFF")  # 1000 durable writes would only test the disk
        for i in range(HISTORY_KEPT + 5):
            store.save_device(replace(WAITING, epoch=i))
        kept = store.history(MAC, 10**6)
        assert len(kept) == HISTORY_KEPT
        assert (kept[0].epoch, kept[-1].epoch) == (HISTORY_KEPT + 4, 5)


@pytest.mark.parametrize("damage", ["garbage", "torn"])
def test_a_damaged_file_is_set_aside_and_said_so(
    tmp_path: Path, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "vad.db"
    with Store(path) as store:
        for i in range(50):
            store.save_device(replace(MAPPED, mac=f"aa:bb:cc:dd:ee:{i:02x}"))
    if damage == "garbage":
        path.write_bytes(b"this is no database " * 100)
    else:
        whole = path.read_bytes()
        path.write_bytes(whole[:4096] + b"\xa5" * (len(whole) - 4096))
    damaged = path.read_bytes()
    with caplog.at_level(logging.WARNING), Store(path) as store:
        assert store.set_aside is not None
        assert store.set_aside.name.startswith("vad.db.corrupt-")
        assert store.set_aside.read_bytes() == damaged
        assert store.devices() == []
        store.save_device(WAITING)
    assert "set aside" in caplog.text
    with Store(path) as store:
        assert store.set_aside is None
        assert store.devices() == [WAITING]


def test_a_damaged_posterior_is_an_error_with_a_name(tmp_path: Path) -> None:
    with Store(tmp_path / "vad.db") as store:
        store.save_device(MAPPED, posterior())
        store._db.execute("UPDATE posteriors SET log_posterior = x'00112233'")
        with pytest.raises(StoreError, match=f"posterior of {MAC} is damaged"):
            store.posterior(MAC)


def test_an_older_file_is_brought_up_and_keeps_its_rows(tmp_path: Path) -> None:
    path = tmp_path / "vad.db"
    with Store(path) as store:
        store.save_device(MAPPED)
        assert store.version == len(MIGRATIONS)
    longer = (*MIGRATIONS, "ALTER TABLE epochs ADD COLUMN note TEXT NOT NULL DEFAULT ''")
    with Store(path, migrations=longer) as store:
        assert store.version == len(MIGRATIONS) + 1
        assert store.devices() == [MAPPED]
    with Store(path, migrations=longer) as store:
        assert store.version == len(MIGRATIONS) + 1
    with pytest.raises(StoreError, match="newer vad"):
        Store(path)


def test_a_migration_that_fails_leaves_the_file_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "vad.db"
    with Store(path) as store:
        store.save_device(MAPPED)
    with pytest.raises(StoreError, match="no such table"):
        Store(path, migrations=(*MIGRATIONS, "DELETE FROM devices; DELETE FROM nowhere"))
    with Store(path) as store:
        assert store.version == len(MIGRATIONS)
        assert store.devices() == [MAPPED]


def test_a_folder_in_the_way_is_an_error_with_a_remedy(tmp_path: Path) -> None:
    (tmp_path / "vad.db").mkdir()
    with pytest.raises(StoreError, match="unable to open"):
        Store(tmp_path / "vad.db")
    assert (tmp_path / "vad.db").is_dir()
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="another state folder"):
        Store(tmp_path / "file" / "vad.db")


def test_a_file_in_use_is_refused_and_no_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "vad.db"
    monkeypatch.setattr("vad.store.opening.BUSY_TIMEOUT_S", 0.05)
    with Store(path) as store:
        store.save_device(WAITING)
        with pytest.raises(StoreError, match=r"locked\. Another vad uses it"):
            Store(path)
        store.save_device(MAPPED)
    with Store(path) as store:
        assert store.set_aside is None
        assert store.devices() == [MAPPED]


def test_what_was_acknowledged_survives_kill_9(tmp_path: Path) -> None:
    path = tmp_path / "vad.db"
    writer = (
        "import sys\nfrom pathlib import Path\nfrom vad.store.store import Store\n"
        "from vad.store.records import DeviceRecord\n"
        "store = Store(Path(sys.argv[1]))\n"
        "for i in range(100000):\n"
        "    mac = f'aa:bb:cc:{i >> 16 & 255:02x}:{i >> 8 & 255:02x}:{i & 255:02x}'\n"
        "    store.save_device(DeviceRecord(mac, 'waiting', 'a', 'b'))\n"
        "    print(mac, flush=True)\n"
    )
    acknowledged = []
    with subprocess.Popen(
        [sys.executable, "-c", writer, str(path)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[2],
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            acknowledged.append(line.strip())
            if len(acknowledged) == 25:
                process.kill()
    with Store(path) as store:
        assert store.set_aside is None
        kept = {device.mac for device in store.devices()}
    whole = {mac for mac in acknowledged if len(mac) == 17}
    assert len(whole) >= 25
    assert whole <= kept


async def test_the_worker_does_the_same_on_its_own_thread(tmp_path: Path) -> None:
    async with StoreWorker(tmp_path / "vad.db") as store:
        assert store.set_aside is None
        await asyncio.gather(*(store.save_device(replace(WAITING, epoch=i)) for i in range(20)))
        await store.save_device(MAPPED, posterior())
        await store.save_camera(CameraRecord("front", 3, {"a": 1}, T0))
        await store.save_epoch(EpochRecord(3, "new", T1))
        assert await store.devices() == [MAPPED]
        assert await store.device(MAC) == MAPPED
        assert await store.posterior(MAC) is not None
        assert [row.epoch for row in await store.history(MAC, 3)] == [3, 19, 18], "in the order asked"
        assert len(await store.cameras(3)) == 1
        assert await store.last_epoch() == EpochRecord(3, "new", T1)
        assert await store.forget_device(MAC)
    assert not [t for t in threading.enumerate() if t.name.startswith("vad-store")]


async def test_a_worker_that_cannot_open_leaves_no_thread(tmp_path: Path) -> None:
    (tmp_path / "vad.db").mkdir()
    with pytest.raises(StoreError):
        await StoreWorker(tmp_path / "vad.db").open()
    assert not [t for t in threading.enumerate() if t.name.startswith("vad-store")]


async def test_a_worker_cancelled_while_opening_leaves_the_file_closed(tmp_path: Path) -> None:
    worker = StoreWorker(tmp_path / "vad.db")
    task = asyncio.create_task(worker.open())
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert not [t for t in threading.enumerate() if t.name.startswith("vad-store")]
    assert not _files_open_below(tmp_path)


def _files_open_below(folder: Path) -> list[str]:
    held = []
    for link in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):
            held.append(str(link.readlink()))
    return [name for name in held if name.startswith(str(folder))]
