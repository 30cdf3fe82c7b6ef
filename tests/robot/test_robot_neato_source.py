"""NeatoSource against the emulator on a real pty, over TCP and RFC 2217: poses, silence, unplugging."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import os
import socket
import threading
import time
import tty
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import pytest
import serial
import serial.rfc2217
from waiting import free_port, running, until

from vad.robot import serial_port
from vad.robot.neato_source import NeatoSource
from vad.robot.pose import RobotPose
from vad.sim.neato import Pose, VirtualNeato
from vad.streams import DropOldestQueue

Poses = DropOldestQueue[RobotPose]


def circle(t_ns: int) -> Pose:
    angle = t_ns / 1e9
    return 2 * math.cos(angle), 2 * math.sin(angle), math.remainder(angle + math.pi / 2, math.tau)


async def take(out: Poses, timeout_s: float = 40.0) -> RobotPose:
    async with asyncio.timeout(timeout_s):
        return await out.get()


@pytest.mark.usefixtures("patient")
async def test_poses_are_where_the_robot_was_at_their_time() -> None:
    robot = VirtualNeato(circle, latency_s=0.2)
    source = NeatoSource(robot.path, epoch=7)
    out: Poses = DropOldestQueue(64)
    async with running(robot.run(), source.run(out)):
        # At 2 m/s the start or the end of the exchange would be 0.2 m off or more, for every pose; the middle
        # is not where the way there took as long as the way back: a busy machine has such exchanges, too.
        poses = []
        while len(poses) < 4:
            pose = await take(out)
            if math.dist((pose.x_m, pose.y_m), circle(pose.t_ns)[:2]) < 0.1:
                poses.append(pose)
        assert source.health.state == "ok"
    for pose in poses:
        assert (pose.epoch, pose.quality, pose.sigma_m) == (7, "slam", 0.02)
        assert pose.sigma_yaw_rad == pytest.approx(math.radians(1))
        assert math.remainder(pose.yaw_rad - circle(pose.t_ns)[2], math.tau) == pytest.approx(0, abs=0.1)


@pytest.mark.usefixtures("patient")
async def test_not_localised_is_said_and_gives_no_pose() -> None:
    where: list[Pose | None] = [None]
    robot = VirtualNeato(lambda _t_ns: where[0])
    source = NeatoSource(robot.path, rate_hz=20.0, epoch=0)
    out: Poses = DropOldestQueue(8)
    async with running(robot.run(), source.run(out)):
        await until(lambda: source.health.counters["not_localised"] >= 2)
        assert source.health.state == "degraded"
        assert "not localised" in source.health.detail
        assert len(out) == 0
        where[0] = (1.0, 2.0, 0.5)
        assert (await take(out)).x_m == 1.0
        assert source.health.state == "ok"


class _NotedWaits(threading.Event):
    """How long it was to be waited for."""

    asked_s: ClassVar[list[float]] = []

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        self.asked_s.append(timeout)
        return super().wait(timeout)


@pytest.mark.usefixtures("patient")
async def test_unplugged_and_plugged_in_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.DEBUG, "vad.robot.serial_port")
    monkeypatch.setattr(_NotedWaits, "asked_s", [])
    noted = SimpleNamespace(Event=_NotedWaits, Thread=threading.Thread)
    monkeypatch.setattr(serial_port, "threading", noted)
    link = tmp_path / "ttyNEATO"
    first = VirtualNeato(circle, link=link)
    source = NeatoSource(str(link), epoch=0)
    out: Poses = DropOldestQueue(64)
    async with running(source.run(out)):
        async with running(first.run()):
            await take(out)
        assert not link.exists()
        # Long enough for the back-off to reach its end.
        await until(lambda: _count(caplog, "no such port") >= 5)
        assert source.health.state == "degraded"
        assert _count(caplog, "no such port", logging.WARNING) == 1
        out.drain()
        second = VirtualNeato(circle, link=link)
        async with running(second.run()):
            await take(out)
            assert source.health.state == "ok"
    waits_s = _NotedWaits.asked_s
    assert max(waits_s) == 1.0, "so soon after it is plugged in, at the latest, it is opened"
    assert waits_s[0] < 0.2, "and sooner where it was away for a moment"


def _count(caplog: pytest.LogCaptureFixture, text: str, level: int = logging.DEBUG) -> int:
    return sum(text in r.getMessage() and r.levelno >= level for r in caplog.records)


async def test_a_missing_port_is_no_hurry_and_names_the_remedy() -> None:
    source = NeatoSource("/dev/vad-no-such-port", epoch=0)
    async with running(source.run(DropOldestQueue(1))):
        await until(lambda: source.health.state == "degraded")
        assert "plugged in" in source.health.detail


async def test_a_wrong_url_is_told() -> None:
    source = NeatoSource("nonsense://there", epoch=0)
    async with running(source.run(DropOldestQueue(1))):
        await until(lambda: source.health.state == "degraded")
        assert "socket://host:port" in source.health.detail


async def test_a_port_in_use_is_told() -> None:
    robot = VirtualNeato(circle)
    other = serial.Serial(robot.path, exclusive=True)
    source = NeatoSource(robot.path, epoch=0)
    try:
        async with running(source.run(DropOldestQueue(1))):
            await until(lambda: source.health.state == "degraded")
            assert "Another program" in source.health.detail
    finally:
        other.close()
        robot.close()


@pytest.fixture
def raw_pty() -> Iterator[tuple[int, str]]:
    """A pty whose other side the test plays itself: master descriptor and path."""
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    yield master, os.ttyname(slave)
    os.close(master)
    os.close(slave)


@pytest.mark.parametrize(("noise", "hint"), [(b"", "no reply"), (b"\xf0\x1a\x0f", "baud rate")])
async def test_silence_is_noticed(raw_pty: tuple[int, str], noise: bytes, hint: str) -> None:
    master, path = raw_pty
    source = NeatoSource(path, epoch=0)
    async with running(source.run(DropOldestQueue(1))):

        def told() -> bool:
            # On and on: however late the line is listened to, there is something to hear.
            with contextlib.suppress(BlockingIOError):
                os.write(master, noise)
            return hint in source.health.detail

        await until(told)
        assert source.health.state == "degraded"


@pytest.mark.usefixtures("patient")
async def test_byte_at_a_time_with_garbage_between(raw_pty: tuple[int, str]) -> None:
    master, path = raw_pty
    source = NeatoSource(path, rate_hz=20.0, epoch=0)
    out: Poses = DropOldestQueue(8)
    reply = b"\xff\x00GetRobotPos Smooth\r\nRobot Smooth pose: X=1.5, Y=0.5, Theta=45.0, Time=3.0\r\n\x1a\x80"
    asked = bytearray()

    async def answer() -> None:
        while True:
            with contextlib.suppress(BlockingIOError):
                asked.extend(os.read(master, 100))
            while (end := asked.find(b"\n")) >= 0:
                del asked[: end + 1]
                for byte in reply:
                    os.write(master, bytes([byte]))
                    await asyncio.sleep(0)
            await asyncio.sleep(0.002)

    async with running(answer(), source.run(out)):
        for _ in range(5):
            assert (await take(out)).x_m == 1.5


class _Bridge:
    """A serial-to-TCP bridge in front of the robot, which can hang up on its clients."""

    def __init__(self, robot: VirtualNeato) -> None:
        self._robot = robot
        self._clients: set[asyncio.StreamWriter] = set()

    @contextlib.asynccontextmanager
    async def serving(self, port: int) -> AsyncIterator[None]:
        server = await asyncio.start_server(self._serve, "127.0.0.1", port)
        try:
            yield
        finally:
            server.close()
            for client in self._clients:
                client.transport.abort()
            await until(lambda: not self._clients)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._clients.add(writer)
        with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError):
            while True:
                command = (await reader.readuntil(b"\n")).decode().strip()
                writer.write(self._robot.reply_to(command, time.monotonic_ns()))
        writer.close()
        self._clients.discard(writer)


def threads(port: str) -> int:
    """How many threads speak on this port."""
    return sum(t.name == f"serial {port}" for t in threading.enumerate())


@pytest.mark.usefixtures("patient")
async def test_over_a_tcp_socket_and_again_after_the_bridge_restarts() -> None:
    robot = VirtualNeato(circle)
    bridge, port = _Bridge(robot), free_port()
    out: Poses = DropOldestQueue(8)
    try:
        async with bridge.serving(port):
            source = NeatoSource(f"socket://127.0.0.1:{port}", epoch=0)
            task = asyncio.create_task(source.run(out))
            await take(out)
        await until(lambda: source.health.state == "degraded")
        out.drain()
        async with bridge.serving(port):
            await take(out)
            assert threads(f"socket://127.0.0.1:{port}") == 1
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            assert threads(f"socket://127.0.0.1:{port}") == 0
    finally:
        robot.close()


@pytest.mark.usefixtures("patient")
@pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning")
async def test_over_rfc2217() -> None:
    robot = VirtualNeato(circle)
    listener = socket.create_server(("127.0.0.1", 0))
    url = f"rfc2217://127.0.0.1:{listener.getsockname()[1]}"
    server = threading.Thread(target=_serve_rfc2217, args=(listener, robot.path))
    server.start()
    source = NeatoSource(url, epoch=0)
    out: Poses = DropOldestQueue(8)
    try:
        async with running(robot.run(), source.run(out)):
            for _ in range(3):
                await take(out)
            assert threads(url) == 1
        assert threads(url) == 0
    finally:
        listener.shutdown(socket.SHUT_RDWR)  # who waits there for a client wakes
        listener.close()
        await until(lambda: not server.is_alive())


def _serve_rfc2217(listener: socket.socket, path: str) -> None:
    """A serial port server, one client after the other: one that had to wait too long comes again."""
    with contextlib.suppress(OSError):  # nobody listens any more
        while True:
            connection, _ = listener.accept()
            _serve_client(connection, path)


def _serve_client(connection: socket.socket, path: str) -> None:
    """One client, until it hangs up (pyserial's own server side)."""
    with connection, _WithoutModemLines(path, timeout=0) as port:
        connection.settimeout(0.005)
        write = _Writer(connection)
        manager = serial.rfc2217.PortManager(port, write)
        data: bytes | None = None
        with contextlib.suppress(OSError):  # the client has hung up, or the robot is gone
            while data != b"":
                try:
                    data = connection.recv(1024)
                except TimeoutError:
                    data = None
                if data:
                    port.write(b"".join(manager.filter(data)))
                if answer := port.read(1024):
                    write.write(b"".join(manager.escape(answer)))


class _WithoutModemLines(serial.Serial):
    """A pty has none; the port server asks for them."""

    cts = dsr = ri = cd = property(lambda _self: False)
    dtr = rts = property(lambda _self: False, lambda _self, _value: None)


class _Writer:
    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection

    def write(self, data: bytes) -> None:
        with contextlib.suppress(OSError):
            self._connection.sendall(data)


@pytest.mark.usefixtures("patient")
async def test_cancelling_ends_the_thread_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """It waits for hours then, for a line that says nothing: only the end itself can wake it."""
    monkeypatch.setattr(serial_port, "LONGEST_WAIT_S", 10_000.0)
    robot = VirtualNeato(circle)
    source = NeatoSource(robot.path, rate_hz=0.0001, epoch=0)
    out: Poses = DropOldestQueue(8)
    async with running(robot.run()):
        async with running(source.run(out)):
            await take(out)
            assert threads(robot.path) == 1
        assert threads(robot.path) == 0
