"""Local cameras through Video4Linux: one thread a camera, the driver's own stamps, reopened after unplug."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from vad.camera.frame import Frame
from vad.camera.stamps import is_plausible
from vad.errors import SourceError
from vad.health import Health
from vad.streams import DropOldestQueue

log = logging.getLogger(__name__)

BACKOFF_FIRST_S = 0.5
BACKOFF_MAX_S = 5.0
# The thread ends within one frame or this; OpenCV's own 10 s would hold up the end of the daemon.
_SELECT_TIMEOUT_S = 1
_SELECT_TIMEOUT_VARIABLE = "OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT"


class Capture(Protocol):
    """What is used of cv2.VideoCapture."""

    def isOpened(self) -> bool: ...  # noqa: N802
    def read(self) -> tuple[bool, Any]: ...
    def get(self, prop: int, /) -> float: ...
    def set(self, prop: int, value: float, /) -> bool: ...
    def release(self) -> None: ...


@dataclass(frozen=True, slots=True)
class V4l2Settings:
    """What is asked of the driver; it may give something else, which `health.detail` then says.

    device: `/dev/video0` or, better, a name under `/dev/v4l/by-id`; fourcc: MJPG or YUYV.
    """

    device: str
    width_px: int = 640
    height_px: int = 480
    fps: float = 15.0
    fourcc: str = "MJPG"


class V4l2Camera:
    """A V4L2 device as a camera; reopens by itself.

    Args:
        settings: the device and its format.
        part: the camera's name in health and logs.
        opener: opens the device; OpenCV's V4L2 back-end by default.
    """

    def __init__(
        self,
        settings: V4l2Settings,
        *,
        part: str = "camera",
        opener: Callable[[str], Capture] | None = None,
    ) -> None:
        if len(settings.fourcc) != 4:
            raise ValueError("a pixel format has four letters")
        self.health = Health(part)
        self._settings = settings
        self._opener = opener or open_v4l2
        self._seq = 0

    async def run(self, out: DropOldestQueue[Frame]) -> None:
        """Emit frames into `out` until cancelled."""
        loop = asyncio.get_running_loop()
        stop = threading.Event()
        ended = asyncio.Event()

        def work() -> None:
            # A RuntimeError: the loop has gone, and nobody waits any more.
            with contextlib.suppress(RuntimeError):
                try:
                    self._work(loop, stop, out)
                finally:
                    loop.call_soon_threadsafe(ended.set)

        thread = threading.Thread(target=work, name=f"v4l2 {self._settings.device}", daemon=True)
        thread.start()
        try:
            await ended.wait()
        finally:
            stop.set()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_SELECT_TIMEOUT_S):
                    await ended.wait()
                thread.join(timeout=_SELECT_TIMEOUT_S)

    def _work(
        self, loop: asyncio.AbstractEventLoop, stop: threading.Event, out: DropOldestQueue[Frame]
    ) -> None:
        def emit(frame: Frame, detail: str, driver_stamp: bool) -> None:
            out.put(frame)
            self.health.counters["frames"] += 1
            self.health.counters["arrival_stamps"] += not driver_stamp
            self.health.ok(detail)

        backoff_s = BACKOFF_FIRST_S
        while not stop.is_set():
            seq_before = self._seq
            try:
                self._capture(loop, stop, emit)
            except (SourceError, cv2.error) as error:
                if not stop.is_set():
                    loop.call_soon_threadsafe(self._trouble, str(error))
            if self._seq > seq_before:
                backoff_s = BACKOFF_FIRST_S
            stop.wait(backoff_s)
            backoff_s = min(2.0 * backoff_s, BACKOFF_MAX_S)

    def _trouble(self, reason: str) -> None:
        level = logging.WARNING if self.health.trouble(reason) else logging.DEBUG
        log.log(level, "%s: %s", self.health.part, reason)
        self.health.counters["reopens"] += 1

    def _capture(
        self,
        loop: asyncio.AbstractEventLoop,
        stop: threading.Event,
        emit: Callable[[Frame, str, bool], None],
    ) -> None:
        """Read frames until told to stop; a SourceError when the device is not there or has gone."""
        wanted = self._settings
        capture = self._opener(wanted.device)
        try:
            if not capture.isOpened():
                remedy = "another program may be using it"
                raise SourceError("the camera cannot be opened", where=wanted.device, remedy=remedy)
            # The pixel format first: the sizes and rates a driver offers depend on it.
            capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*wanted.fourcc))
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, wanted.width_px)
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, wanted.height_px)
            capture.set(cv2.CAP_PROP_FPS, wanted.fps)
            while not stop.is_set():
                good, image = capture.read()
                arrival_ns = time.monotonic_ns()
                if not good or image is None:
                    raise SourceError("the camera has stopped sending", where=wanted.device)
                driver_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
                trusted = driver_ns > 0 and is_plausible(driver_ns, arrival_ns)
                t_ns = min(driver_ns, arrival_ns) if trusted else arrival_ns
                frame = Frame(t_ns, self._seq, np.asarray(image, dtype=np.uint8))
                self._seq += 1
                height, width = frame.image.shape[:2]
                detail = f"{width}x{height}, stamps: {'driver' if trusted else 'arrival'}"
                loop.call_soon_threadsafe(emit, frame, detail, trusted)
        finally:
            capture.release()


def open_v4l2(device: str) -> Capture:
    """Open a device with OpenCV's V4L2 back-end.

    Raises:
        SourceError: it does not exist or may not be read.
    """
    if not Path(device).exists():
        raise SourceError("there is no such camera", where=device, remedy="plug it in, or see /dev/v4l/by-id")
    if not os.access(device, os.R_OK | os.W_OK):
        remedy = "add the user to the group that owns it, usually video"
        raise SourceError("the camera may not be opened", where=device, remedy=remedy)
    # OpenCV reads this once, when it first opens a V4L2 device; there is no other way to set it.
    os.environ.setdefault(_SELECT_TIMEOUT_VARIABLE, str(_SELECT_TIMEOUT_S))
    return cv2.VideoCapture(device, cv2.CAP_V4L2)
