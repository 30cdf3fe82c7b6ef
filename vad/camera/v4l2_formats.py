"""What a V4L2 camera offers: pixel formats, sizes, rates. ioctl structures <-> values (linux/videodev2.h)."""

from __future__ import annotations

import errno
import fcntl
import os
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from vad.errors import SourceError

QUERYCAP, ENUM_FMT, ENUM_FRAMESIZES, ENUM_FRAMEINTERVALS = 0x80685600, 0xC0405602, 0xC02C564A, 0xC034564B
CAPTURE, OWN_CAPABILITIES = 0x1, 0x8000_0000
DISCRETE = 1
_VIDEO_CAPTURE = 1
_CAPABILITY = struct.Struct("=16s32s32sIII12x")
_FORMAT = struct.Struct("=III32sI16x")
_SIZE = struct.Struct("=III6I8x")
_INTERVAL = struct.Struct("=IIIII6I8x")
_MOST = 256
"""More answers than a camera has: a driver that never ends is not asked on."""
_COMMON_SIZES = ((320, 240), (640, 480), (800, 600), (1280, 720), (1920, 1080))
"""What is asked about where a camera does every size in between."""

Ioctl = Callable[[int, int, bytearray], object]


@dataclass(frozen=True, slots=True)
class Format:
    """One pixel format in one size. fourcc: MJPG, YUYV ...; fps: rates, falling; empty where not told."""

    fourcc: str
    width_px: int
    height_px: int
    fps: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class V4l2Description:
    """A camera: its name, and what it offers."""

    card: str
    formats: tuple[Format, ...]


def describe(device: Path, ioctl: Ioctl = fcntl.ioctl) -> V4l2Description | None:
    """What the device offers; None where it is no camera (a node for metadata, an output).

    Raises:
        SourceError: it does not exist, may not be opened, or does not answer.
    """
    try:
        descriptor = os.open(device, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        remedy = (
            "Add the user to the group that owns it, usually video" if error.errno == errno.EACCES else ""
        )
        raise SourceError(f"cannot be opened ({error.strerror})", where=str(device), remedy=remedy) from error
    try:
        return _described(descriptor, ioctl)
    except OSError as error:
        raise SourceError(f"does not answer ({error.strerror})", where=str(device)) from error
    finally:
        os.close(descriptor)


def _described(descriptor: int, ioctl: Ioctl) -> V4l2Description | None:
    data = bytearray(_CAPABILITY.size)
    ioctl(descriptor, QUERYCAP, data)
    _, card, _, _, all_capabilities, own = _CAPABILITY.unpack(data)
    if not (own if all_capabilities & OWN_CAPABILITIES else all_capabilities) & CAPTURE:
        return None
    formats = []
    for index in range(_MOST):
        data = bytearray(_FORMAT.pack(index, _VIDEO_CAPTURE, 0, b"", 0))
        if not _answered(descriptor, ioctl, ENUM_FMT, data):
            break
        code = _FORMAT.unpack(data)[4]
        name = code.to_bytes(4, "little").decode("ascii", "replace").rstrip()
        for width, height in _sizes(descriptor, ioctl, code):
            formats.append(Format(name, width, height, _rates(descriptor, ioctl, code, width, height)))
    return V4l2Description(card.split(b"\0")[0].decode("utf-8", "replace"), tuple(formats))


def _sizes(descriptor: int, ioctl: Ioctl, code: int) -> Iterator[tuple[int, int]]:
    for index in range(_MOST):
        data = bytearray(_SIZE.pack(index, code, 0, *[0] * 6))
        if not _answered(descriptor, ioctl, ENUM_FRAMESIZES, data):
            return
        _, _, kind, *numbers = _SIZE.unpack(data)
        if kind == DISCRETE:
            yield numbers[0], numbers[1]
            continue
        min_width, max_width, step_width, min_height, max_height, step_height = numbers
        for width, height in _COMMON_SIZES:
            fits = min_width <= width <= max_width and min_height <= height <= max_height
            if fits and not (
                (width - min_width) % max(step_width, 1) or (height - min_height) % max(step_height, 1)
            ):
                yield width, height
        return


def _rates(descriptor: int, ioctl: Ioctl, code: int, width: int, height: int) -> tuple[float, ...]:
    rates = []
    for index in range(_MOST):
        data = bytearray(_INTERVAL.pack(index, code, width, height, 0, *[0] * 6))
        if not _answered(descriptor, ioctl, ENUM_FRAMEINTERVALS, data):
            break
        *_, kind, numerator, denominator, _, _, _, _ = _INTERVAL.unpack(data)
        if numerator:
            rates.append(denominator / numerator)
        if kind != DISCRETE:  # of a range the shortest interval stands first
            break
    return tuple(sorted(set(rates), reverse=True))


def _answered(descriptor: int, ioctl: Ioctl, request: int, data: bytearray) -> bool:
    """Whether there is one more answer; a driver without this request has none."""
    try:
        ioctl(descriptor, request, data)
    except OSError as error:
        if error.errno in (errno.EINVAL, errno.ENOTTY):
            return False
        raise
    return True


def best_format(
    formats: tuple[Format, ...], *, width_px: int = 640, height_px: int = 480, fps: float = 15.0
) -> Format | None:
    """The one to ask for: fast enough, near the wanted size, MJPG before YUYV; None where it has neither."""

    def rank(found: Format) -> tuple[bool, float, bool]:
        slow = bool(found.fps) and max(found.fps) < fps * 0.9
        away = abs(found.width_px * found.height_px / (width_px * height_px) - 1.0)
        return slow, away, found.fourcc != "MJPG"

    usable = [found for found in formats if found.fourcc in ("MJPG", "YUYV")]
    return min(usable, key=rank, default=None)
