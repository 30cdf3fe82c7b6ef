"""Stations that join, from hostapd's control socket (formats.md, section 8)."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import socket
import tempfile
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Literal

from vad.devices.hostapd import (
    ATTACH,
    DETACH,
    PING,
    STA_FIRST,
    Reply,
    StationChange,
    Terminating,
    parse_message,
    parse_station,
    sta_next,
)
from vad.devices.station import StationEvent
from vad.errors import ProtocolError, SourceError
from vad.health import Health
from vad.streams import DropOldestQueue

PING_S = 0.5
REPLY_S = 2.0
RETRY_FIRST_S = 0.1
RETRY_FACTOR = 2.0
RETRY_MAX_S = 0.5
LIST_ATTEMPTS = 3
"""A station that leaves while the list is read breaks it off; then it is read again."""

_MAX_STATIONS = 2048
_DATAGRAM_BYTES = 16_384
_INBOX = 4096

_log = logging.getLogger(__name__)


class _RestartedError(Exception):
    """hostapd ends, or another one has taken its place."""


class HostapdSource:
    """A JoinSource for one interface of hostapd.

    Stations that are in already when it connects are emitted too; those that vanished while hostapd was away
    are emitted as left.

    Args:
        socket_path: hostapd's socket, `<ctrl_interface>/<interface>`.
        interface: what events say about where the station was seen.
        own_dir: where the answering socket is made; hostapd must see the same folder (a private /tmp is not).
    """

    def __init__(self, socket_path: Path, *, interface: str, own_dir: Path | None = None) -> None:
        self.health = Health(f"hostapd {interface}")
        self._path = socket_path
        self._interface = interface
        self._own_dir = own_dir or Path(tempfile.gettempdir())
        self._present: set[str] = set()
        self._changed: set[str] = set()

    async def run(self, out: DropOldestQueue[StationEvent]) -> None:
        """Emit events into `out` until cancelled; trouble goes into `health`, never out of here."""
        retry_s = RETRY_FIRST_S
        while True:
            try:
                async with _connected(self._path, self._own_dir) as link:
                    await self._attach(link, out)
                    retry_s = RETRY_FIRST_S
                    await self._listen(link, out)
            except _RestartedError:
                self._trouble("hostapd restarts")
            except TimeoutError:
                self._trouble(f"hostapd gives no reply for {REPLY_S:g} s")
            except (OSError, SourceError, ProtocolError) as error:
                self._trouble(_reason(error))
            await asyncio.sleep(retry_s)
            retry_s = min(retry_s * RETRY_FACTOR, RETRY_MAX_S)

    async def _attach(self, link: _Link, out: DropOldestQueue[StationEvent]) -> None:
        reply = await self._ask(link, ATTACH, out)
        if reply.text != "OK":
            raise SourceError(f"hostapd refuses ATTACH: {reply.text!r}", where=str(self._path))
        self._changed.clear()
        stations = await self._list(link, out)
        if stations is not None:
            # Events that came while the list was read are newer than the list.
            for mac in sorted(stations - self._present - self._changed):
                self._emit("joined", mac, out)
            for mac in sorted(self._present - stations - self._changed):
                self._emit("left", mac, out)
        self.health.counters["attached"] += 1
        self._ok()

    async def _list(self, link: _Link, out: DropOldestQueue[StationEvent]) -> set[str] | None:
        """The stations that are let in; None where the list kept breaking off."""
        for _ in range(LIST_ATTEMPTS):
            seen: dict[str, bool] = {}
            command = STA_FIRST
            try:
                while station := parse_station(await self._ask(link, command, out)):
                    if station.mac in seen or len(seen) >= _MAX_STATIONS:
                        break
                    seen[station.mac] = station.authorized
                    command = sta_next(station.mac)
            except ProtocolError:
                continue
            return {mac for mac, authorized in seen.items() if authorized}
        return None

    async def _listen(self, link: _Link, out: DropOldestQueue[StationEvent]) -> None:
        while True:
            try:
                async with asyncio.timeout(PING_S):
                    reply = await self._next_reply(link, out)
            except TimeoutError:
                link.check_same()
                reply = await self._ask(link, PING, out)
            if reply.text not in ("PONG", "OK"):
                self._bad_input(f"unexpected reply {reply.text[:80]!r}")

    async def _ask(self, link: _Link, command: bytes, out: DropOldestQueue[StationEvent]) -> Reply:
        async with asyncio.timeout(REPLY_S):
            link.send(command)
            return await self._next_reply(link, out)

    async def _next_reply(self, link: _Link, out: DropOldestQueue[StationEvent]) -> Reply:
        """The next datagram that is no event; events are handled on the way."""
        while True:
            datagram = await link.receive()
            try:
                message = parse_message(datagram)
            except ProtocolError as error:
                self._bad_input(str(error))
                continue
            match message:
                case Reply():
                    return message
                case StationChange(kind, mac):
                    self._changed.add(mac)
                    self._emit(kind, mac, out)
                    self._ok()
                case Terminating():
                    raise _RestartedError

    def _emit(self, kind: Literal["joined", "left"], mac: str, out: DropOldestQueue[StationEvent]) -> None:
        if kind == "joined":
            self._present.add(mac)
        else:
            self._present.discard(mac)
        self.health.counters[kind] += 1
        out.put(StationEvent(time.monotonic_ns(), kind, mac, self._interface))

    def _ok(self) -> None:
        self.health.ok(f"{len(self._present)} stations")

    def _bad_input(self, what: str) -> None:
        level = logging.DEBUG if self.health.counters["bad_input"] else logging.WARNING
        self.health.counters["bad_input"] += 1
        _log.log(level, "%s: %s", self._path, what)

    def _trouble(self, reason: str) -> None:
        level = logging.WARNING if self.health.trouble(reason) else logging.DEBUG
        _log.log(level, "%s: %s", self._path, reason)


class _Link:
    """A connected datagram socket, and which file it was connected to."""

    def __init__(self, sock: socket.socket, path: Path) -> None:
        self._sock = sock
        self._path = path
        self._inode = path.stat().st_ino
        # A cancelled sock_recv may lose a datagram; a queue does not.
        self._inbox: DropOldestQueue[bytes] = DropOldestQueue(_INBOX)

    def readable(self) -> None:
        """Take what has arrived (reader callback)."""
        with contextlib.suppress(BlockingIOError):
            while True:
                self._inbox.put(self._sock.recv(_DATAGRAM_BYTES))

    def check_same(self) -> None:
        """Raise where another hostapd has made the socket anew; the old one may still answer or be mute."""
        if self._path.stat().st_ino != self._inode:
            raise _RestartedError

    def send(self, command: bytes) -> None:
        self._sock.send(command)

    async def receive(self) -> bytes:
        return await self._inbox.get()


@contextlib.asynccontextmanager
async def _connected(path: Path, own_dir: Path) -> AsyncIterator[_Link]:
    """A link from a socket of our own, which hostapd needs for its answers; both are gone afterwards."""
    loop = asyncio.get_running_loop()
    own_path = own_dir / f"vad-hostapd-{secrets.token_hex(6)}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.setblocking(False)
        sock.bind(str(own_path))
        try:
            sock.connect(str(path))
            link = _Link(sock, path)
            loop.add_reader(sock, link.readable)
            yield link
        finally:
            loop.remove_reader(sock)
            with contextlib.suppress(OSError):  # hostapd may be gone
                sock.send(DETACH)
            own_path.unlink(missing_ok=True)


def _reason(error: OSError | SourceError | ProtocolError) -> str:
    match error:
        case FileNotFoundError():
            return "the control socket is not there. Set ctrl_interface in hostapd.conf; is hostapd running?"
        case ConnectionRefusedError():
            return "nobody answers on the control socket. Is hostapd running?"
        case PermissionError():
            return "the control socket may not be used. Set ctrl_interface_group in hostapd.conf to our group"
        case _:
            return str(error)
