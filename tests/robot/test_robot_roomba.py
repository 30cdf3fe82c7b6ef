"""Roomba: the stream through wraps, damage and cuts; odometry; the source on a real pty."""

from __future__ import annotations

import asyncio
import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from waiting import running, until

from vad.robot.pose import RobotPose
from vad.robot.roomba import (
    AXLE_M,
    MAX_FRAME_BYTES,
    TICK_M,
    Odometry,
    RoombaReading,
    StreamDialogue,
    WheelOdometry,
)
from vad.robot.roomba_source import RoombaSource
from vad.sim.roomba import RoombaBody, VirtualRoomba
from vad.streams import DropOldestQueue

MS = 1_000_000


def framed(*content: int) -> bytes:
    frame = bytes([19, len(content), *content])
    return frame + bytes([-sum(frame) % 256])


def wheels(left: int, right: int, drops: int = 0, dock: int = 0) -> bytes:
    counts = [43, left >> 8, left & 255, 44, right >> 8, right & 255]
    return framed(7, drops, 34, dock, *counts)


def test_the_documented_frame_is_read() -> None:
    dialogue = StreamDialogue()
    (reading,) = dialogue.receive(framed(43, 0x12, 0x34, 44, 0xFF, 0xFE), 5)
    assert reading == RoombaReading(5, 0x1234, 0xFFFE, lifted=False, docked=False)
    assert dialogue.to_send(5) == b""
    assert StreamDialogue().to_send(0) == bytes([128, 148, 4, 7, 34, 43, 44])


def test_it_asks_again_while_nothing_comes() -> None:
    dialogue = StreamDialogue()
    assert dialogue.to_send(0)
    assert not dialogue.to_send(500 * MS)
    assert dialogue.to_send(1000 * MS)
    dialogue.receive(wheels(1, 2), 1900 * MS)
    assert not dialogue.to_send(2500 * MS)


@settings(max_examples=150, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 65_535), st.integers(0, 65_535)), min_size=1, max_size=12),
    st.binary(max_size=30).filter(lambda noise: 19 not in noise),
    st.data(),
)
def test_frames_come_out_whole_however_they_are_cut(
    counts: list[tuple[int, int]], noise: bytes, data: st.DataObject
) -> None:
    stream = noise + b"".join(wheels(*pair) for pair in counts)
    dialogue, found, at = StreamDialogue(), [], 0
    while at < len(stream):
        step = data.draw(st.integers(1, 20))
        found += dialogue.receive(stream[at : at + step], at)
        at += step
    assert [(r.left, r.right) for r in found] == counts
    assert dialogue.bad == 0


@settings(max_examples=150, deadline=None)
@given(st.binary(max_size=200), st.binary(max_size=200))
def test_any_noise_ends_and_good_frames_are_found_again(before: bytes, after: bytes) -> None:
    dialogue = StreamDialogue()
    dialogue.receive(before, 0)
    # The longest false frame may swallow what it covers, no more.
    good = [wheels(k, 1000 + k) for k in range(1 + MAX_FRAME_BYTES // 13 + 4)]
    found = dialogue.receive(b"".join(good) + after, 0)
    assert len([r for r in found if r.right == 1000 + r.left]) >= 4


@given(st.integers(0, 12), st.integers(1, 255))
def test_a_wrong_byte_is_never_a_reading(at: int, change: int) -> None:
    frame = bytearray(wheels(300, 400))
    frame[at] = (frame[at] + change) % 256
    assert StreamDialogue().receive(bytes(frame), 0) == []


def drive(odometry: WheelOdometry, path: list[tuple[float, float]], start: tuple[int, int]) -> None:
    """Wheel distances in metres since the beginning, 15 ms apart."""
    for k, (left_m, right_m) in enumerate(path):
        left, right = (round(m / TICK_M) + s for m, s in zip((left_m, right_m), start, strict=True))
        odometry.update(RoombaReading(k * 15 * MS, left % 65_536, right % 65_536, False, False))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 65_535), st.integers(0, 65_535))
def test_a_circle_closes_wherever_the_counters_wrap(left: int, right: int) -> None:
    odometry = WheelOdometry()
    angles = np.linspace(0, 2 * math.pi, 1500)
    path = [(a * (1.0 - AXLE_M / 2), a * (1.0 + AXLE_M / 2)) for a in angles.tolist()]
    drive(odometry, path, (left, right))
    place = odometry.place
    assert not odometry.lost
    assert math.hypot(place.x_m, place.y_m) < 0.01
    assert abs(place.yaw_rad) < 0.01
    assert place.sigma_m > 0.1


def test_driving_far_wraps_many_times() -> None:
    odometry = WheelOdometry()
    drive(odometry, [(0.007 * k, 0.007 * k) for k in range(12_000)], (65_000, 12))
    assert odometry.place.x_m == pytest.approx(0.007 * 11_999, abs=0.01)
    assert odometry.place.y_m == pytest.approx(0, abs=0.05)


def test_a_restarted_robot_is_lost_and_its_dock_finds_it() -> None:
    odometry = WheelOdometry()
    odometry.update(RoombaReading(0, 0, 0, False, True))
    odometry.update(RoombaReading(15 * MS, 20, 20, False, False))
    odometry.update(RoombaReading(30 * MS, 30_000, 0, False, False))
    assert odometry.lost
    odometry.update(RoombaReading(45 * MS, 30_000, 0, False, True))
    assert not odometry.lost
    assert odometry.place == Odometry()


async def take(out: DropOldestQueue[RobotPose]) -> RobotPose:
    async with asyncio.timeout(40):
        return await out.get()


@pytest.mark.usefixtures("patient")
async def test_over_a_pty_with_a_bad_line_lifted_and_unplugged(tmp_path: Path) -> None:
    numbers = itertools.count()

    def spoil(frame: bytes) -> bytes:
        """Every third frame has a wrong byte, every fifth is cut."""
        number = next(numbers)
        if number % 5 == 4:
            return frame[:7]
        return frame[:6] + bytes([frame[6] ^ 0x10]) + frame[7:] if number % 3 == 2 else frame

    link = tmp_path / "ttyROOMBA"
    body = RoombaBody(left=65_500, right=65_500, docked=True)
    source = RoombaSource(str(link), epoch=6)
    out: DropOldestQueue[RobotPose] = DropOldestQueue(256)
    async with running(source.run(out)):
        async with running(VirtualRoomba(body, link=link, line=spoil).run()):
            first = await take(out)
            assert (first.quality, first.frame, first.status, first.epoch) == (
                "odometry",
                "odom",
                "docked",
                6,
            )
            body.docked = False
            for _ in range(40):
                body.left, body.right = body.left + 10, body.right + 10
                await asyncio.sleep(0.01)
            # What was on the line before its last step comes first.
            arrived = pytest.approx(400 * TICK_M, abs=1e-6)
            await until(lambda: any(pose.x_m == arrived for pose in out.drain()))
            assert source.status == "localised"
            await until(lambda: source.health.counters["bad_input"] > 3)
            assert "drifts" in source.health.detail
            body.lifted = True
            await until(lambda: source.status == "lifted")
            body.lifted = False
            await until(lambda: source.status == "lost")
            assert "dock" in source.health.detail
            out.drain()
            body.docked = True
            assert (await take(out)).x_m == 0.0
        await until(lambda: source.health.state == "degraded")
        out.drain()
        async with running(VirtualRoomba(body, link=link).run()):
            assert (await take(out)).x_m == 0.0
