"""A serial line that may go away: device path, pty, `socket://host:port` or `rfc2217://host:port`.

One thread per line does the blocking reads of pyserial; what is said is a `SerialDialogue` without I/O.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import select
import socket
import termios
import threading
import time
from collections.abc import Callable, Sequence
from typing import Generic, Protocol, TypeVar

import serial

from vad.health import Health

READ_SLICE_S = 0.02
"""How long one read waits where a port cannot be waited for together with the end (rfc2217://)."""
LONGEST_WAIT_S = 0.5
"""For something to arrive or to be due: the resolution of what is said about silence."""
WRITE_TIMEOUT_S = 0.5
SILENCE_S = 2.0
"""After this long without anything understood the line is degraded."""
REOPEN_S = 6.0
"""After this long it is opened anew: a dead TCP peer or a hung adapter gives no error."""
RETRY_FIRST_S = 0.1
RETRY_FACTOR = 2.0
RETRY_MAX_S = 1.0
JOIN_S = 0.9

_LINE_ERRORS = (OSError, termios.error, ValueError)
"""What pyserial raises: SerialException is an OSError, tcflush is unwrapped, a bad URL is a ValueError."""

_log = logging.getLogger(__name__)

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)


class SerialDialogue(Protocol[T_co]):
    """What is said over one connection of a line, without I/O. `bad` counts what was not understood."""

    bad: int

    def to_send(self, now_ns: int) -> bytes:
        """What to write now; empty when nothing is due."""
        ...

    def due_ns(self) -> int | None:
        """When `to_send` wants to be asked again; None where only something that arrives can change that."""
        ...

    def receive(self, data: bytes, now_ns: int) -> Sequence[T_co]:
        """What `data`, which arrived at `now_ns`, completes."""
        ...


class SerialLine(Generic[T]):
    """Keeps a line open, holds one dialogue per connection over it and delivers what that understands.

    `silence_hint` tells the user what to check when bytes come but nothing is understood. `health` becomes
    degraded here; making it ok is up to the receiver of the values.
    """

    def __init__(
        self,
        port: str,
        *,
        baud: int,
        dialogue: Callable[[], SerialDialogue[T]],
        health: Health,
        silence_hint: str,
    ) -> None:
        self.port = port
        self._baud = baud
        self._dialogue = dialogue
        self._health = health
        self._silence_hint = silence_hint

    async def run(self, deliver: Callable[[T], None]) -> None:
        """Deliver values on the event loop's thread until cancelled; troubles go into `health`.

        The thread has ended when this returns, unless it hangs in connecting to a host that drops packets:
        then it ends by itself when pyserial gives up (5 s), delivering nothing.
        """
        loop = asyncio.get_running_loop()
        stop = threading.Event()
        ended = asyncio.Event()
        ours, theirs = socket.socketpair()
        worker = _Worker(self, loop, stop, theirs, deliver, ended)
        thread = threading.Thread(target=worker.run, name=f"serial {self.port}", daemon=True)
        thread.start()
        try:
            await ended.wait()
            raise RuntimeError(f"the thread of {self.port} died of an error in it, which it has printed")
        finally:
            stop.set()
            ours.close()  # what waits for the line wakes
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(JOIN_S):
                    await ended.wait()
                    thread.join()

    def open(self) -> serial.Serial:
        """The opened port; raises one of _LINE_ERRORS."""
        port = serial.serial_for_url(self.port, do_not_open=True, baudrate=self._baud, timeout=READ_SLICE_S)
        if not self.port.startswith("rfc2217:"):  # not supported there
            port.write_timeout = WRITE_TIMEOUT_S
        if "://" not in self.port:
            port.exclusive = True
        port.open()
        return port

    def new_dialogue(self) -> SerialDialogue[T]:
        """A dialogue for a fresh connection."""
        return self._dialogue()

    def opened(self) -> None:
        """Note a connection (event loop's thread)."""
        self._health.counters["opened"] += 1

    def trouble(self, reason: str) -> None:
        """Note what is wrong, one WARNING while it is new (event loop's thread)."""
        level = logging.WARNING if self._health.trouble(reason) else logging.DEBUG
        _log.log(level, "%s: %s", self.port, reason)

    def misunderstood(self, count: int) -> None:
        """Note input that could not be used (event loop's thread)."""
        level = logging.DEBUG if self._health.counters["bad_input"] else logging.WARNING
        self._health.counters["bad_input"] += count
        _log.log(level, "%s: input that is missing, late or not understood", self.port)

    def silence_reason(self, heard: bool) -> str:
        """What to tell the user after SILENCE_S without anything understood."""
        if heard:
            return f"bytes come but nothing is understood for {SILENCE_S:g} s. {self._silence_hint}"
        return f"no reply for {SILENCE_S:g} s. Is the robot on, and are its RX and TX wires crossed?"


