"""Poses as lines over a serial port, for robots that speak nothing else: bytes -> values, no I/O.

A line is JSON (the schema of `vad.robot.json_source`), `*`, four hexadecimal digits, and a line feed:

    {"x_m": 1.2, "y_m": -0.4, "yaw_rad": 1.57}*01DE

The digits are the CRC-16/XMODEM (polynomial 0x1021, start 0, not reflected) of the JSON's bytes, in either
case: `binascii.crc_hqx(line, 0)` in Python, `_crc_xmodem_update` in avr-libc. 8N1 at 115200 unless set
otherwise. Lines without a right checksum are counted and left out, so a console on the same port does no
harm.
"""

from __future__ import annotations

import binascii
import re

from vad.errors import ProtocolError
from vad.robot.json_source import MAX_PAYLOAD_BYTES, NoPlace, report_from_json
from vad.robot.pose import RobotPose

MAX_LINE_BYTES = MAX_PAYLOAD_BYTES + 8

_LINE = re.compile(rb"(?P<json>\{.*\})\*(?P<crc>[0-9A-Fa-f]{4})[ \t]*\r?")


def json_line(payload: bytes) -> bytes:
    """The line that carries this JSON."""
    return payload + b"*%04X\n" % binascii.crc_hqx(payload, 0)


class JsonLineDialogue:
    """Listens only; one per connection. Implements `serial_port.SerialDialogue`. epoch: of the map."""

    def __init__(self, epoch: int) -> None:
        self.bad = 0
        self._epoch = epoch
        self._line = bytearray()
        self._too_long = False

    def to_send(self, now_ns: int) -> bytes:
        """Nothing: the robot talks by itself."""
        return b""

    def due_ns(self) -> int | None:
        """Never: the robot talks by itself."""
        return None

    def receive(self, data: bytes, now_ns: int) -> list[RobotPose | NoPlace]:
        """What the lines that end in `data`, arrived at `now_ns`, say."""
        reports: list[RobotPose | NoPlace] = []
        *ended, rest = data.split(b"\n")
        for piece in ended:
            self._keep(piece)
            if self._line and not self._too_long:
                self._read(bytes(self._line), now_ns, reports)
            self._line.clear()
            self._too_long = False
        self._keep(rest)
        return reports

    def _keep(self, piece: bytes) -> None:
        if self._too_long:
            return
        self._line += piece
        if len(self._line) > MAX_LINE_BYTES:
            self._too_long = True
            self._line.clear()
            self.bad += 1

    def _read(self, line: bytes, now_ns: int, reports: list[RobotPose | NoPlace]) -> None:
        # Not from the line's beginning: what was cut off by plugging in may stand before.
        match = _LINE.search(line)
        if match is None or match.end() != len(line):
            self.bad += 1
            return
        payload = match["json"]
        if binascii.crc_hqx(payload, 0) != int(match["crc"], 16):
            self.bad += 1
            return
        try:
            reports.append(report_from_json(payload, now_ns, self._epoch))
        except ProtocolError:
            self.bad += 1
