"""A UVC camera that sends numbered MJPEG pictures over a bulk endpoint; the kernel's uvcvideo drives it."""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable

from usbip import (
    LANGUAGES,
    UsbDevice,
    configuration,
    device_descriptor,
    endpoint,
    interface,
    text,
)

_VIDEO, _CONTROL, _STREAMING = 0x0E, 1, 2
_IN = 0x81
_SET, _GET_LENGTH, _GET_INFO = 0x01, 0x85, 0x86
_PROBE, _COMMIT = 1, 2
_MOST = 0x100000


class UvcCamera(UsbDevice):
    """picture(k): the JPEG of the k-th picture, width x height. sent: monotonic ns of each, by number."""

    def __init__(self, picture: Callable[[int], bytes], width: int, height: int, fps: float) -> None:
        super().__init__()
        self.sent: dict[int, int] = {}
        self._picture, self._width, self._height = picture, width, height
        self._interval = round(1e7 / fps)
        self._device = device_descriptor(0x200, (0xEF, 2, 1), 64, 0x1234, 0x5678)
        self._configuration = self._describe()
        threading.Thread(target=self._pump, daemon=True).start()

    def _describe(self) -> bytes:
        w, h, interval = self._width, self._height, self._interval
        units = struct.pack("<BBBBBBBBHHHBH", 17, 0x24, 2, 1, 1, 2, 0, 0, 0, 0, 0, 2, 0)
        units += struct.pack("<9B", 9, 0x24, 3, 2, 1, 1, 0, 1, 0)
        control = struct.pack("<BBBHHIBB", 13, 0x24, 1, 0x100, 13 + len(units), 48_000_000, 1, 1) + units
        sizes = (w, h, w * h * 8, w * h * 160, w * h * 2, interval, 1, interval)
        frame = struct.pack("<BBBBBHHIIIIBI", 30, 0x24, 7, 1, 0, *sizes)
        formats = struct.pack("<11B", 11, 0x24, 6, 1, 1, 1, 1, 0, 0, 0, 0) + frame
        formats += struct.pack("<6B", 6, 0x24, 13, 1, 1, 4)
        head = struct.pack("<BBBBHBBBBBBBB", 14, 0x24, 1, 1, 14 + len(formats), _IN, 0, 2, 0, 0, 0, 1, 0)
        body = struct.pack("<8B", 8, 11, 0, 2, _VIDEO, 3, 0, 2)
        body += interface(0, 0, 0, (_VIDEO, _CONTROL, 0)) + control
        body += interface(1, 0, 1, (_VIDEO, _STREAMING, 0)) + head + formats + endpoint(_IN, 2, 512)
        return configuration(2, body, 0x80, 250)

    def descriptor(self, kind: int, index: int) -> bytes | None:
        qualifier = struct.pack("<BBHBBBBBB", 10, 6, 0x200, 0xEF, 2, 1, 64, 1, 0)
        strings = {0: LANGUAGES, 1: text("vad"), 2: text("emulated camera"), 3: text("0001")}
        return {1: self._device, 2: self._configuration, 6: qualifier, 3: strings.get(index)}.get(kind)

    def request(self, kind: int, request: int, value: int, index: int, data: bytes) -> bytes | None:
        if kind & 0x60 == 0:
            return b""
        if index & 0xFF != 1 or value >> 8 not in (_PROBE, _COMMIT):
            return None
        if request == _SET:
            return b""
        if request == _GET_INFO:
            return b"\x03"
        if request == _GET_LENGTH:
            return struct.pack("<H", 26)
        size = self._width * self._height * 2
        return struct.pack("<HBBIHHHHHII", 1, 1, 1, self._interval, 0, 0, 0, 0, 0, size, _MOST)

    def _pump(self) -> None:
        k, toggle = 0, 0
        due = time.monotonic()
        while True:
            due = max(due + 1e-7 * self._interval, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
            with self.lock:
                wanted = self.plugged and bool(self._waiting[_IN])
            if not wanted:
                continue
            payload = bytes([2, 0x82 | toggle]) + self._picture(k)
            payload += b"\0" if len(payload) % 512 == 0 else b""
            self.sent[k] = time.monotonic_ns()
            self.answer(_IN, payload)
            k, toggle = k + 1, toggle ^ 1
