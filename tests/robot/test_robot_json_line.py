"""Lines of JSON with a checksum: the format, damage, and a real pty with a console on it."""

from __future__ import annotations

import asyncio
import contextlib
import os
import tty

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from waiting import until

from vad.robot.json_line import MAX_LINE_BYTES, JsonLineDialogue, json_line
from vad.robot.json_line_source import JsonLineSource
from vad.robot.pose import RobotPose
from vad.streams import DropOldestQueue

POSE = b'{"x_m": 1.2, "y_m": -0.4, "yaw_rad": 1.57}'


def read(data: bytes) -> tuple[list[object], int]:
    dialogue = JsonLineDialogue(2)
    return list(dialogue.receive(data, 7)), dialogue.bad


def test_the_documented_line() -> None:
    assert json_line(POSE) == POSE + b"*01DE\n"
    (pose,), bad = read(POSE + b"*01de \r\n")
    assert isinstance(pose, RobotPose)
    assert (pose.x_m, pose.y_m, pose.t_ns, pose.epoch, bad) == (1.2, -0.4, 7, 2, 0)


def test_a_robot_without_a_place_says_why() -> None:
    assert read(json_line(b'{"status": "lifted"}')) == (["lifted"], 0)
    (pose,), _ = read(json_line(POSE[:-1] + b', "status": "docked"}'))
    assert isinstance(pose, RobotPose)
    assert pose.status == "docked"
    assert read(json_line(b'{"status": "asleep"}')) == ([], 1)


def test_the_end_of_a_cut_line_does_no_harm() -> None:
    # What was sent before the port was opened is cut somewhere.
    found, bad = read(b'57}*0000\n{"x_m": 1' + json_line(POSE))
    assert len(found) <= 1
    assert bad >= 1
    assert len(read(b"\xff\x00boot: ok> " + json_line(POSE))[0]) == 1


@settings(max_examples=150, deadline=None)
@given(st.integers(0, len(json_line(POSE)) - 2), st.integers(1, 255))
def test_a_wrong_byte_is_never_a_pose(at: int, change: int) -> None:
    line = bytearray(json_line(POSE))
    line[at] ^= change
    found, _ = read(bytes(line))
    # The case of the checksum's digits does not count, and nothing else slips through.
    assert not found or bytes(line).lower() == json_line(POSE).lower()


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=300), st.lists(st.integers(1, 30), min_size=1, max_size=40))
def test_noise_ends_with_its_line(noise: bytes, steps: list[int]) -> None:
    stream = noise + b"\n" + json_line(POSE)
    dialogue = JsonLineDialogue(0)
    found: list[object] = []
    at = 0
    for step in [*steps, len(stream)]:
        found += dialogue.receive(stream[at : at + step], 0)
        at += step
    assert isinstance(found[-1], RobotPose)


def test_a_line_without_end_is_dropped() -> None:
    dialogue = JsonLineDialogue(0)
    for _ in range(100):
        assert dialogue.receive(b"x" * (MAX_LINE_BYTES // 2), 0) == []
    assert dialogue.bad == 1
    assert len(dialogue.receive(b"\n" + json_line(POSE), 0)) == 1


@pytest.mark.usefixtures("patient")
async def test_over_a_pty() -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    source = JsonLineSource(os.ttyname(slave), baud=57_600, epoch=0)
    out: DropOldestQueue[RobotPose] = DropOldestQueue(8)
    task = asyncio.create_task(source.run(out))
    try:
        await until(lambda: source.health.counters["opened"])
        os.write(master, b"hello\n" + json_line(POSE))
        async with asyncio.timeout(40):
            assert (await out.get()).x_m == 1.2
        assert source.status == "localised"
        os.write(master, json_line(b'{"status": "lost"}'))
        await until(lambda: source.status == "lost")
        assert "dock" in source.health.detail
        assert source.health.counters["bad_input"] == 1
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        os.close(master)
        os.close(slave)


def test_a_pose_without_a_place_is_refused() -> None:
    found, bad = read(json_line(b'{"status": "docked"}'))
    assert (found, bad) == ([], 1)
