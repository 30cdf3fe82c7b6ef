"""What happens to a file, from the kernel: no polling. Linux only, like the rest of the daemon."""

from __future__ import annotations

import ctypes
import os
import struct
from dataclasses import dataclass
from pathlib import Path

MODIFY, ATTRIB, CLOSE_WRITE = 0x2, 0x4, 0x8
MOVED_TO, CREATE, DELETE_SELF, MOVE_SELF = 0x80, 0x100, 0x400, 0x800
IGNORED, OVERFLOW = 0x8000, 0x4000

_HEADER = struct.Struct("=iIII")
_READ_BYTES = 65_536
_NONBLOCK, _CLOEXEC = os.O_NONBLOCK, os.O_CLOEXEC

_libc = ctypes.CDLL(None, use_errno=True)


@dataclass(frozen=True, slots=True)
class FileEvent:
    """watch: the number that `Inotify.watch` gave; name: of the file within a watched folder, else empty."""

    watch: int
    mask: int
    name: str


def parse_events(data: bytes) -> list[FileEvent]:
    """The events of one read (inotify(7)); an incomplete one at the end is left out."""
    events, at = [], 0
    while at + _HEADER.size <= len(data):
        watch, mask, _, length = _HEADER.unpack_from(data, at)
        at += _HEADER.size
        if at + length > len(data):
            break
        events.append(FileEvent(watch, mask, os.fsdecode(data[at : at + length].rstrip(b"\0"))))
        at += length
    return events


class Inotify:
    """An inotify descriptor, not blocking: `fileno()` is readable when there is something to `read`."""

    def __init__(self) -> None:
        self._fd = _checked(_libc.inotify_init1(_NONBLOCK | _CLOEXEC), None)

    def fileno(self) -> int:
        """The descriptor, for the event loop."""
        return self._fd

    def watch(self, path: Path, mask: int) -> int:
        """Tell of `mask`'s events at a file or in a folder; OSError where it is not there."""
        return _checked(_libc.inotify_add_watch(self._fd, os.fsencode(path), mask), path)

    def read(self) -> list[FileEvent]:
        """What has happened since, without waiting."""
        try:
            return parse_events(os.read(self._fd, _READ_BYTES))
        except BlockingIOError:
            return []

    def close(self) -> None:
        """Give the descriptor back."""
        os.close(self._fd)


def _checked(result: int, path: Path | None) -> int:
    if result >= 0:
        return result
    number = ctypes.get_errno()
    raise OSError(number, os.strerror(number), None if path is None else str(path))
