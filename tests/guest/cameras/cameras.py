"""In the guest: vad's camera adapters against the kernel's own drivers; what they saw goes to report.json."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from pictures import number

from vad.camera.frame import CameraSource, Frame, FrameQueue
from vad.camera.kinect2_source import Kinect2Camera
from vad.camera.v4l2 import V4l2Camera, V4l2Settings

HERE = Path(__file__).parent
FRAMES = 12
PATIENCE_S = 240.0  # an emulated processor on a busy host


async def until(condition: Callable[[], bool], what: Callable[[], str]) -> None:
    try:
        async with asyncio.timeout(PATIENCE_S):
            while not condition():  # noqa: ASYNC110
                await asyncio.sleep(0.01)
    except TimeoutError:
        raise SystemExit(f"never came: {what()}") from None


class Emulator:
    """devices.py in a process of its own."""

    def __init__(self, kind: str) -> None:
        command = [sys.executable, "-B", str(HERE / "devices.py"), kind]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._answer()

    def tell(self, word: str) -> dict[str, Any]:
        assert self._process.stdin is not None
        self._process.stdin.write(word + "\n")
        self._process.stdin.flush()
        return self._answer()

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        answer: dict[str, Any] = json.loads(self._process.stdout.readline())
        return answer

    def end(self) -> None:
        self._process.terminate()
        self._process.wait()


def seen(frames: list[Frame], arrivals_ns: dict[int, int]) -> dict[str, Any]:
    """What a test can judge of some frames in a row."""
    times = np.array([f.t_ns for f in frames])
    return {
        "frames": len(frames),
        "shape": list(frames[-1].image.shape),
        "seqs": [f.seq for f in frames],
        "numbers": [number(f.image) for f in frames],
        "t_ns": times.tolist(),
        "age_ms": [round(1e-6 * (arrivals_ns[f.seq] - f.t_ns), 2) for f in frames],
    }


class Watched(FrameQueue):
    """A queue that notes when each frame came."""

    def __init__(self) -> None:
        super().__init__(1000)
        self.arrivals_ns: dict[int, int] = {}

    def put(self, item: Frame) -> None:
        self.arrivals_ns[item.seq] = time.monotonic_ns()
        super().put(item)


async def watch(
    camera: CameraSource, unplug: Callable[[], object], replug: Callable[[], object]
) -> dict[str, Any]:
    """Frames, unplug, replug, frames, end."""
    out = Watched()
    task = asyncio.create_task(camera.run(out))
    await until(lambda: len(out) >= FRAMES, lambda: f"the first {FRAMES} frames ({camera.health})")
    before = seen(out.drain(), out.arrivals_ns)
    detail = camera.health.detail
    unplug()
    await until(lambda: camera.health.state == "degraded", lambda: "that the unplug is noticed")
    noticed = camera.health.detail
    out.drain()
    replug()
    await until(lambda: len(out) >= FRAMES, lambda: f"frames after the replug ({camera.health})")
    after = seen(out.drain(), out.arrivals_ns)
    state = camera.health.state
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    threads = [t.name for t in threading.enumerate() if t is not threading.main_thread()]
    return {
        "before": before, "after": after, "detail": detail, "noticed": noticed, "state": state,
        "counters": dict(camera.health.counters), "threads": threads,
    }  # fmt: skip


async def vivid() -> dict[str, Any]:
    """The kernel's test camera, YUYV; unbinding its driver is the unplug."""
    driver = Path("/sys/bus/platform/drivers/vivid")
    camera = V4l2Camera(V4l2Settings("/dev/video0", 640, 360, 15.0, fourcc="YUYV"))
    return await watch(
        camera,
        lambda: (driver / "unbind").write_text("vivid.0"),
        lambda: (driver / "bind").write_text("vivid.0"),
    )


async def uvc() -> dict[str, Any]:
    """uvcvideo, MJPG, by its lasting name."""
    emulator = Emulator("uvc")
    emulator.tell("plug")
    device = Path("/dev/v4l/by-id/usb-vad_emulated_camera_0001-video-index0")
    await until(device.exists, lambda: "the camera's name")
    camera = V4l2Camera(V4l2Settings(str(device), 640, 480, 10.0, fourcc="MJPG"))
    result = await watch(camera, lambda: emulator.tell("unplug"), lambda: emulator.tell("plug"))
    result |= emulator.tell("sent")
    emulator.end()
    return result


async def kinect() -> dict[str, Any]:
    """A Kinect v2 through the kernel's usbfs and libusb."""
    emulator = Emulator("kinect")
    emulator.tell("plug")
    camera = Kinect2Camera(fps=10.0)
    result = await watch(camera, lambda: emulator.tell("unplug"), lambda: emulator.tell("plug"))
    result |= emulator.tell("sent")
    emulator.end()
    return result


async def main() -> None:
    report = {}
    wanted = sys.argv[1:] or ["vivid", "uvc", "kinect"]
    for scenario in [s for s in (vivid, uvc, kinect) if s.__name__ in wanted]:
        start = time.monotonic()
        report[scenario.__name__] = await scenario()
        report[scenario.__name__]["took_s"] = round(time.monotonic() - start, 1)
        sys.stdout.write(f"{scenario.__name__}: {report[scenario.__name__]['took_s']} s\n")
        sys.stdout.flush()
        (HERE / "report.json").write_text(json.dumps(report))


asyncio.run(main())
