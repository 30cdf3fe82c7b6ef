"""Plays a radio, simulated or recorded, as the 5300's kernel driver would: over the connector or a FIFO."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import fcntl
import logging
import os
import select
import socket
import stat
import struct
import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Protocol, TypeVar

from vad.csi.cn import IWLAGN_GROUP, IWLAGN_VALUE, NETLINK_CONNECTOR, build_message
from vad.errors import SourceError
from vad.health import Health

log = logging.getLogger(__name__)

Batch = TypeVar("Batch")

BATCH_S = 0.02
AHEAD_S = 0.04
"""Packets are made this long before they are due, so that making them never delays them."""
TICK_S = 0.005
CATCH_UP_S = 0.1
"""After a stall at most this much is sent late; the rest is lost, as in the driver's own queue."""
_FIFO_BYTES = 256 << 10
_CODE_AT, _BODY_AT = 2, 3
# A bare netlink header: the connector ignores it, so only the permission is tried.
_EMPTY_MESSAGE = struct.pack("=IHHII", 16, 3, 0, 0, 0)
_UNUSED_GROUP = 32


class PlayedRadio(Protocol[Batch]):
    """What `run` plays: vad.sim.radio.Radio, vad.sim.log_player.LogPlayer."""

    def generate(self, t0_s: float, t1_s: float) -> Batch:
        """The packets with t0_s <= t < t1_s."""
        ...

    def log_bytes(self, batch: Batch) -> list[tuple[float, bytes]]:
        """Their records with times, in order."""
        ...


class Sender(Protocol):
    """Where the driver's records go. `send` returns at once, whatever becomes of them."""

    health: Health

    def send(self, records: Sequence[bytes]) -> None:
        """Pass on records in the format of log_to_file, in order."""
        ...

    def close(self) -> None:
        """Give the descriptor back; further calls do nothing."""
        ...


def _connector_socket() -> socket.socket:
    kind = socket.SOCK_DGRAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC
    sock = socket.socket(socket.AF_NETLINK, kind, NETLINK_CONNECTOR)
    try:
        sock.bind((0, 0))
    except OSError:
        sock.close()
        raise
    return sock


