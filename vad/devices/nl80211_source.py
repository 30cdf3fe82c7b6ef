"""Stations that join, from the kernel itself: for access points without hostapd's control socket."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import os
import socket
import time
from collections.abc import AsyncIterator, Callable, Sequence
from typing import Literal

from vad.devices import nl80211
from vad.devices.nl80211 import Family, Finished, Interface, Message, StationSeen
from vad.devices.station import StationEvent
from vad.errors import ProtocolError, SourceError
from vad.health import Health
from vad.streams import DropOldestQueue

ASK_FIRST_S = 0.02
"""After a station associated: was it let in? Asked so soon ..."""
ASK_FACTOR = 2.0
ASK_LAST_S = 1.0
ASK_NO_MORE_S = 20.0
"""... and ever more rarely, until no handshake takes so long."""
LOOK_S = 2.0
"""How often an interface that is no access point is looked at again: that it became one, no event tells."""
REPLY_S = 2.0
RETRY_FIRST_S = 0.5
RETRY_FACTOR = 2.0
RETRY_MAX_S = 10.0

_NETLINK_GENERIC = 16
_SOL_NETLINK, _ADD_MEMBERSHIP = 270, 1
_RECEIVE_BUFFER = 1 << 20
_DATAGRAM_BYTES = 1 << 16
_INBOX = 4096
_MAX_STATIONS = 4096

_log = logging.getLogger(__name__)

Station = tuple[int, str]
"""Index of the interface, MAC."""


def open_netlink() -> socket.socket:
    """A generic netlink socket, not blocking."""
    sock = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, _NETLINK_GENERIC)
    sock.setblocking(False)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
    sock.bind((0, 0))
    return sock


class Nl80211Source:
    """A JoinSource for the kernel's access point interfaces with these names; needs no rights.

    A station counts as joined when it was let in. Those in at the start are emitted; interfaces may come,
    go and become access points later.
    """

    def __init__(
        self, interfaces: Sequence[str], *, opened: Callable[[], socket.socket] = open_netlink
    ) -> None:
        self.health = Health("nl80211")
        self._names = tuple(interfaces)
        self._opened = opened
        self._interfaces: dict[int, str] = {}
        self._present: dict[Station, str] = {}  # with the interface's name
        self._asked: dict[Station, float] = {}  # associated, maybe not let in yet: until when it is asked for
        self._changed: set[Station] = set()
        self._ask_s = ASK_FIRST_S
        self._reread = False
        self._family = 0
        self._seq = 0

    async def run(self, out: DropOldestQueue[StationEvent]) -> None:
        """Emit events into `out` until cancelled; trouble goes into `health`, never out of here."""
        retry_s = RETRY_FIRST_S
        while True:
            try:
                async with _connected(self._opened) as link:
                    await self._begin(link, out)
                    retry_s = RETRY_FIRST_S
                    await self._listen(link, out)
            except TimeoutError:
                self._trouble(f"the kernel gives no reply for {REPLY_S:g} s")
            except SourceError as error:
                self._trouble(str(error))
            except OSError as error:
                self._trouble(f"netlink fails: {error.strerror}")
            await asyncio.sleep(retry_s)
            retry_s = min(retry_s * RETRY_FACTOR, RETRY_MAX_S)

    async def _begin(self, link: _Link, out: DropOldestQueue[StationEvent]) -> None:
        self._family, self._asked = 0, {}
        found = [m for m in await self._ask(link, nl80211.family_request, out) if isinstance(m, Family)]
        if not found:
            raise SourceError("the kernel has no nl80211. Is a Wi-Fi card in, and its driver loaded?")
        self._family = found[0].id
        for group in nl80211.GROUPS:
            link.join(found[0].groups[group])
        await self._read_interfaces(link, out)

    async def _read_interfaces(self, link: _Link, out: DropOldestQueue[StationEvent]) -> None:
        """Which of our interfaces are access points now, and who is in there."""
        self._reread = False
        answer = await self._ask(link, lambda seq: nl80211.interfaces_request(self._family, seq), out)
        ours = {m.name: m for m in answer if isinstance(m, Interface) and m.name in self._names}
        self._interfaces = {m.index: m.name for m in ours.values() if m.access_point}
        for station in [one for one in self._present if one[0] not in self._interfaces]:
            self._left(station, out)
        self._asked = {one: until_s for one, until_s in self._asked.items() if one[0] in self._interfaces}
        for index in list(self._interfaces):
            await self._list(link, index, out)
        missing = [name for name in self._names if name not in ours]
        idle = [name for name, interface in ours.items() if not interface.access_point]
        if missing:
            self._trouble(f"there is no wireless interface {missing[0]}. `iw dev` lists them")
        elif idle:
            self._trouble(f"{idle[0]} is no access point. Does hostapd run on it?")
        else:
            self._ok()

    async def _list(self, link: _Link, index: int, out: DropOldestQueue[StationEvent]) -> None:
        """Compare the kernel's list of stations with what was emitted."""
        self._changed.clear()
        answer = await self._ask(link, lambda seq: nl80211.stations_request(self._family, seq, index), out)
        listed = {(index, m.mac): m.authorized is not False for m in answer if isinstance(m, StationSeen)}
        for station, authorized in listed.items():
            if station in self._changed:
                continue  # what happened while the list was read is newer than the list
            if authorized:
                self._asked.pop(station, None)
                self._joined(station, out)
        for station in [one for one in self._present if one[0] == index]:
            if station not in listed and station not in self._changed:
                self._left(station, out)

    async def _listen(self, link: _Link, out: DropOldestQueue[StationEvent]) -> None:
        loop = asyncio.get_running_loop()
        while True:
            if self._reread:
                await self._read_interfaces(link, out)
            try:
                async with asyncio.timeout(self._patience_s()):
                    self._event(await self._next(link), out)
            except TimeoutError:
                self._reread = self.health.state != "ok"
                self._ask_s = min(self._ask_s * ASK_FACTOR, ASK_LAST_S)
                for index in {index for index, _ in self._asked}:
                    await self._list(link, index, out)
                now_s = loop.time()
                self._asked = {one: until_s for one, until_s in self._asked.items() if until_s > now_s}

    def _patience_s(self) -> float | None:
        """How long nothing is asked where nothing comes; None: for ever."""
        if self._asked:
            return self._ask_s
        return None if self.health.state == "ok" else LOOK_S

    async def _ask(
        self, link: _Link, request: Callable[[int], bytes], out: DropOldestQueue[StationEvent]
    ) -> list[Message]:
        """All that is answered to a request; events are handled on the way."""
        self._seq = self._seq % 0x7FFF_FFFF + 1
        answer: list[Message] = []
        async with asyncio.timeout(REPLY_S):
            link.send(request(self._seq))
            while True:
                message = await self._next(link)
                match message:
                    case Finished(seq, error) if seq == self._seq:
                        if error and self._family:  # the interface went meanwhile: begin anew
                            raise SourceError(f"the kernel refuses to answer: {os.strerror(error)}")
                        return answer
                    case Family():
                        return [message]
                    case Interface(seq) | StationSeen(seq) if seq == self._seq:
                        if len(answer) < _MAX_STATIONS:
                            answer.append(message)
                    case _:
                        self._event(message, out)

    async def _next(self, link: _Link) -> Message:
        while True:
            while link.messages:
                return link.messages.pop(0)
            try:
                link.messages += nl80211.parse_datagram(await link.receive(), self._family or None)
            except ProtocolError as error:
                self._bad_input(str(error))

    def _event(self, message: Message, out: DropOldestQueue[StationEvent]) -> None:
        """What the kernel tells by itself."""
        if isinstance(message, Interface):
            self._reread = True
        if not isinstance(message, StationSeen):
            return
        station = (message.index, message.mac)
        self._changed.add(station)
        if message.index not in self._interfaces:
            self._reread = True  # it may have become an access point
        elif not message.present:
            self._asked.pop(station, None)
            self._left(station, out)
        elif station not in self._present and len(self._asked) < _MAX_STATIONS:
            self._asked[station] = asyncio.get_running_loop().time() + ASK_NO_MORE_S
            self._ask_s = ASK_FIRST_S

    def _joined(self, station: Station, out: DropOldestQueue[StationEvent]) -> None:
        if station not in self._present:
            self._present[station] = self._interfaces[station[0]]
            self._emit("joined", station[1], self._present[station], out)

    def _left(self, station: Station, out: DropOldestQueue[StationEvent]) -> None:
        interface = self._present.pop(station, None)
        if interface is not None:
            self._emit("left", station[1], interface, out)

    def _emit(
        self, kind: Literal["joined", "left"], mac: str, interface: str, out: DropOldestQueue[StationEvent]
    ) -> None:
        self.health.counters[kind] += 1
        out.put(StationEvent(time.monotonic_ns(), kind, mac, interface))
        if self.health.state == "ok":
            self._ok()

    def _ok(self) -> None:
        self.health.ok(f"{len(self._present)} stations")

    def _bad_input(self, what: str) -> None:
        level = logging.DEBUG if self.health.counters["bad_input"] else logging.WARNING
        self.health.counters["bad_input"] += 1
        _log.log(level, "nl80211: %s", what)

    def _trouble(self, reason: str) -> None:
        level = logging.WARNING if self.health.trouble(reason) else logging.DEBUG
        _log.log(level, "nl80211: %s", reason)


