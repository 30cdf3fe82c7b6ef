"""The V4L2 adapter with a capture device that answers as OpenCV's does: stamps, unplug, replug, the end."""

from __future__ import annotations

import asyncio
import itertools
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from camera_world import running
from waiting import until

from vad.camera.frame import FrameQueue
from vad.camera.opencv_capture import BAD_IN_A_ROW
from vad.camera.v4l2 import V4l2Camera, V4l2Settings, open_v4l2
from vad.errors import SourceError


class Device:
    """A camera on the bus that can be unplugged; one `Handle` per opening, as cv2.VideoCapture is one."""

    def __init__(self, stamp_ms: Callable[[], float]) -> None:
        self.stamp_ms = stamp_ms
        self.plugged = threading.Event()
        self.plugged.set()
        self.settings: list[tuple[int, float]] = []
        self.open_handles = 0
        self.decoded = 0
        self.is_damaged: Callable[[int], bool] = lambda number: False

    def open(self, device: str) -> Handle:
        if not self.plugged.is_set():
            raise SourceError("there is no such camera", where=device)
        self.open_handles += 1
        return Handle(self)


class Handle:
    def __init__(self, device: Device) -> None:
        self.device = device
        self.tick = threading.Event()
        self.stamp_ms = 0.0

    def isOpened(self) -> bool:  # noqa: N802
        return True

    def grab(self) -> bool:
        self.tick.wait(0.005)
        # As a driver's: from before the picture is handed over, however late its time is asked for.
        self.stamp_ms = self.device.stamp_ms()
        return self.device.plugged.is_set()

    def retrieve(self) -> tuple[bool, Any]:
        self.device.decoded += 1
        if self.device.is_damaged(self.device.decoded):
            return False, None
        return True, np.full((48, 64, 3), 9, np.uint8)

    def get(self, prop: int, /) -> float:
        if prop == cv2.CAP_PROP_FOURCC:
            return float(cv2.VideoWriter.fourcc(*"YUYV"))
        assert prop == cv2.CAP_PROP_POS_MSEC
        return self.stamp_ms

    def set(self, prop: int, value: float, /) -> bool:
        self.device.settings.append((prop, value))
        return True

    def release(self) -> None:
        self.device.open_handles -= 1


def monotonic_ms() -> float:
    return time.monotonic_ns() * 1e-6


async def test_driver_stamps_unplug_and_replug() -> None:
    device = Device(lambda: monotonic_ms() - 30.0)
    camera = V4l2Camera(V4l2Settings("/dev/video9", 64, 48, 30.0), opener=device.open)
    out = FrameQueue(1000)
    before_ns = time.monotonic_ns()
    task = asyncio.create_task(camera.run(out))
    await until(lambda: len(out) >= 3)
    frame = out.drain()[-1]
    assert before_ns - 30_000_000 <= frame.t_ns < time.monotonic_ns() - 25_000_000
    assert camera.health.detail == "64x48 YUYV, stamps: driver"
    assert device.settings[0] == (cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))
    assert (cv2.CAP_PROP_FRAME_WIDTH, 64) in device.settings
    device.plugged.clear()
    await until(lambda: camera.health.state == "degraded")
    await until(lambda: "no such camera" in camera.health.detail)
    out.drain()
    device.plugged.set()
    await until(lambda: len(out) >= 3)
    assert camera.health.state == "ok"
    assert camera.health.counters["reopens"] >= 1
    seqs = [f.seq for f in out.drain()]
    assert seqs == sorted(set(seqs))
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    # It waits for its thread for a second at most; on a busy machine that ends a little later.
    await until(lambda: not [t for t in threading.enumerate() if t.name.startswith("v4l2")])
    assert device.open_handles == 0


@pytest.mark.parametrize("stamp_ms", [0.0, 12345.0, 1e15, -1.0])
async def test_stamps_of_another_clock_are_replaced_by_the_arrival(stamp_ms: float) -> None:
    device = Device(lambda: stamp_ms if stamp_ms != 12345.0 else monotonic_ms() - 60_000.0)
    camera = V4l2Camera(V4l2Settings("/dev/video9"), opener=device.open)
    out = FrameQueue(10)
    before_ns = time.monotonic_ns()
    task = asyncio.create_task(camera.run(out))
    async with asyncio.timeout(40.0):
        frame = await out.get()
    assert before_ns <= frame.t_ns <= time.monotonic_ns()
    assert camera.health.counters["arrival_stamps"] >= 1
    assert camera.health.detail.endswith("arrival")
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


