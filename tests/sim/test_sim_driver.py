"""The simulated driver: the real connector and FIFO readers get its records, nothing ever blocks it."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from waiting import free_group, until

from vad.csi.connector import Connector
from vad.csi.follow import FollowLog
from vad.csi.logfile import record, scan
from vad.csi.packets import CsiBatch
from vad.errors import SourceError
from vad.health import Health
from vad.mac import mac_from_text
from vad.sim import driver
from vad.sim.driver import ConnectorSender, FifoSender
from vad.sim.radio import OTHER_MAC, Radio, RadioBatch
from vad.sim.scenario import make_home
from vad.streams import DropOldestQueue


def read_all(fd: int) -> bytes:
    data = b""
    while True:
        try:
            piece = os.read(fd, 1 << 16)
        except BlockingIOError:
            return data
        if not piece:
            return data
        data += piece


def open_reader(path: Path) -> int:
    return os.open(path, os.O_RDONLY | os.O_NONBLOCK)


RECORDS = [record(0xC1, bytes([k]) * (60 + 7 * (k % 9))) for k in range(100)]


def test_fifo_without_reader_drops_and_counts(tmp_path: Path) -> None:
    sender = FifoSender(tmp_path / "csi")
    sender.send(RECORDS)
    counters = sender.health.counters
    assert counters["dropped_records"] == len(RECORDS)
    assert counters["dropped_bytes"] == sum(map(len, RECORDS))
    assert sender.health.state == "degraded"
    sender.close()
    assert not (tmp_path / "csi").exists()


def test_fifo_readers_come_and_go_and_start_at_a_record(tmp_path: Path) -> None:
    path = tmp_path / "csi"
    sender = FifoSender(path)
    sender.send(RECORDS[:10])
    first = open_reader(path)
    sender.send(RECORDS[10:20])
    assert os.read(first, 30) == b"".join(RECORDS[10:20])[:30]  # leaves in the middle of a record
    os.close(first)
    sender.send(RECORDS[20:30])
    second = open_reader(path)
    sender.send(RECORDS[30:40])
    assert read_all(second) == b"".join(RECORDS[30:40])
    counters = sender.health.counters
    assert (counters["readers"], counters["records"], counters["dropped_records"]) == (2, 20, 20)
    sender.close()
    assert read_all(second) == b""
    os.close(second)


def test_fifo_full_drops_whole_records(tmp_path: Path) -> None:
    path = tmp_path / "csi"
    sender = FifoSender(path)
    reader = open_reader(path)
    for _ in range(100):
        sender.send(RECORDS)
    data = read_all(reader)
    sender.send(RECORDS[:3])
    data += read_all(reader)
    counters = sender.health.counters
    assert counters["dropped_records"] > 0
    assert scan(data).end == len(data) == counters["bytes"]
    assert len(scan(data).offsets) == counters["records"]
    assert counters["records"] + counters["dropped_records"] == 100 * len(RECORDS) + 3
    assert data.endswith(b"".join(RECORDS[:3]))
    os.close(reader)
    sender.close()
    sender.send(RECORDS)
    assert counters["dropped_records"] + counters["records"] == 101 * len(RECORDS) + 3


def test_fifo_keeps_one_that_was_there(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "csi")
    FifoSender(tmp_path / "csi").close()
    assert (tmp_path / "csi").exists()
    (tmp_path / "file").touch()
    with pytest.raises(SourceError, match="not a FIFO"):
        FifoSender(tmp_path / "file")
    with pytest.raises(SourceError):
        FifoSender(tmp_path / "absent" / "csi")


async def collect(queue: DropOldestQueue[CsiBatch], packets: int, timeout_s: float = 40.0) -> list[CsiBatch]:
    got: list[CsiBatch] = []
    async with asyncio.timeout(timeout_s):
        while sum(len(b.packets) for b in got) < packets:
            got.append(await queue.get())
    return got


async def stop(*tasks: asyncio.Task[None]) -> None:
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


def check_played(got: list[CsiBatch], radio: Radio, device_mac: str, start_ns: int) -> None:
    """The packets are the radio's own, from the right senders and at the right times."""
    nic_us = np.concatenate([b.packets.nic_us for b in got])
    count = np.concatenate([b.packets.bfee_count for b in got])
    mac = np.concatenate([b.packets.mac for b in got])
    arrival_s = (np.concatenate([b.packets.arrival_ns for b in got]) - start_ns) / 1e9
    truth = radio.generate(arrival_s[0] - 1.0, arrival_s[-1] + 1.0)
    row = np.searchsorted(truth.nic_us, nic_us)
    assert (truth.nic_us[row] == nic_us).all()
    assert (truth.bfee_count[row] == count).all()
    known = mac >= 0
    assert known.mean() > 0.9
    assert (mac[known] == truth.mac[row][known]).all()
    assert set(mac[known].tolist()) == {mac_from_text(device_mac), OTHER_MAC}
    # Nothing comes before its time; how long after it single ones come says how busy the machine is.
    late_s = arrival_s - truth.t_s[row]
    assert -0.005 < late_s.min() < 0.5


