"""A recorded log, played as the driver would."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

import numpy as np
import pytest

from vad.csi.bfee import encode_bodies
from vad.csi.dot11 import data_frame
from vad.csi.logfile import record
from vad.health import Health
from vad.sim import driver
from vad.sim.log_player import STILL_PACKETS_PER_S, LogPlayer

STATION, AP = 0x02_00_00_00_00_01, 0x02_00_00_00_00_FF


def log_of(nic_us: list[int]) -> list[bytes]:
    csi = np.ones((len(nic_us), 30, 3, 1, 2), np.int8)
    bodies = encode_bodies(csi, nic_us=nic_us, bfee_count=np.arange(len(nic_us)), rssi=(30, 31, 32))
    frame = record(0xC1, data_frame(STATION, AP, AP, 0))
    return [piece for body in bodies for piece in (frame, record(0xBB, body))]


class Listener:
    """A sender that notes what it gets and when, by a clock that moves only when it is read."""

    def __init__(self) -> None:
        self.now_ns = 0
        self.health = Health("test")
        self.got: list[tuple[int, bytes]] = []
        self.closed = False

    def send(self, records: Sequence[bytes]) -> None:
        self.got += [(self.now_ns, data) for data in records]

    def close(self) -> None:
        self.closed = True

    def monotonic_ns(self) -> int:
        self.now_ns += 2_000_000
        return self.now_ns


def test_records_keep_their_order_and_times() -> None:
    records = log_of([2**32 - 1000, 2**32 - 500, 1500])  # over the wrap
    player = LogPlayer(b"".join(records) + record(0xC1, b"after the last") + b"\0\x10\xbb")
    played = player.log_bytes(player.generate(0.0, 10.0))
    assert [data for _, data in played] == records
    assert [t for t, _ in played] == pytest.approx([0, 0, 0.0005, 0.0005, 0.0025, 0.0025], abs=1e-6)
    assert player.length_s == pytest.approx(0.0025, abs=1e-6)
    assert len(player.generate(0.0005 - 1e-9, 0.002)) == 2


def test_a_still_counter_is_played_at_a_fixed_rate() -> None:
    player = LogPlayer(b"".join(log_of([7] * 101)))
    assert player.length_s == pytest.approx(100 / STILL_PACKETS_PER_S)


@pytest.mark.parametrize("log", [b"", b"\0", record(0xC1, b"nothing else")])
def test_nothing_to_play(log: bytes) -> None:
    assert LogPlayer(log).generate(-1.0, 100.0) == []


@pytest.mark.parametrize("speed", [1.0, 10.0])
async def test_real_and_accelerated_time(speed: float, monkeypatch: pytest.MonkeyPatch) -> None:
    records = log_of([int(2000 * speed * k) for k in range(200)])  # 0.4 s of real time
    player, listener = LogPlayer(b"".join(records)), Listener()
    monkeypatch.setattr(driver, "time", listener)
    start_ns = 50_000_000
    async with asyncio.timeout(40):
        await driver.run(player, start_ns, listener, speed=speed, until_s=player.length_s + 0.001)
    assert [data for _, data in listener.got] == records
    assert listener.closed
    at_s = (np.array([t for t, _ in listener.got]) - start_ns) / 1e9
    due_s = np.repeat(np.arange(200) * 0.002, 2)
    assert (at_s >= due_s - 1e-6).all()
    assert (at_s - due_s).max() < 0.02


@pytest.mark.parametrize(("behind_ms", "counted"), [(60, False), (300, True)])
async def test_what_was_due_before_it_began_is_played_or_counted(
    monkeypatch: pytest.MonkeyPatch, behind_ms: int, counted: bool
) -> None:
    records = log_of([2000 * k for k in range(200)])
    player, listener = LogPlayer(b"".join(records)), Listener()
    monkeypatch.setattr(driver, "time", listener)
    start_ns, end_s = -behind_ms * 1_000_000, player.length_s + 0.001
    async with asyncio.timeout(40):
        await driver.run(player, start_ns, listener, from_s=0.0, until_s=end_s)
    assert (len(listener.got) < len(records)) == counted
    assert (listener.health.counters["skipped_ms"] > 0) == counted