async def test_a_trusted_driver_is_believed_when_its_pictures_come_late() -> None:
    # The first is nearly as late as a stranger's may be; as its buffers fill, each of the next is later by
    # some ms.
    first_ms, pictures = 0.0, 0

    def stamp_ms() -> float:
        nonlocal first_ms, pictures
        first_ms = first_ms or monotonic_ms() - 1200.0
        pictures += 1
        return first_ms + 0.1 * pictures

    device = Device(stamp_ms)
    camera = V4l2Camera(V4l2Settings("/dev/video9"), opener=device.open)
    out = FrameQueue(1000)
    task = asyncio.create_task(camera.run(out))
    await until(lambda: time.monotonic_ns() - out.drain()[-1].t_ns > 2_200_000_000 if len(out) else False)
    await until(lambda: camera.health.counters["frames"] >= 3)
    assert camera.health.counters["arrival_stamps"] == 0
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


async def test_only_what_is_wanted_is_decoded() -> None:
    # A picture every 5 ms by the driver's stamps, whenever it comes: it takes longer, never less.
    first_ms, pictures = monotonic_ms(), itertools.count()
    device = Device(lambda: first_ms + 5.0 * next(pictures))
    out = FrameQueue(1000)
    out.step_ns = 50_000_000
    camera = V4l2Camera(V4l2Settings("/dev/video9"), opener=device.open)
    task = asyncio.create_task(camera.run(out))
    await until(lambda: len(out) >= 6)
    # The camera goes on meanwhile: what is decoded now is in the queue a little later.
    decoded = device.decoded
    await until(lambda: len(out) >= decoded, "every decoded picture is a wanted one")
    times = [frame.t_ns for frame in out.drain()]
    assert min(b - a for a, b in itertools.pairwise(times)) >= out.step_ns
    assert camera.health.counters["unwanted"] > len(times)
    out.step_ns = 0
    await until(lambda: len(out) >= 6)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


async def test_damaged_pictures_are_left_out_and_said_once(caplog: pytest.LogCaptureFixture) -> None:
    device = Device(monotonic_ms)
    device.is_damaged = lambda number: number % 3 > 0
    camera = V4l2Camera(V4l2Settings("/dev/video9"), opener=device.open)
    async with running(camera) as out:
        await until(lambda: len(out) >= 5)
        counters = camera.health.counters
        assert counters["bad_pictures"] == 2 * counters["frames"]
        assert (camera.health.state, counters["reopens"]) == ("ok", 0)
    assert [r.levelname for r in caplog.records].count("WARNING") == 1


async def test_a_camera_whose_pictures_are_all_damaged_is_opened_anew() -> None:
    device = Device(monotonic_ms)
    device.is_damaged = lambda number: number <= BAD_IN_A_ROW
    camera = V4l2Camera(V4l2Settings("/dev/video9"), opener=device.open)
    async with running(camera) as out:
        await until(lambda: "cannot be decoded" in camera.health.last_error)
        await until(lambda: len(out))
        assert camera.health.state == "ok"
    assert device.open_handles == 0


async def test_absent_device_is_trouble_not_the_end(tmp_path: Path) -> None:
    camera = V4l2Camera(V4l2Settings(str(tmp_path / "video0")))
    task = asyncio.create_task(camera.run(FrameQueue(1)))
    await until(lambda: camera.health.state == "degraded")
    assert "no such camera" in camera.health.detail
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


def test_a_file_is_no_camera(tmp_path: Path) -> None:
    path = tmp_path / "video0"
    path.write_bytes(b"")
    capture = open_v4l2(str(path))
    assert not capture.isOpened()
    capture.release()


def test_pixel_format_has_four_letters() -> None:
    with pytest.raises(ValueError, match="four"):
        V4l2Camera(V4l2Settings("/dev/video0", fourcc="MJPEG"))
