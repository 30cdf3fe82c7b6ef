"""What live sources make of the bytes they read."""

from __future__ import annotations

import numpy as np
import pytest

from vad.csi.bfee import encode_bodies
from vad.csi.intake import Intake
from vad.csi.logfile import record
from vad.health import Health

BASE_NS = 10**12


def log_of(nic_us: list[int]) -> bytes:
    csi = np.ones((len(nic_us), 30, 1, 1, 2), np.int8)
    return b"".join(record(0xBB, b) for b in encode_bodies(csi, nic_us=nic_us, bfee_count=0, rssi=(30, 0, 0)))


def test_a_counter_that_stands_still_is_said_once(caplog: pytest.LogCaptureFixture) -> None:
    health = Health("test")
    intake = Intake(health, None)
    times = []
    for k in range(1, 51):
        woken, drained = BASE_NS + 20_000_000 * k, BASE_NS + 20_000_000 * k + 15_000_000
        times += intake.feed(log_of([5] * 6), drained, woken).packets.arrival_ns.tolist()
    assert [r.levelname for r in caplog.records] == ["WARNING"]
    assert health.counters["still_packets"] == 49 * 6
    steps = np.diff(times[12:])
    assert steps.min() > 0
    assert steps.max() < 8_000_000
    assert times[-1] == BASE_NS + 20_000_000 * 50 + 15_000_000


def test_a_counter_that_counts_is_followed(caplog: pytest.LogCaptureFixture) -> None:
    health = Health("test")
    intake = Intake(health, None)
    for k in range(20):
        batch = intake.feed(
            log_of([20_000 * k, 20_000 * k + 7000]), BASE_NS + 20_000_000 * k + 8_000_000, None
        )
    assert np.diff(batch.packets.arrival_ns).tolist() == [7_000_000]
    assert health.counters["still_packets"] == 0
    assert not caplog.records


def test_the_pieces_of_a_record_wait_for_each_other() -> None:
    health = Health("test")
    intake = Intake(health, None)
    log = log_of([1, 2])
    assert not intake.feed(log[:50], BASE_NS, None).raw
    assert len(intake.feed(log[50:], BASE_NS, None).packets) == 2
    intake.feed(log[:50], BASE_NS, None)
    intake.restart()
    assert len(intake.feed(log, BASE_NS, None).packets) == 2
    assert health.counters["packets"] == 4
