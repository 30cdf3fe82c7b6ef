"""CSI from a log that grows: a FIFO (log_to_file /path/to/fifo) or a file that is still being written."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import fcntl
import logging
import os
import stat
import time
from pathlib import Path

from vad.csi.attribution import Attribution
from vad.csi.intake import Intake
from vad.csi.packets import CsiBatch
from vad.health import Health
from vad.streams import DropOldestQueue

log = logging.getLogger(__name__)

RETRY_S = 1.0
POLL_S = 0.05
COALESCE_S = 0.015
# A batch costs as much as some hundred of its packets: few bytes may gather for longer, and a FIFO is made
# large enough for many that come all at once.
QUIET_BYTES = 2048
QUIET_COALESCE_S = 0.150
_FIFO_BYTES = 1 << 20
# At most 1200 packets: decoding them holds the event loop for a few milliseconds.
_READ_BYTES = 1 << 18


class FollowLog:
    """A CsiSource which reads a log while it is written, from its beginning.

    When the writer of a FIFO goes away, it is opened again and the next writer's log starts; so is a file
    that was replaced or cut. An incomplete record of the former log is given up and counted.

    Args:
        path: the FIFO or file; may appear later.
        attribution: who the packets are from; pairs frames and CSI by default.

    `health.counters`: bytes, opened, truncated_bytes, and those of vad.csi.intake.
    """

    def __init__(self, path: Path, *, attribution: Attribution | None = None) -> None:
        self.health = Health("csi.follow")
        self._path = path
        self._intake = Intake(self.health, attribution)

    async def run(self, out: DropOldestQueue[CsiBatch]) -> None:
        """Emit batches until cancelled; opens the log again after trouble."""
        while True:
            try:
                await self._follow(out)
            except OSError as error:
                reason = f"Cannot read the CSI log {self._path}: {error.strerror}"
                fresh = self.health.trouble(reason)
                log.log(logging.WARNING if fresh else logging.DEBUG, "%s", reason)
            await asyncio.sleep(RETRY_S)

    async def _follow(self, out: DropOldestQueue[CsiBatch]) -> None:
        log_fd = self._open()
        try:
            while True:
                self._start_log()
                if stat.S_ISFIFO(os.fstat(log_fd).st_mode):
                    self.health.ok(f"reading the FIFO {self._path}")
                    await self._read_fifo(log_fd, out)
                else:
                    self.health.ok(f"reading the file {self._path}")
                    await self._read_file(log_fd, out)
                # Opened before the old one is closed: a new writer always finds a reader.
                next_fd = self._open()
                os.close(log_fd)
                log_fd = next_fd
        finally:
            os.close(log_fd)

    def _open(self) -> int:
        log_fd = os.open(self._path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        mode = os.fstat(log_fd).st_mode
        if not (stat.S_ISFIFO(mode) or stat.S_ISREG(mode)):
            os.close(log_fd)
            raise OSError(errno.EINVAL, "it is neither a FIFO nor a regular file")
        return log_fd

    def _start_log(self) -> None:
        counters = self.health.counters
        counters["opened"] += 1
        if counters["opened"] > 1:
            counters["truncated_bytes"] += self._intake.reader.stats.truncated_bytes
            self._intake.restart()

    async def _read_fifo(self, fifo_fd: int, out: DropOldestQueue[CsiBatch]) -> None:
        with contextlib.suppress(OSError):  # past the user's quota the kernel's own size must do
            fcntl.fcntl(fifo_fd, fcntl.F_SETPIPE_SZ, _FIFO_BYTES)
        loop, coalesce_s = asyncio.get_running_loop(), COALESCE_S
        while True:
            woken: asyncio.Future[int] = loop.create_future()
            loop.add_reader(fifo_fd, _wake, woken)
            try:
                woken_ns: int | None = await woken
            finally:
                loop.remove_reader(fifo_fd)
            await asyncio.sleep(coalesce_s)
            before = self.health.counters["bytes"]
            while True:
                try:
                    data = os.read(fifo_fd, _READ_BYTES)
                except BlockingIOError:
                    break
                if not data:
                    return
                self._emit(data, out, woken_ns)
                woken_ns = None
                await asyncio.sleep(0)
            quiet = self.health.counters["bytes"] - before < QUIET_BYTES
            coalesce_s = QUIET_COALESCE_S if quiet else COALESCE_S

    async def _read_file(self, file_fd: int, out: DropOldestQueue[CsiBatch]) -> None:
        position = 0
        while True:
            # A local file's next piece is in the page cache: the read does not block for long.
            if data := os.read(file_fd, _READ_BYTES):
                position += len(data)
                self._emit(data, out, None)
                await asyncio.sleep(0)
                continue
            opened, named = os.fstat(file_fd), self._path.stat()
            replaced = (opened.st_dev, opened.st_ino) != (named.st_dev, named.st_ino)
            if replaced or opened.st_size < position:
                return
            await asyncio.sleep(POLL_S)

    def _emit(self, data: bytes, out: DropOldestQueue[CsiBatch], woken_ns: int | None) -> None:
        self.health.counters["bytes"] += len(data)
        batch = self._intake.feed(data, time.monotonic_ns(), woken_ns)
        if batch.raw:
            out.put(batch)


def _wake(woken: asyncio.Future[int]) -> None:
    if not woken.done():
        woken.set_result(time.monotonic_ns())