class _Link:
    """An open netlink socket and what has arrived on it."""

    def __init__(self, sock: socket.socket) -> None:
        self.messages: list[Message] = []
        self._sock = sock
        self._inbox: DropOldestQueue[bytes | OSError] = DropOldestQueue(_INBOX)

    def readable(self) -> None:
        """Take what has arrived (reader callback)."""
        try:
            while True:
                data, sender = self._sock.recvfrom(_DATAGRAM_BYTES)
                if not data:
                    raise ConnectionResetError(errno.ECONNRESET, os.strerror(errno.ECONNRESET))
                if (
                    not isinstance(sender, tuple) or sender[0] == 0
                ):  # 0: the kernel; others may send here, too
                    self._inbox.put(data)
        except BlockingIOError:
            return
        except OSError as error:  # ENOBUFS: something was lost, so everything is read anew
            self._inbox.put(error)

    def join(self, group: int) -> None:
        """Receive a multicast group."""
        self._sock.setsockopt(_SOL_NETLINK, _ADD_MEMBERSHIP, group)

    def send(self, request: bytes) -> None:
        self._sock.send(request)

    async def receive(self) -> bytes:
        found = await self._inbox.get()
        if isinstance(found, OSError):
            raise found
        return found


@contextlib.asynccontextmanager
async def _connected(opened: Callable[[], socket.socket]) -> AsyncIterator[_Link]:
    loop = asyncio.get_running_loop()
    with opened() as sock:
        link = _Link(sock)
        loop.add_reader(sock, link.readable)
        try:
            yield link
        finally:
            loop.remove_reader(sock)
