"""A Kinect v2 behind pyusb's back-end interface: no libusb, no kernel; every byte of the protocol."""

from __future__ import annotations

import array
import errno
import struct
import threading
import time
from collections import deque
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import usb.backend
import usb.core

_COMMAND_MAGIC, _ANSWER_MAGIC = 0x06022009, 0x0A6FE000
_TRANSFER = 0x4000


def packet(sequence: int, ticks: int, jpeg: bytes, *, exposure_ms: float = 12.5, gain: float = 1.25) -> bytes:
    """One colour picture as the sensor sends it."""
    body = struct.pack("<II", sequence, 0x42424242) + jpeg + b"\xa5" * (-len(jpeg) % 4)
    filler = -(len(body) + 56) % 256
    total = len(body) + filler + 56
    head = (0x39393939, sequence, filler, 0, 0, ticks, exposure_ms, gain, 0x42424242, total, 1.0, 0, 0, 0)
    return body + b"Z" * filler + struct.pack("<6IffIIf3I", *head)


class Kinect(usb.backend.IBackend):  # type: ignore[misc]
    """The device and its bus. `plug(False)` unplugs it; `send` queues a picture once it streams.

    Attributes: serial; log: what the host did, in order; streaming; busy_polls: READY says no so often;
    transfers: of colour, how many the host took; aborts: the host did what ends its process with some
    versions of libusb.
    """

    def __init__(self, serial: str = "012345678947", product: int = 0x02C4) -> None:
        self.serial = serial
        self.product = product
        self.log: list[tuple[Any, ...]] = []
        self.streaming = threading.Event()
        self.busy_polls = 2
        self.transfers = 0
        self.forbidden = False
        self.aborts = False
        self._plugged = True
        self._configured = 0
        self._suspended = True
        self._answers: deque[bytes] = deque()
        self._colour: deque[bytes] = deque()
        self._change = threading.Condition()

    # What the test does.

    def plug(self, plugged: bool) -> None:
        with self._change:
            self._plugged, self._configured = plugged, 0
            self.streaming.clear()
            self._answers.clear()
            self._colour.clear()
            self._change.notify_all()

    def send(self, data: bytes, size: int = _TRANSFER) -> None:
        """Queue bytes in transfers of `size`; the last is short, as the end of a packet is on the bus."""
        with self._change:
            for k in range(0, len(data), size):
                self._colour.append(data[k : k + size])
            self._change.notify_all()

    def leave_stale_answer(self) -> None:
        with self._change:
            self._answers.append(struct.pack("<4I", _ANSWER_MAGIC, 999, 0, 0))

    # What pyusb asks.

    def enumerate_devices(self) -> Iterator[str]:
        return iter(["kinect"] if self._plugged else [])

    def get_device_descriptor(self, device: str) -> SimpleNamespace:
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x300, bDeviceClass=0xEF, bDeviceSubClass=2,
            bDeviceProtocol=1, bMaxPacketSize0=9, idVendor=0x045E, idProduct=self.product, bcdDevice=0x100,
            iManufacturer=1, iProduct=2, iSerialNumber=3, bNumConfigurations=1, address=1, bus=1,
            port_number=1, port_numbers=(1,), speed=4,
        )  # fmt: skip

    def get_configuration_descriptor(self, device: str, number: int) -> SimpleNamespace:
        if number:
            raise IndexError
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=100, bNumInterfaces=2, bConfigurationValue=1,
            iConfiguration=0, bmAttributes=0xC0, bMaxPower=1, extra_descriptors=[],
        )  # fmt: skip

    def get_interface_descriptor(
        self, device: str, number: int, alternate: int, config: int
    ) -> SimpleNamespace:
        endpoints = {0: [4], 1: [0, 1]}
        if number not in endpoints or alternate >= len(endpoints[number]):
            raise IndexError
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=number, bAlternateSetting=alternate,
            bNumEndpoints=endpoints[number][alternate], bInterfaceClass=255, bInterfaceSubClass=0,
            bInterfaceProtocol=0, iInterface=0, extra_descriptors=[],
        )  # fmt: skip

    def get_endpoint_descriptor(
        self, device: str, endpoint: int, number: int, alternate: int, config: int
    ) -> SimpleNamespace:
        rows = (
            [(0x81, 2, 1024), (2, 2, 1024), (0x83, 2, 1024), (0x82, 3, 64)]
            if number == 0
            else [(0x84, 1, 1024)]
        )
        address, kind, size = rows[endpoint]
        return SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=address, bmAttributes=kind, wMaxPacketSize=size,
            bInterval=0, bRefresh=0, bSynchAddress=0, extra_descriptors=[],
        )  # fmt: skip

    def open_device(self, device: str) -> str:
        if self.forbidden:
            raise usb.core.USBError("Access denied", -3, errno.EACCES)
        self.log.append(("open",))
        return "handle"

    def close_device(self, handle: str) -> None:
        self.log.append(("close",))

    def get_configuration(self, handle: str) -> int:
        self._there()
        return self._configured

    def set_configuration(self, handle: str, value: int) -> None:
        self._configured = value
        self.log.append(("configuration", value))

    def claim_interface(self, handle: str, number: int) -> None:
        self.log.append(("claim", number))

    def release_interface(self, handle: str, number: int) -> None:
        self.log.append(("release", number))

    def set_interface_altsetting(self, handle: str, number: int, alternate: int) -> None:
        # With the device gone libusb 1.0.26 (Debian 12) keeps a lock here, and closing aborts the process.
        self.aborts = self.aborts or not self._plugged
        self._there()
        self.log.append(("alternate", number, alternate))

    def ctrl_transfer(
        self, handle: str, kind: int, request: int, value: int, index: int, data: Any, timeout: int
    ) -> int:
        self._there()
        if kind == 0x80 and request == 6:  # descriptor: only strings are asked for here
            text = self.serial.encode("utf-16-le") if value & 0xFF else b"\x09\x04"
            answer = bytes([len(text) + 2, 3]) + text
            data[: len(answer)] = array.array("B", answer)
            return len(answer)
        if (kind, request, value) == (1, 3, 0):
            self._suspended = index != 0
        self.log.append(("control", kind, request, value, index))
        return 0

    def bulk_write(self, handle: str, endpoint: int, interface: int, data: Any, timeout: int) -> int:
        self._there()
        assert endpoint == 0x02
        assert not self._suspended
        magic, sequence, most, number, zero = struct.unpack_from("<5I", bytes(data))
        assert (magic, zero) == (_COMMAND_MAGIC, 0)
        parameters = struct.unpack_from(f"<{(len(data) - 20) // 4}I", bytes(data), 20)
        self.log.append(("command", number, *parameters))
        with self._change:
            if most:
                self._answers.append(self._answer(number, parameters)[:most])
            self._answers.append(struct.pack("<4I", _ANSWER_MAGIC, sequence, 0, 0))
        if number == 0x2B:
            (self.streaming.set if parameters == (1,) else self.streaming.clear)()
        return len(data)

    def _answer(self, number: int, parameters: tuple[int, ...]) -> bytes:
        if number == 0x22:
            return self.serial.encode("utf-16-le").ljust(0x80, b"\0")
        if number == 0x16:
            self.busy_polls -= 1
            return struct.pack("<I", self.busy_polls < 0)
        return bytes(0x200)

    def bulk_read(self, handle: str, endpoint: int, interface: int, buffer: Any, timeout: int) -> int:
        queue = {0x81: self._answers, 0x83: self._colour}[endpoint]
        deadline = time.monotonic() + timeout / 1000
        with self._change:
            while not queue:
                self._there()
                left = deadline - time.monotonic()
                if left <= 0 or endpoint == 0x81:
                    raise usb.core.USBTimeoutError("timed out", -7, errno.ETIMEDOUT)
                self._change.wait(left)
            data = queue.popleft()
        self.transfers += endpoint == 0x83
        assert len(data) <= len(buffer), "the host's buffer would overflow"
        buffer[: len(data)] = array.array("B", data)
        return len(data)

    def _there(self) -> None:
        if not self._plugged:
            raise usb.core.USBError("No such device (it may have been disconnected)", -4, errno.ENODEV)