class _Worker(Generic[T]):
    """The thread's side of a SerialLine."""

    def __init__(
        self,
        line: SerialLine[T],
        loop: asyncio.AbstractEventLoop,
        stop: threading.Event,
        stop_socket: socket.socket,
        deliver: Callable[[T], None],
        ended: asyncio.Event,
    ) -> None:
        self._line = line
        self._loop = loop
        self._stop = stop
        self._stop_socket = stop_socket
        self._deliver = deliver
        self._ended = ended

    def run(self) -> None:
        try:
            self._keep_talking()
        finally:
            self._stop_socket.close()
            self._call_soon(self._ended.set)

    def _keep_talking(self) -> None:
        retry_s = RETRY_FIRST_S
        while not self._stop.is_set():
            try:
                with contextlib.closing(self._line.open()) as port:
                    self._post(self._line.opened)
                    if self._converse(port):
                        retry_s = RETRY_FIRST_S
            except _LINE_ERRORS as error:
                self._post(self._line.trouble, _reason(error))
            self._stop.wait(retry_s)
            retry_s = min(retry_s * RETRY_FACTOR, RETRY_MAX_S)

    def _converse(self, port: serial.Serial) -> bool:
        """Talk until told to stop or silent for REOPEN_S; whether anything was understood."""
        dialogue = self._line.new_dialogue()
        understood = heard = silent = False
        last_ns = time.monotonic_ns()
        bad = 0
        while not self._stop.is_set():
            if command := dialogue.to_send(time.monotonic_ns()):
                port.write(command)
            data = _read_available(port) if self._arrives(port, dialogue.due_ns()) else b""
            now_ns = time.monotonic_ns()
            values = dialogue.receive(data, now_ns) if data else []
            for value in values:
                self._post(self._deliver, value)
            if dialogue.bad > bad:
                self._post(self._line.misunderstood, dialogue.bad - bad)
                bad = dialogue.bad
            if values:
                understood, heard, silent, last_ns = True, False, False, now_ns
                continue
            heard = heard or bool(data)
            silence_s = (now_ns - last_ns) / 1e9
            if silence_s > SILENCE_S and not silent:
                silent = True
                self._post(self._line.trouble, self._line.silence_reason(heard))
            if silence_s > REOPEN_S:
                break
        return understood

    def _arrives(self, port: serial.Serial, due_ns: int | None) -> bool:
        """Wait until something arrives, is due, or it ends; whether there may be something to read."""
        if self._line.port.startswith("rfc2217:"):
            return True  # nothing there to wait for: it is asked again and again
        wait_s = LONGEST_WAIT_S
        if due_ns is not None:
            wait_s = min(max((due_ns - time.monotonic_ns()) / 1e9, 0.0), LONGEST_WAIT_S)
        ready, _, _ = select.select([port.fileno(), self._stop_socket.fileno()], [], [], wait_s)
        return port.fileno() in ready

    def _post(self, function: Callable[..., None], *values: object) -> None:
        if not self._stop.is_set():
            self._call_soon(self._unless_stopped, function, *values)

    def _call_soon(self, function: Callable[..., None], *values: object) -> None:
        # The loop may have closed while this thread still hung in connecting.
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(function, *values)

    def _unless_stopped(self, function: Callable[..., None], *values: object) -> None:
        if not self._stop.is_set():
            function(*values)


def _read_available(port: serial.Serial) -> bytes:
    """What has arrived, waiting for the first byte for at most READ_SLICE_S."""
    data = bytearray(port.read(1))
    while data and (waiting := port.in_waiting):
        data += port.read(waiting)
    return bytes(data)


def _reason(error: BaseException) -> str:
    text = str(error)
    if isinstance(error, ValueError):
        return f"{text}. Write a device path, socket://host:port or rfc2217://host:port"
    if "Permission denied" in text:
        return f"{text}. Add the user to the group that owns the device (often dialout)"
    if "exclusively lock" in text:
        return f"{text}. Another program uses this port: close it"
    if "device disconnected" in text:
        return "the line is gone. Was the adapter unplugged?"
    if "No such file" in text:
        return "no such port. Is the adapter plugged in? A path under /dev/serial/by-id stays the same"
    return text
