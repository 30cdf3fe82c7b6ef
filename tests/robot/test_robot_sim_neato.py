"""VirtualNeato: byte for byte like the robot, and a port that outlives its clients."""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import tty
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest
from waiting import until

from vad.sim.neato import VirtualNeato


@contextlib.asynccontextmanager
async def running(robot: VirtualNeato) -> AsyncIterator[None]:
    task = asyncio.create_task(robot.run())
    try:
        yield
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


@pytest.fixture
def robot() -> Iterator[VirtualNeato]:
    made = VirtualNeato(lambda _t_ns: (1.0, -2.0, -math.pi / 2))
    yield made
    made.close()


async def ask(path: str, data: bytes, replies: int) -> bytes:
    """What comes until `replies` replies have ended, over a client's own descriptor."""
    client = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    tty.setraw(client)
    loop = asyncio.get_running_loop()
    got = bytearray()
    ended = asyncio.Event()

    def readable() -> None:
        got.extend(os.read(client, 4096))
        if got.count(b"\x1a") >= replies:
            ended.set()

    loop.add_reader(client, readable)
    try:
        for byte in data:
            os.write(client, bytes([byte]))
        async with asyncio.timeout(40.0):
            await ended.wait()
    finally:
        loop.remove_reader(client)
        os.close(client)
    return bytes(got)


def test_the_real_bytes(shared_data: Path) -> None:
    real = (shared_data / "robots/neato/getrobotpos_smooth_real_line.txt").read_bytes()
    robot = VirtualNeato(lambda _t_ns: (0.105, -0.0004, math.radians(359.999)))
    assert robot.reply_to("GetRobotPos Smooth", 145_559_850_836_000) == real
    robot.close()


def test_not_localised_is_zeros() -> None:
    robot = VirtualNeato(lambda _t_ns: None)
    line = b"Robot Smooth pose: X=0.000, Y=0.000, Theta=0.000, Time=1.500000\r\n\x1a"
    assert robot.reply_to("GetRobotPos Smooth", 1_500_000_000) == b"GetRobotPos Smooth\r\n" + line
    robot.close()


@pytest.mark.parametrize("command", ["getrobotpos smooth", "GetRobot Sm", "GETR S"])
def test_case_and_abbreviations(robot: VirtualNeato, command: str) -> None:
    assert b"X=1.000, Y=-2.000, Theta=270.000" in robot.reply_to(command, 0)


@pytest.mark.parametrize("command", ["GetRobotPos", "GetCharger", "G S", "GetRobotPos Smooth now", ""])
def test_unknown_commands(robot: VirtualNeato, command: str) -> None:
    expected = f"{command}\r\nUnknown Cmd: '{command}'\r\n\x1a"
    assert robot.reply_to(command, 0) == expected.encode()


async def test_clients_come_and_go(robot: VirtualNeato) -> None:
    async with running(robot):
        for _ in range(3):
            got = await ask(robot.path, b"GetRobotPos Smooth\nDance\r\n", replies=2)
            assert got.startswith(b"GetRobotPos Smooth\r\nRobot Smooth pose: X=1.000")
            assert got.endswith(b"Dance\r\nUnknown Cmd: 'Dance'\r\n\x1a")
    assert robot.answered == 6


async def test_the_link_follows_the_port(tmp_path: Path) -> None:
    link = tmp_path / "tty"
    for _ in range(2):
        robot = VirtualNeato(lambda _t_ns: None, link=link)
        async with running(robot):
            assert robot.path == str(link)
            await ask(robot.path, b"GetRobotPos Smooth\n", replies=1)
        assert not link.is_symlink()


async def test_nobody_reads(robot: VirtualNeato) -> None:
    """A full line loses replies instead of holding the robot up."""
    async with running(robot):
        client = os.open(robot.path, os.O_RDWR | os.O_NOCTTY)
        for _ in range(20):
            os.write(client, b"GetRobotPos Smooth\n" * 10)
            await asyncio.sleep(0)
        await until(lambda: robot.answered >= 200)
        os.close(client)
