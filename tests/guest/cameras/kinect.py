"""The colour half of a Kinect v2 on the bus: what libusb and pyusb meet in the kernel (formats.md 9)."""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable

from usbip import (
    LANGUAGES,
    SUPER_SPEED,
    UsbDevice,
    configuration,
    device_descriptor,
    endpoint,
    interface,
    text,
)

_BOS = struct.pack("<BBHB", 5, 15, 22, 2) + struct.pack("<BBBI", 7, 16, 2, 2)
_BOS += struct.pack("<BBBBHBBH", 10, 16, 3, 0, 0x0E, 1, 10, 0x7FF)
_ANSWERS, _COLOUR = 0x81, 0x83
SERIAL = "012345678947"


def packet(sequence: int, ticks: int, jpeg: bytes) -> bytes:
    """One colour picture as the sensor sends it; its length is no multiple of a USB packet."""
    body = struct.pack("<II", sequence, 0x42424242) + jpeg + b"\xa5" * (-len(jpeg) % 4)
    filler = -(len(body) + 56) % 256
    filler += 64 if (len(body) + 56 + filler) % 1024 == 0 else 0
    total = len(body) + filler + 56
    footer = (0x39393939, sequence, filler, 0, 0, ticks, 12.5, 1.25, 0x42424242, total, 1.0, 0, 0, 0)
    return body + b"Z" * filler + struct.pack("<6IffIIf3I", *footer)


class Kinect(UsbDevice):
    """picture(k): the JPEG of the k-th picture. sent: monotonic ns of each, by number."""

    speed = SUPER_SPEED

    def __init__(self, picture: Callable[[int], bytes], fps: float) -> None:
        super().__init__()
        self.sent: dict[int, int] = {}
        self.commands: list[int] = []
        self._picture, self._fps = picture, fps
        self._streaming = False
        self._device = device_descriptor(0x300, (0xEF, 2, 1), 9, 0x045E, 0x02C4)
        vendor = (0xFF, 0, 0)
        body = struct.pack("<8B", 8, 11, 0, 2, 0xFF, 0, 0, 0) + interface(0, 0, 4, vendor)
        body += endpoint(_ANSWERS, 2, 1024, super_speed=(0, 0, 0)) + endpoint(
            2, 2, 1024, super_speed=(0, 0, 0)
        )
        body += endpoint(_COLOUR, 2, 1024, super_speed=(15, 0, 0)) + endpoint(
            0x82, 3, 64, super_speed=(0, 0, 64)
        )
        body += interface(1, 0, 0, vendor) + interface(1, 1, 1, vendor)
        body += endpoint(0x84, 1, 1024, super_speed=(10, 2, 0x8400))
        self._configuration = configuration(2, body, 0xC0, 1)
        threading.Thread(target=self._pump, daemon=True).start()

    def descriptor(self, kind: int, index: int) -> bytes | None:
        strings = {0: LANGUAGES, 1: text("Microsoft"), 2: text("Xbox NUI Sensor"), 3: text(SERIAL)}
        return {1: self._device, 2: self._configuration, 15: _BOS, 3: strings.get(index)}.get(kind)

    def request(self, kind: int, request: int, value: int, index: int, data: bytes) -> bytes | None:
        return b"" if kind & 0x60 == 0 else None

    def written(self, endpoint: int, data: bytes) -> None:
        magic, sequence, most, command, _ = struct.unpack_from("<5I", data)
        assert magic == 0x06022009
        parameter = struct.unpack_from("<I", data, 20)[0] if len(data) > 20 else 0
        self.commands.append(command)
        if command == 0x2B:
            self._streaming = parameter == 1
        answers = {0x22: SERIAL.encode("utf-16-le").ljust(0x80, b"\0"), 0x16: struct.pack("<I", 1)}
        closing = struct.pack("<4I", 0x0A6FE000, sequence, 0, 0)
        parts = [answers.get(command, bytes(most))[:most], closing] if most else [closing]
        # Answered from a thread of its own: the host reads only once its write has come back.
        threading.Thread(target=lambda: [self.answer(_ANSWERS, part) for part in parts], daemon=True).start()

    def unplug(self) -> None:
        self._streaming = False
        super().unplug()

    def _pump(self) -> None:
        k = 0
        start = due = time.monotonic()
        while True:
            due = max(due + 1.0 / self._fps, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
            if not (self._streaming and self.plugged):
                continue
            now = time.monotonic()
            ticks = int((now - start) * 8000) & 0xFFFFFFFF
            self.sent[k] = round(now * 1e9)
            self.answer(_COLOUR, packet(k, ticks, self._picture(k)))
            k += 1