class ConnectorSender:
    """The real kernel path: multicast to the driver's connector group. Needs CAP_NET_ADMIN.

    A receiver that is not the kernel's own peer must allow messages from user space; one whose buffer is
    full loses messages without the sender's knowledge, as with the driver.

    `health.counters`: records, bytes, dropped_records, dropped_bytes.

    Raises SourceError where the socket cannot be had.
    """

    def __init__(self, group: int = IWLAGN_GROUP, value: int = IWLAGN_VALUE) -> None:
        self.health = Health("sim.connector")
        self._group, self._value = group, value
        try:
            self._socket: socket.socket | None = _connector_socket()
        except OSError as error:
            raise SourceError(
                f"the kernel connector cannot be opened: {error.strerror}",
                where="NETLINK_CONNECTOR",
                remedy="Play into a FIFO instead",
            ) from error

    @staticmethod
    def permitted() -> bool:
        """True where this process may multicast on the kernel connector; nobody receives the trial."""
        try:
            with _connector_socket() as sock:
                sock.sendto(_EMPTY_MESSAGE, (0, 1 << (_UNUSED_GROUP - 1)))
        except OSError:
            return False
        return True

    def send(self, records: Sequence[bytes]) -> None:
        """Send each record as one message; what the kernel refuses is counted."""
        if self._socket is None:
            return
        counters = self.health.counters
        target = (0, 1 << (self._group - 1))
        for data in records:
            message = build_message(data[_CODE_AT], data[_BODY_AT:], group=self._group, value=self._value)
            try:
                self._socket.sendto(message, target)
            except OSError as error:
                counters["dropped_records"] += 1
                counters["dropped_bytes"] += len(data)
                reason = f"The kernel connector refuses a message: {error.strerror}"
                fresh = self.health.trouble(reason)
                log.log(logging.WARNING if fresh else logging.DEBUG, "%s", reason)
            else:
                counters["records"] += 1
                counters["bytes"] += len(data)
                self.health.ok(f"sending to connector group {self._group}")

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class FifoSender:
    """The driver's records as one log through a FIFO whose reader may come and go.

    Records are written in groups of at most PIPE_BUF bytes, which the kernel takes whole or not at all:
    what is dropped ends at a record's boundary, and every reader starts at one. Without a reader
    everything is dropped.

    Args:
        path: the FIFO; made if it is not there, and then removed by `close`.

    `health.counters`: records, bytes, dropped_records, dropped_bytes, readers.

    Raises SourceError where the path is something else or cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self.health = Health("sim.fifo")
        self._path = path
        self._fd: int | None = None
        self._open = True
        self._made = False
        try:
            if not path.exists():
                os.mkfifo(path)
                self._made = True
            if not stat.S_ISFIFO(path.stat().st_mode):
                raise SourceError("this is not a FIFO", where=str(path), remedy="Name a path that is free")
        except OSError as error:
            raise SourceError(f"no FIFO can be made: {error.strerror}", where=str(path)) from error

    def send(self, records: Sequence[bytes]) -> None:
        """Write what fits; the rest is dropped and counted."""
        group: list[bytes] = []
        size = 0
        for data in records:
            if size + len(data) > select.PIPE_BUF and group:
                self._write(group)
                group, size = [], 0
            group.append(data)
            size += len(data)
        if group:
            self._write(group)

    def _write(self, group: list[bytes]) -> None:
        data = b"".join(group)
        counters = self.health.counters
        if len(data) <= select.PIPE_BUF and self._have_reader() and self._fd is not None:
            try:
                os.write(self._fd, data)
            except BlockingIOError:
                self._tell("The FIFO's reader is too slow")
            except BrokenPipeError:
                os.close(self._fd)
                self._fd = None
                self._tell("The FIFO's reader went away")
            else:
                counters["records"] += len(group)
                counters["bytes"] += len(data)
                self.health.ok(f"writing to {self._path}")
                return
        counters["dropped_records"] += len(group)
        counters["dropped_bytes"] += len(data)

    def _have_reader(self) -> bool:
        if self._fd is not None or not self._open:
            return self._fd is not None
        try:
            self._fd = os.open(self._path, os.O_WRONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            no_reader = error.errno == errno.ENXIO
            self._tell("The FIFO has no reader" if no_reader else f"The FIFO is gone: {error.strerror}")
            return False
        with contextlib.suppress(PermissionError):  # past the user's quota the kernel's own size must do
            fcntl.fcntl(self._fd, fcntl.F_SETPIPE_SZ, _FIFO_BYTES)
        self.health.counters["readers"] += 1
        return True

    def _tell(self, reason: str) -> None:
        fresh = self.health.trouble(reason)
        log.log(logging.WARNING if fresh else logging.DEBUG, "%s: %s", self._path, reason)

    def close(self) -> None:
        """Close the FIFO, and remove it if it was made here."""
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None
        if self._made:
            self._path.unlink(missing_ok=True)
            self._made = False
        self._open = False


async def run(
    radio: PlayedRadio[Batch],
    start_ns: int,
    sender: Sender,
    *,
    speed: float = 1.0,
    from_s: float | None = None,
    until_s: float | None = None,
) -> None:
    """Play the radio until cancelled, or until all of it before `until_s` is sent; closes the sender.

    Args:
        radio: what is played; made in a thread of its own, in pieces of BATCH_S.
        start_ns: the radio's t = 0 on CLOCK_MONOTONIC.
        sender: gets each record within about TICK_S of its time. What is more than CATCH_UP_S late is not
            sent but counted in `sender.health.counters["late_records"]` (made but too late) and
            `["skipped_ms"]` (of the radio's time; not even made).
        speed: how many seconds of the radio's time pass in one; all spans above are real time.
        from_s: where in the radio's time to begin; now, unless what came before is wanted, too.
    """
    counters = sender.health.counters

    def make(t0_s: float, t1_s: float) -> list[tuple[float, bytes]]:
        return radio.log_bytes(radio.generate(t0_s, t1_s))

    loop = asyncio.get_running_loop()
    maker = ThreadPoolExecutor(1, thread_name_prefix="sim-radio")
    waiting: deque[tuple[float, bytes]] = deque()
    made_s = _now_s(start_ns, speed) if from_s is None else from_s
    try:
        while until_s is None or made_s < until_s or waiting:
            now_s = _now_s(start_ns, speed)
            oldest_s = now_s - CATCH_UP_S * speed
            if made_s < oldest_s:
                counters["skipped_ms"] += round(1000 * (oldest_s - made_s))
                made_s = oldest_s
            ahead = made_s >= now_s + AHEAD_S * speed
            if not ahead:
                next_s = made_s + BATCH_S * speed
                waiting.extend(await loop.run_in_executor(maker, make, made_s, next_s))
                made_s = next_s
            now_s = _now_s(start_ns, speed)
            _send_due(waiting, now_s, now_s - CATCH_UP_S * speed, sender)
            if ahead:
                await asyncio.sleep(TICK_S)
    finally:
        maker.shutdown(wait=True, cancel_futures=True)
        sender.close()


def _now_s(start_ns: int, speed: float) -> float:
    return (time.monotonic_ns() - start_ns) / 1e9 * speed


def _send_due(waiting: deque[tuple[float, bytes]], now_s: float, oldest_s: float, sender: Sender) -> None:
    due: list[bytes] = []
    while waiting and waiting[0][0] <= now_s:
        t_s, data = waiting.popleft()
        if t_s < oldest_s:
            sender.health.counters["late_records"] += 1
        else:
            due.append(data)
    if due:
        sender.send(due)
