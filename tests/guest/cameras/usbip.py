"""USB devices made in Python, attached to the kernel's vhci_hcd through a socket pair: no network, no tool.

The kernel then sees a device being plugged in, its real drivers bind, and `unplug` is a real unplug.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
from collections import defaultdict, deque
from pathlib import Path

_VHCI = Path("/sys/devices/platform/vhci_hcd.0")
_SUBMIT, _UNLINK, _RETURN, _UNLINKED = 1, 2, 3, 4
_PORT_FREE = 4
_STALL, _CANCELLED = -32, -104
HIGH_SPEED, SUPER_SPEED = 3, 5


class UsbDevice:
    """One device. A kind gives `descriptor`, `request`, `written` and calls `answer` on its endpoints."""

    speed = HIGH_SPEED
    number = 2

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.plugged = False
        self._waiting: dict[int, deque[tuple[int, int]]] = defaultdict(deque)
        self._arrived = threading.Condition(self.lock)
        self._socket: socket.socket | None = None
        self._port = 0

    # What a kind of device gives.

    def descriptor(self, kind: int, index: int) -> bytes | None:
        """A descriptor; None stalls."""
        raise NotImplementedError

    def request(self, kind: int, request: int, value: int, index: int, data: bytes) -> bytes | None:
        """Answer a class or vendor request, or take note of a standard one; None stalls."""
        raise NotImplementedError

    def written(self, endpoint: int, data: bytes) -> None:
        """The host has written to a bulk endpoint."""

    # The bus.

    def plug(self) -> None:
        """Plug it in."""
        ours, kernels = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket, self.plugged = ours, True
        hub = "ss" if self.speed >= SUPER_SPEED else "hs"
        for line in (_VHCI / "status").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[0] == hub and int(fields[2]) == _PORT_FREE:
                self._port = int(fields[1])
                break
        else:
            raise RuntimeError("vhci_hcd has no free port")
        self.number += 1
        identity = 0x00010000 | self.number
        (_VHCI / "attach").write_text(f"{self._port} {kernels.fileno()} {identity} {self.speed}")
        kernels.close()
        threading.Thread(target=self._serve, args=(ours,), daemon=True).start()

    def unplug(self) -> None:
        """Pull it out."""
        (_VHCI / "detach").write_text(str(self._port))
        with self.lock:
            self.plugged = False
            self._waiting.clear()
            self._arrived.notify_all()

    def answer(self, endpoint: int, data: bytes, timeout_s: float = 1.0) -> bool:
        """Give bytes to the host's reads of an endpoint, as many reads as it takes; False where none came."""
        at = 0
        while at < len(data):
            with self.lock:
                there = self._arrived.wait_for(lambda: self._waiting[endpoint] or not self.plugged, timeout_s)
                if not there or not self.plugged:
                    return False
                sequence, length = self._waiting[endpoint].popleft()
                self._return(sequence, 0, data[at : at + length])
                at += length
        return True

    def _serve(self, link: socket.socket) -> None:
        with contextlib.suppress(EOFError, OSError), link:
            while True:
                head = _read(link, 48)
                command, sequence, _, inward, endpoint = struct.unpack_from(">5I", head)
                if command == _SUBMIT:
                    length = struct.unpack_from(">i", head, 24)[0]
                    data = _read(link, length) if not inward and length else b""
                    if endpoint == 0:
                        self._control(sequence, head[40:48], data)
                    elif inward:
                        with self.lock:
                            self._waiting[endpoint | 0x80].append((sequence, length))
                            self._arrived.notify_all()
                    else:
                        self._return(sequence, 0, b"", len(data))
                        self.written(endpoint, data)
                elif command == _UNLINK:
                    self._unlink(sequence, struct.unpack_from(">I", head, 20)[0])

    def _unlink(self, sequence: int, wanted: int) -> None:
        status = 0
        with self.lock:
            for queue in self._waiting.values():
                for entry in queue:
                    if entry[0] == wanted:
                        queue.remove(entry)
                        status = _CANCELLED
                        break
            self._send(struct.pack(">5Ii24x", _UNLINKED, sequence, 0, 0, 0, status))

    def _control(self, sequence: int, setup: bytes, data: bytes) -> None:
        kind, request, value, index, length = struct.unpack("<BBHHH", setup)
        answer: bytes | None
        if (kind, request) == (0x80, 6):
            answer = self.descriptor(value >> 8, value & 0xFF)
        elif kind & 0xE0 == 0x80:  # standard, to the host: status
            answer = b"\x01\x00"
        else:
            answer = self.request(kind, request, value, index, data)
        if answer is None:
            self._return(sequence, _STALL, b"")
        elif kind & 0x80:
            self._return(sequence, 0, answer[:length])
        else:
            self._return(sequence, 0, b"", len(data))

    def _return(self, sequence: int, status: int, data: bytes, actual: int | None = None) -> None:
        count = len(data) if actual is None else actual
        self._send(struct.pack(">5I5i8x", _RETURN, sequence, 0, 0, 0, status, count, 0, 0, 0) + data)

    def _send(self, data: bytes) -> None:
        with self.lock, contextlib.suppress(OSError):
            assert self._socket is not None
            self._socket.sendall(data)


def _read(link: socket.socket, count: int) -> bytes:
    data = bytearray()
    while len(data) < count:
        part = link.recv(count - len(data))
        if not part:
            raise EOFError
        data += part
    return bytes(data)


def device_descriptor(usb: int, triple: tuple[int, int, int], size: int, vendor: int, product: int) -> bytes:
    return struct.pack("<BBHBBBBHHHBBBB", 18, 1, usb, *triple, size, vendor, product, 0x100, 1, 2, 3, 1)


def configuration(interfaces: int, body: bytes, attributes: int, power: int) -> bytes:
    return struct.pack("<BBHBBBBB", 9, 2, 9 + len(body), interfaces, 1, 0, attributes, power) + body


def interface(number: int, alternate: int, endpoints: int, triple: tuple[int, int, int]) -> bytes:
    return struct.pack("<9B", 9, 4, number, alternate, endpoints, *triple, 0)


def endpoint(address: int, kind: int, size: int, *, super_speed: tuple[int, int, int] | None = None) -> bytes:
    data = struct.pack("<BBBBHB", 7, 5, address, kind, size, 1 if kind & 3 in (1, 3) else 0)
    return data + (struct.pack("<BBBBH", 6, 0x30, *super_speed) if super_speed is not None else b"")


def text(words: str) -> bytes:
    """A string descriptor."""
    data = words.encode("utf-16-le")
    return bytes([len(data) + 2, 3]) + data


LANGUAGES = b"\x04\x03\x09\x04"
