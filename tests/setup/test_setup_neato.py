"""Asking a serial port for a Neato."""

from __future__ import annotations

import asyncio
import os
import pty
import tty
from pathlib import Path

import pytest

from vad.robot.neato import NeatoReply
from vad.setup.neato import NeatoVersion, ask_version, version_of
from vad.sim.neato import VirtualNeato


async def test_a_neato_tells_its_model_and_is_only_asked_for_its_version() -> None:
    robot = VirtualNeato(lambda _t_ns: None)
    task = asyncio.create_task(robot.run())
    try:
        assert await asyncio.to_thread(ask_version, robot.path, 40.0) == NeatoVersion("BotVacD5", "4.5.3")
        assert robot.answered <= 2  # the empty line, and the question
    finally:
        task.cancel()
        await asyncio.wait({task})


async def test_something_else_on_the_line_is_no_neato() -> None:
    master, slave = pty.openpty()
    tty.setraw(slave)
    asked = bytearray()
    try:
        os.set_blocking(master, False)
        os.write(master, b"ok\r\n\x1a\xff\x00" * 20)
        assert await asyncio.to_thread(ask_version, os.ttyname(slave), 0.3) == "no Neato answers"
        asked += os.read(master, 4096)
    finally:
        os.close(master)
        os.close(slave)
    assert asked == b"\nGetVersion\n"


def test_a_port_that_is_not_there(tmp_path: Path) -> None:
    told = ask_version(str(tmp_path / "ttyACM0"), 0.1)
    assert isinstance(told, str)
    assert "cannot be opened" in told


@pytest.mark.parametrize(
    ("lines", "version"),
    [
        (
            ("GetVersion", "Component,Major,Minor,Build", "ModelID,-1,XV11,", "Software,2,6,15295"),
            ("XV11", "2.6.15295"),
        ),
        (("GetVersion", "Component,Major,Minor,Build", "LDS Software,V1.0.0,,"), ("", "")),
    ],
)
def test_versions_of_other_models(lines: tuple[str, ...], version: tuple[str, str]) -> None:
    assert version_of(NeatoReply(lines)) == NeatoVersion(*version)


def test_an_unknown_command_is_no_version() -> None:
    assert version_of(NeatoReply(("GetVersion", "Unknown Cmd: 'GetVersion'"))) is None
