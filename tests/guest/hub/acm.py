"""A Neato Botvac's USB port: a CDC-ACM device that the kernel's cdc-acm drives as /dev/ttyACM0."""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable

from usbip import LANGUAGES, UsbDevice, configuration, device_descriptor, endpoint, interface, text

_COMMUNICATION, _DATA = 0x02, 0x0A
_NOTIFY_IN, _BULK_IN, _BULK_OUT = 0x83, 0x81, 0x02
_VENDOR, _PRODUCT = 0x2108, 0x780B
_SET_LINE_CODING, _GET_LINE_CODING = 0x20, 0x21
_115200_8N1 = struct.pack("<IBBB", 115_200, 0, 0, 8)


class AcmDevice(UsbDevice):
    """reply(command, t_ns): what the robot answers to a line. mute: hear everything and say nothing."""

    def __init__(self, reply: Callable[[str, int], bytes]) -> None:
        super().__init__()
        self.mute = False
        self._reply = reply
        self._line = bytearray()
        self._coding = _115200_8N1
        self._commands: list[str] = []
        self._heard = threading.Condition()
        functions = struct.pack("<BBBH", 5, 0x24, 0, 0x110) + struct.pack("<5B", 5, 0x24, 1, 0, 1)
        functions += struct.pack("<4B", 4, 0x24, 2, 2) + struct.pack("<5B", 5, 0x24, 6, 0, 1)
        body = interface(0, 0, 1, (_COMMUNICATION, 2, 1)) + functions + endpoint(_NOTIFY_IN, 3, 16)
        body += interface(1, 0, 2, (_DATA, 0, 0)) + endpoint(_BULK_IN, 2, 512) + endpoint(_BULK_OUT, 2, 512)
        self._configuration = configuration(2, body, 0xC0, 50)
        threading.Thread(target=self._talk, daemon=True).start()

    def descriptor(self, kind: int, index: int) -> bytes | None:
        device = device_descriptor(0x200, (_COMMUNICATION, 0, 0), 64, _VENDOR, _PRODUCT)
        qualifier = struct.pack("<BBHBBBBBB", 10, 6, 0x200, _COMMUNICATION, 0, 0, 64, 1, 0)
        strings = {0: LANGUAGES, 1: text("Neato Robotics"), 2: text("Botvac emulated"), 3: text("0001")}
        return {1: device, 2: self._configuration, 6: qualifier, 3: strings.get(index)}.get(kind)

    def request(self, kind: int, request: int, value: int, index: int, data: bytes) -> bytes | None:
        if request == _GET_LINE_CODING and kind & 0x60:
            return self._coding
        if request == _SET_LINE_CODING and kind & 0x60:
            self._coding = data
        return b""

    def written(self, endpoint: int, data: bytes) -> None:
        for byte in data:
            if byte == ord("\n"):
                with self._heard:
                    self._commands.append(self._line.decode("ascii", "replace").rstrip("\r"))
                    self._heard.notify()
                self._line.clear()
            else:
                self._line.append(byte)

    def _talk(self) -> None:
        while True:
            with self._heard:
                self._heard.wait_for(lambda: self._commands)
                command = self._commands.pop(0)
            if not self.mute:
                self.answer(_BULK_IN, self._reply(command, time.monotonic_ns()))