async def test_plays_through_a_fifo_into_the_reader(tmp_path: Path) -> None:
    home = make_home(3, walks=1)
    radio = Radio(home, seed=3)
    path = tmp_path / "csi"
    sender = FifoSender(path)
    reader = FollowLog(path)
    queue: DropOldestQueue[CsiBatch] = DropOldestQueue(1000)
    reading = asyncio.create_task(reader.run(queue))
    await until(lambda: reader.health.state == "ok")
    start_ns = time.monotonic_ns() - round((home.join_s + 2.0) * 1e9)
    playing = asyncio.create_task(driver.run(radio, start_ns, sender))
    got = await collect(queue, 300)
    await stop(playing, reading)
    check_played(got, Radio(home, seed=3), home.device_mac, start_ns)
    assert not path.exists()


async def test_plays_through_the_kernel_connector() -> None:
    if not ConnectorSender.permitted():
        pytest.skip("multicast on NETLINK_CONNECTOR needs CAP_NET_ADMIN")
    home = make_home(4, walks=1)
    group = free_group()
    sender = ConnectorSender(group)
    receiver = Connector(group, allow_user_space=True)
    queue: DropOldestQueue[CsiBatch] = DropOldestQueue(1000)
    receiving = asyncio.create_task(receiver.run(queue))
    await until(lambda: receiver.health.state == "ok")
    start_ns = time.monotonic_ns() - round((home.join_s + 2.0) * 1e9)
    playing = asyncio.create_task(driver.run(Radio(home, seed=4), start_ns, sender))
    got = await collect(queue, 300)
    await stop(playing, receiving)
    check_played(got, Radio(home, seed=4), home.device_mac, start_ns)
    assert sender.health.counters["dropped_records"] == 0
    sender.send(RECORDS)  # closed: nothing happens


def test_connector_is_not_permitted_to_everybody() -> None:
    if os.geteuid() != 0:
        pytest.skip("only root can become somebody else")
    code = (
        "import os; from vad.sim.driver import ConnectorSender;"
        "os.setresuid(65534, 65534, 65534); print(ConnectorSender.permitted())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, timeout=50)
    assert done.stdout.strip() == b"False"


class SlowRadio:
    """Plays one empty frame a batch on a clock that only its own work moves."""

    def __init__(self, stall_at: int, stall_s: float) -> None:
        self.now_ns = 0
        self.spans: list[tuple[float, float]] = []
        self._stall_at, self._stall_s = stall_at, stall_s
        self._empty = Radio(make_home(0, walks=1), seed=0).generate(-2.0, -1.0)

    def generate(self, t0_s: float, t1_s: float) -> RadioBatch:
        self.spans.append((t0_s, t1_s))
        stalls = len(self.spans) == self._stall_at
        self.now_ns += round(1e9 * (self._stall_s if stalls else driver.BATCH_S / 2))
        return self._empty

    def log_bytes(self, batch: RadioBatch) -> list[tuple[float, bytes]]:
        t0_s, _ = self.spans[-1]
        return [(t0_s, record(0xC1, f"{t0_s:.6f}".encode()))]


class Counting:
    """A sender that keeps what it is given."""

    def __init__(self) -> None:
        self.health = Health("test")
        self.sent: list[bytes] = []
        self.closed = False

    def send(self, records: Sequence[bytes]) -> None:
        self.sent += records

    def close(self) -> None:
        self.closed = True


async def test_after_a_stall_no_burst_beyond_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    radio, sender = SlowRadio(stall_at=10, stall_s=1.0), Counting()

    def now() -> int:
        radio.now_ns += 2_000_000
        return radio.now_ns

    monkeypatch.setattr(driver, "time", SimpleNamespace(monotonic_ns=now))
    playing = asyncio.create_task(driver.run(radio, 0, sender))
    await until(lambda: len(radio.spans) > 40)
    await stop(playing)
    starts = np.array([a for a, _ in radio.spans])
    steps = np.diff(starts)
    assert (steps > driver.BATCH_S + 1e-9).sum() == 1  # one jump, over what is too late
    assert 0.8 < steps.max() < 1.1
    counters = sender.health.counters
    assert 700 < counters["skipped_ms"] < 1000
    assert counters["late_records"] >= 1
    sent = np.array([float(data[3:]) for data in sender.sent])
    assert (np.diff(sent) > 0).all()
    assert sender.closed
