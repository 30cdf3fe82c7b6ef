"""Local cameras through Video4Linux: one thread a camera, the driver's own stamps, reopened after unplug."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2

from vad.camera.frame import BAD_PICTURES, FrameQueue
from vad.camera.opencv_capture import Capture, Grabber
from vad.camera.stamps import is_plausible
from vad.camera.threaded import Emit, Shot, Wants, run_reopening
from vad.errors import SourceError
from vad.health import Health

# The thread ends within one frame or this; OpenCV's own 10 s would hold up the end of the daemon.
_SELECT_TIMEOUT_S = 1
_SELECT_TIMEOUT_VARIABLE = "OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT"
# Of a trusted driver: on a busy machine its pictures may wait in its buffers for as long as this.
_OLDEST_TRUSTED_NS = 30_000_000_000


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

    async def run(self, out: FrameQueue) -> None:
        """Emit frames into `out` until cancelled."""
        name = f"v4l2 {self._settings.device}"
        await run_reopening(self._capture, out, self.health, name=name, end_s=_SELECT_TIMEOUT_S)

    def _capture(self, stop: threading.Event, emit: Emit, wants: Wants) -> None:
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
            fourcc, stamps, last_ns = _format(capture), _DriverClock(), 0
            grabber = Grabber(capture, wanted.device)
            while not stop.is_set():
                arrival_ns = grabber.grab()
                driver_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
                t_ns, trusted = stamps.stamp(driver_ns, arrival_ns)
                if t_ns <= last_ns:  # the clocks were mixed for a moment; time does not go back
                    continue
                last_ns = t_ns
                if not wants(t_ns):
                    continue
                decoded = grabber.decode()
                if decoded is None:
                    continue
                picture, bad = decoded
                height, width = picture.shape[:2]
                detail = f"{width}x{height} {fourcc}, stamps: {'driver' if trusted else 'arrival'}"
                emit(Shot(t_ns, picture, detail, {"arrival_stamps": not trusted, BAD_PICTURES: bad}))
        finally:
            capture.release()


class _DriverClock:
    """Whether a driver's stamps are on the timeline: its first one tells, for as long as it is open."""

    def __init__(self) -> None:
        self._trusted: bool | None = None

    def stamp(self, driver_ns: int, arrival_ns: int) -> tuple[int, bool]:
        """The picture's time on the timeline, and whether it is the driver's."""
        if self._trusted is None and driver_ns > 0:
            self._trusted = is_plausible(driver_ns, arrival_ns)
        if self._trusted and driver_ns > 0 and is_plausible(driver_ns, arrival_ns, _OLDEST_TRUSTED_NS):
            return min(driver_ns, arrival_ns), True
        return arrival_ns, False


def _format(capture: Capture) -> str:
    """The pixel format in use, four letters; empty where the driver does not say."""
    code = int(capture.get(cv2.CAP_PROP_FOURCC))
    return code.to_bytes(4, "little").decode("ascii", "replace") if 0 < code < 1 << 32 else ""


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
