"""IP cameras over RTSP, through OpenCV's FFmpeg: one thread, the stream's own stamps, reopened."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from typing import Literal
from urllib.parse import urlsplit

import cv2
import numpy as np

from vad.camera.frame import BAD_PICTURES, FrameQueue
from vad.camera.opencv_capture import Capture, Grabber
from vad.camera.threaded import Emit, Shot, Wants, run_reopening
from vad.clock import ClockMap
from vad.errors import ConfigError, SourceError
from vad.health import Health

Transport = Literal["tcp", "udp"]

# FFmpeg can only be told to give up, not woken: these bound how long the end of the daemon may take.
_OPEN_TIMEOUT_MS = 4000
_READ_TIMEOUT_MS = 3000
_END_S = 4.5
_FFMPEG_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
_FFMPEG_LOG_LEVEL = "OPENCV_FFMPEG_LOGLEVEL"
_FATAL_ONLY = "8"


class RtspCamera:
    """An RTSP stream as a camera; reconnects by itself.

    The stream's presentation times are laid on the timeline by the least delay seen: jitter of network and
    decoder goes, a constant delay of the camera (0.1-0.5 s is usual) stays in the times, and camera mapping
    finds it.

    Args:
        url: `rtsp://[user:password@]host[:port]/path`. transport: udp loses packets, tcp waits for them.
        part: the camera's name in health and logs. opener: opens the stream; OpenCV's FFmpeg by default.

    Raises:
        ConfigError: the address is not rtsp.
    """

    def __init__(
        self,
        url: str,
        *,
        transport: Transport = "tcp",
        part: str = "camera",
        opener: Callable[[str, Transport], Capture] | None = None,
    ) -> None:
        try:
            address = urlsplit(url)
            port = address.port
        except ValueError as error:
            raise ConfigError("the camera's address cannot be read", remedy=str(error)) from error
        if address.scheme not in ("rtsp", "rtsps") or not address.hostname:
            remedy = "give rtsp://[user:password@]host[:port]/path"
            raise ConfigError("the address is not an RTSP one", where=part, remedy=remedy)
        self.health = Health(part)
        # Without the password, which the address may hold.
        self._where = f"{address.hostname}:{port or 554}"
        self._url = url
        self._transport = transport
        self._opener = opener or open_rtsp

    async def run(self, out: FrameQueue) -> None:
        """Emit frames into `out` until cancelled."""
        await run_reopening(self._session, out, self.health, name=f"rtsp {self._where}", end_s=_END_S)

    def _session(self, stop: threading.Event, emit: Emit, wants: Wants) -> None:
        capture = self._opener(self._url, self._transport)
        clock, restarts = ClockMap(), 0
        grabber = Grabber(capture, self._where)
        try:
            if not capture.isOpened():
                remedy = "see whether it is on, and whether the path, user and password are right"
                raise SourceError("the camera cannot be opened", where=self._where, remedy=remedy)
            while not stop.is_set():
                arrival_ns = grabber.grab()
                since_start_us = round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e3)
                counter = np.array([since_start_us & 0xFFFFFFFF], np.uint32)
                t_ns = int(clock.update(counter, np.array([arrival_ns], np.int64))[0])
                t_ns = min(t_ns, arrival_ns)
                if not wants(t_ns):
                    continue
                decoded = grabber.decode()
                if decoded is None:
                    continue
                picture, bad = decoded
                height, width = picture.shape[:2]
                stamps = "arrival" if clock.still else "stream"
                counts = {
                    "arrival_stamps": int(clock.still),
                    "clock_restarts": clock.restarts - restarts,
                    BAD_PICTURES: bad,
                }
                restarts = clock.restarts
                emit(Shot(t_ns, picture, f"{width}x{height}, stamps: {stamps}", counts))
        finally:
            capture.release()


def open_rtsp(url: str, transport: Transport) -> Capture:
    """Open a stream with OpenCV's FFmpeg back-end; what it waits for is bounded."""
    os.environ.setdefault(_FFMPEG_LOG_LEVEL, _FATAL_ONLY)
    limits = [
        cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
        _OPEN_TIMEOUT_MS,
        cv2.CAP_PROP_READ_TIMEOUT_MSEC,
        _READ_TIMEOUT_MS,
    ]
    before = os.environ.get(_FFMPEG_OPTIONS)
    # OpenCV reads this at each opening; there is no other way to tell FFmpeg. A video file must not find it.
    os.environ[_FFMPEG_OPTIONS] = f"rtsp_transport;{transport}|fflags;nobuffer"
    try:
        return cv2.VideoCapture(url, cv2.CAP_FFMPEG, limits)
    finally:
        if before is None:
            del os.environ[_FFMPEG_OPTIONS]
        else:
            os.environ[_FFMPEG_OPTIONS] = before
