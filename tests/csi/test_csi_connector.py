"""The connector source against the kernel's own NETLINK_CONNECTOR."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator

import numpy as np
import pytest
from csi_tools import bodies, running
from waiting import free_group, until

from vad.csi import cn
from vad.csi.connector import Connector
from vad.csi.dot11 import data_frame
from vad.csi.logfile import record
from vad.csi.select import join_packets
from vad.errors import ProtocolError
from vad.mac import UNKNOWN_MAC

AP, STATION = 0x02_00_00_00_00_FF, 0x02_00_00_00_00_01


class Sender:
    """Multicasts to a group of the connector from this process."""

    def __init__(self, sock: socket.socket, group: int) -> None:
        self.sock = sock
        self.group = group

    def send(self, message: bytes) -> None:
        self.sock.sendto(message, (0, 1 << self.group - 1))

    def record(self, code: int, body: bytes) -> None:
        self.send(cn.build_message(code, body, group=self.group))


@pytest.fixture(scope="module")
def group() -> int:
    """Test processes and simulated homes on one kernel must not hear each other: a group each."""
    return free_group()


@pytest.fixture
def sender(group: int) -> Iterator[Sender]:
    try:
        sock = socket.socket(socket.AF_NETLINK, socket.SOCK_DGRAM, cn.NETLINK_CONNECTOR)
    except OSError as error:
        pytest.skip(f"no NETLINK_CONNECTOR here: {error}")
    with sock:
        sock.bind((0, 0))
        try:
            sock.setsockopt(cn.SOL_NETLINK, cn.NETLINK_ADD_MEMBERSHIP, group)
            sock.setsockopt(cn.SOL_NETLINK, 2, group)  # NETLINK_DROP_MEMBERSHIP
            sock.sendto(cn.build_message(0, b"", group=group), (0, 1 << group - 1))
        except PermissionError:
            pytest.skip("joining and sending to connector groups needs CAP_NET_ADMIN")
        yield Sender(sock, group)


async def test_records_arrive_byte_for_byte_and_attributed(sender: Sender) -> None:
    source = Connector(sender.group, allow_user_space=True)
    async with running(source) as out:
        log = b""
        for i, body in enumerate(bodies(300)):
            for code, content in ((0xC1, data_frame(STATION, AP, AP, i, bytes(1500))), (0xBB, body)):
                sender.record(code, content)
                log += record(code, content)
        await until(lambda: source.health.counters["messages"] >= 600)
    batches = out.drain()
    assert b"".join(b.raw for b in batches) == log
    packets = join_packets([b.packets for b in batches])
    assert packets.bfee_count.tolist() == list(range(300))
    assert set(packets.mac.tolist()) - {STATION} <= {UNKNOWN_MAC}
    assert (packets.mac == UNKNOWN_MAC).sum() <= 1  # the first, after the socket was opened
    assert source.health.counters["dropped"] == 0


async def test_arrival_times_follow_the_nic_not_the_drain(sender: Sender) -> None:
    source = Connector(sender.group, allow_user_space=True)
    async with running(source) as out:
        before = time.monotonic_ns()
        for body in bodies(50):
            sender.record(0xBB, body)
        await until(lambda: source.health.counters["packets"] >= 50)
        after = time.monotonic_ns()
    arrival = join_packets([b.packets for b in out.drain()]).arrival_ns
    assert before - 50_000_000 < arrival[0] <= arrival[-1] < after + 50_000_000
    assert np.abs(np.diff(arrival) - 1_000_000).max() <= 11_000  # the slew


async def test_an_overrun_is_counted_exactly_and_makes_the_sender_unknown(sender: Sender) -> None:
    source = Connector(sender.group, allow_user_space=True, receive_buffer_bytes=40_000)
    async with running(source) as out:
        sent = 0
        # Sent while the event loop stands still: nobody drains.
        for i, body in enumerate(bodies(400)):
            sender.record(0xC1, data_frame(STATION, AP, AP, i))
            sender.record(0xBB, body)
            sent += 2
        await until(lambda: source.health.counters["dropped"] > 0)
        assert source.health.state == "degraded"
        for i, body in enumerate(bodies(3, first=400)):
            sender.record(0xC1, data_frame(STATION, AP, AP, i))
            sender.record(0xBB, body)
            sent += 2
        counters = source.health.counters
        await until(lambda: counters["messages"] + counters["dropped"] >= sent)
    assert counters["overruns"] >= 1
    assert counters["messages"] + counters["dropped"] == sent
    packets = join_packets([b.packets for b in out.drain()])
    assert packets.bfee_count[-3:].tolist() == [400, 401, 402]
    assert packets.mac[-3:].tolist() == [UNKNOWN_MAC, STATION, STATION]


async def test_a_burst_while_the_loop_stands_still_is_kept(sender: Sender) -> None:
    source = Connector(sender.group, allow_user_space=True)
    async with running(source) as out:
        for body in bodies(3000):
            sender.record(0xBB, body)
        await until(lambda: source.health.counters["packets"] >= 3000)
    assert source.health.counters["dropped"] == 0
    assert join_packets([b.packets for b in out.drain()]).bfee_count.tolist() == list(range(3000))


async def test_processes_are_refused_by_default(sender: Sender, caplog: pytest.LogCaptureFixture) -> None:
    source = Connector(sender.group)
    async with running(source) as out:
        for body in bodies(20):
            sender.record(0xBB, body)
        await until(lambda: source.health.counters["user_space"] >= 20)
    assert len(out) == 0
    assert source.health.state == "degraded"
    assert [r.levelname for r in caplog.records].count("WARNING") == 1


async def test_messages_that_lie_are_refused(sender: Sender, caplog: pytest.LogCaptureFixture) -> None:
    good = cn.build_message(0xBB, bodies(1)[0], group=sender.group)
    longer = bytearray(good)
    longer[32:34] = (len(good)).to_bytes(2, "little")
    empty = bytearray(good)
    empty[32:34] = bytes(2)
    source = Connector(sender.group, allow_user_space=True)
    async with running(source) as out:
        for message in (
            cn.build_message(0xBB, b"x", group=sender.group, value=2),
            longer,
            empty,
            good[:36],
            good,
        ):
            sender.send(bytes(message))
        await until(lambda: source.health.counters["messages"] >= 5)
    counters = source.health.counters
    assert (counters["packets"], counters["foreign message"], counters["short message"]) == (1, 1, 1)
    assert counters["message length that lies"] == 2
    assert len(out) == 1
    assert [r.levelname for r in caplog.records].count("WARNING") == 3


def test_message_round_trip() -> None:
    message = cn.build_message(0xBB, b"body")
    assert len(message) == 41
    assert cn.payload_bytes(message, len(message), 26, 1) == 5
    assert message[cn.HEADER_BYTES :] == b"\xbbbody"
    with pytest.raises(ProtocolError):
        cn.payload_bytes(message, len(message), 25, 1)
    with pytest.raises(ProtocolError):
        cn.payload_bytes(message, 40, 26, 1)
