"""A kernel with Wi-Fi, byte by byte: generic netlink over a socket pair. Built without pyroute2."""

from __future__ import annotations

import asyncio
import socket
import struct
from collections.abc import Iterable

FAMILY, MLME, CONFIG = 30, 7, 5
STATION, ACCESS_POINT = 2, 3
AUTHORIZED = 1 << 1


def attribute(kind: int, value: bytes) -> bytes:
    """One netlink attribute, padded."""
    return struct.pack("=HH", 4 + len(value), kind) + value + bytes(-len(value) % 4)


def message(kind: int, command: int, *attributes: bytes, seq: int = 0, flags: int = 0) -> bytes:
    """One generic netlink message."""
    body = struct.pack("=BBH", command, 1, 0) + b"".join(attributes)
    return struct.pack("=IHHII", 16 + len(body), kind, flags, seq, 0) + body


def interface(index: int, name: str, kind: int, *, seq: int = 0, command: int = 7) -> bytes:
    """NEW_INTERFACE (or another command) as the kernel sends it."""
    return message(
        FAMILY,
        command,
        attribute(1, struct.pack("=I", 0)),
        attribute(3, struct.pack("=I", index)),
        attribute(4, name.encode() + b"\0"),
        attribute(5, struct.pack("=I", kind)),
        seq=seq,
    )


def station(index: int, mac: str, authorized: bool | None, *, seq: int = 0, gone: bool = False) -> bytes:
    """NEW_STATION or DEL_STATION; an event tells no flags (authorized None)."""
    info = attribute(1, struct.pack("=I", 10))
    if authorized is not None:
        info += attribute(17, struct.pack("=II", 0xFF, AUTHORIZED if authorized else 0))
    return message(
        FAMILY,
        20 if gone else 19,
        attribute(3, struct.pack("=I", index)),
        attribute(6, bytes.fromhex(mac.replace(":", ""))),
        attribute(46, struct.pack("=I", 5)),
        attribute(21, info),
        seq=seq,
    )


def family(seq: int) -> bytes:
    """The answer to GETFAMILY."""
    groups = b"".join(
        attribute(n, attribute(2, struct.pack("=I", number)) + attribute(1, name + b"\0"))
        for n, (name, number) in enumerate(((b"config", CONFIG), (b"mlme", MLME)), start=1)
    )
    return message(
        16,
        1,
        attribute(2, b"nl80211\0"),
        attribute(1, struct.pack("=H", FAMILY)),
        attribute(7, groups),
        seq=seq,
    )


def done(seq: int) -> bytes:
    """NLMSG_DONE."""
    return struct.pack("=IHHIIi", 20, 3, 2, seq, 0, 0)


def refusal(seq: int, error: int) -> bytes:
    """NLMSG_ERROR."""
    return struct.pack("=IHHIIi", 36, 2, 0, seq, 0, -error) + bytes(16)


class _Netlink(socket.socket):
    """Our end: a netlink socket as far as the source can tell."""

    memberships: list[tuple[int, ...]]

    def setsockopt(self, *option: int) -> None:  # type: ignore[override]
        self.memberships.append(option)


class FakeKernel:
    """interfaces: index -> (name, kind); stations: index -> MAC -> let in; `opened` gives our end."""

    def __init__(self) -> None:
        self.interfaces: dict[int, tuple[str, int]] = {}
        self.stations: dict[int, dict[str, bool]] = {}
        self.has_wifi = True
        self.mute = False
        self.lists = 0
        self.memberships: list[tuple[int, ...]] = []
        self._ours: socket.socket | None = None

    def opened(self) -> socket.socket:
        """A fresh connection; the one before is cut."""
        self.close()
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for sock in (ours, theirs):
            sock.setblocking(False)
        self._ours = ours
        asyncio.get_running_loop().add_reader(ours, self._serve)
        client = _Netlink(theirs.family, theirs.type, 0, theirs.detach())
        client.memberships = self.memberships = []
        return client

    def close(self) -> None:
        """Cut the connection."""
        if self._ours is not None:
            asyncio.get_running_loop().remove_reader(self._ours)
            self._ours.close()
            self._ours = None

    def associate(self, index: int, mac: str, *, authorized: bool = False) -> None:
        """A station associates; it may be let in at once."""
        self.stations.setdefault(index, {})[mac] = authorized
        self.send([station(index, mac, None)])

    def leave(self, index: int, mac: str) -> None:
        """A station goes."""
        del self.stations[index][mac]
        self.send([station(index, mac, None, gone=True)])

    def send(self, messages: Iterable[bytes]) -> None:
        """One datagram of these messages."""
        assert self._ours is not None
        self._ours.send(b"".join(messages))

    def _serve(self) -> None:
        assert self._ours is not None
        try:
            data = self._ours.recv(65_536)
        except OSError:
            data = b""
        if not data:
            self.close()
            return
        length, kind, _, seq, _ = struct.unpack_from("=IHHII", data)
        command = data[16]
        assert length == len(data)
        if self.mute:
            return
        if kind == 16:
            assert data[20:].endswith(b"nl80211\0")
            self.send([family(seq)] if self.has_wifi else [refusal(seq, 2)])
        elif command == 5:
            self.send(interface(i, name, k, seq=seq) for i, (name, k) in self.interfaces.items())
            self.send([done(seq)])
        elif command == 17:
            self.lists += 1
            (index,) = struct.unpack_from("=I", data, 24)
            if index not in self.interfaces:
                self.send([refusal(seq, 19)])
                return
            for mac, authorized in self.stations.get(index, {}).items():
                self.send([station(index, mac, authorized, seq=seq)])
            self.send([done(seq)])
