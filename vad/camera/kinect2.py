"""Kinect v2 colour over USB: commands, answers, and pictures out of bulk transfers (formats.md 9). Pure."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from vad.errors import ProtocolError

VENDOR = 0x045E
PRODUCTS = (0x02C4, 0x02D8, 0x02D9)
ENDPOINT_ANSWERS, ENDPOINT_COMMANDS, ENDPOINT_COLOUR = 0x81, 0x02, 0x83
TICK_US = 125
"""A picture's stamp counts these."""

_COMMAND_MAGIC, _ANSWER_MAGIC = 0x06022009, 0x0A6FE000
ANSWER_BYTES = 16
_HEADER = struct.Struct("<II")
_FOOTER = struct.Struct("<6IffIIf3I")
_HEADER_MAGIC, _FOOTER_MAGIC = 0x42424242, 0x39393939
_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
# A 1920x1080 picture has some 300 kB; the sensor never sends more than this.
_MOST_BYTES = 4 << 20


@dataclass(frozen=True, slots=True)
class Command:
    """One command. answer_bytes: at most so many come back before the 16 bytes that close it; 0 = none."""

    number: int
    parameters: tuple[int, ...] = ()
    answer_bytes: int = 0

    def to_bytes(self, sequence: int) -> bytes:
        """What goes out, under a number of our own that the answer repeats."""
        head = (_COMMAND_MAGIC, sequence & 0xFFFFFFFF, self.answer_bytes, self.number, 0)
        return struct.pack(f"<{5 + len(self.parameters)}I", *head, *self.parameters)


FIRMWARE = Command(0x02, (), 0x200)
STATUS = Command(0x14, (), 0x5C)
SERIAL = Command(0x22, (1,), 0x80)
READY = Command(0x16, (0x090000,), 4)
ON, OFF = Command(0x4B, (1, 0x00640064, 0, 0)), Command(0x4B, (0, 0, 0, 0))
ON_AGAIN = Command(0x4B, (1, 0, 0, 0))
INITIALISE, STOP = Command(0x09), Command(0x0A)
STREAM, STREAM_OFF = Command(0x2B, (1,)), Command(0x2B, (0,))

OPENING = (FIRMWARE, STATUS, SERIAL, ON, OFF)
"""Sent first; then READY is asked until it says so."""

CLOSING = (ON, OFF, STOP, STREAM_OFF, ON_AGAIN, OFF, ON_AGAIN, OFF)
"""Sent last, after interface 1 went back to its alternate setting 0."""


def check_answer(data: bytes, sequence: int) -> None:
    """ProtocolError unless these are the closing bytes of the command with this number."""
    if len(data) != ANSWER_BYTES:
        raise ProtocolError(f"the Kinect closed a command with {len(data)} bytes instead of {ANSWER_BYTES}")
    magic, number = struct.unpack_from("<II", data)
    if magic != _ANSWER_MAGIC or number != sequence & 0xFFFFFFFF:
        raise ProtocolError("the Kinect answered another command than the one sent")


def is_ready(data: bytes) -> bool:
    """Whether READY's answer says yes."""
    return len(data) >= 4 and bool(struct.unpack_from("<I", data)[0] & 1)


def serial_number(data: bytes) -> str:
    """SERIAL's answer as text."""
    return data[: len(data) & ~1].decode("utf-16-le", errors="replace").split("\0", 1)[0]


@dataclass(frozen=True, slots=True)
class ColourPicture:
    """One picture: its number, its stamp (0.125 ms, uint32, wraps), the JPEG, exposure in ms and gain."""

    sequence: int
    ticks: int
    jpeg: bytes
    exposure_ms: float
    gain: float


class PictureAssembler:
    """Bulk transfers of the colour endpoint -> pictures. `broken` counts what did not fit together.

    A picture starts and ends with a transfer; what is between two pictures, or lost inside one, costs that
    picture only.
    """

    def __init__(self) -> None:
        self.broken = 0
        self._parts = bytearray()

    def receive(self, transfer: bytes) -> ColourPicture | None:
        """The picture that this transfer completes, if it does."""
        if _starts(transfer):
            self._drop()
        elif not self._parts:
            self.broken += bool(transfer)
            return None
        self._parts += transfer
        if len(self._parts) > _MOST_BYTES:
            self._drop()
            return None
        if not self._ended():
            return None
        picture = _picture(bytes(self._parts))
        self.broken += picture is None
        self._parts.clear()
        return picture

    def _drop(self) -> None:
        self.broken += bool(self._parts)
        self._parts.clear()

    def _ended(self) -> bool:
        at = len(self._parts) - _FOOTER.size
        if at < _HEADER.size:
            return False
        fields = _FOOTER.unpack_from(self._parts, at)
        return bool(
            fields[0] == _FOOTER_MAGIC and fields[8] == _HEADER_MAGIC and fields[9] == len(self._parts)
        )


def _starts(transfer: bytes) -> bool:
    if len(transfer) < _HEADER.size + len(_JPEG_START):
        return False
    magic = _HEADER.unpack_from(transfer)[1]
    return bool(magic == _HEADER_MAGIC and transfer[_HEADER.size : _HEADER.size + 2] == _JPEG_START)


def _picture(data: bytes) -> ColourPicture | None:
    sequence = _HEADER.unpack_from(data)[0]
    _, again, filler, _, _, ticks, exposure_ms, gain, *_ = _FOOTER.unpack_from(data, len(data) - _FOOTER.size)
    end = len(data) - _FOOTER.size - filler
    if again != sequence or end <= _HEADER.size:
        return None
    # Up to three bytes of padding follow the JPEG's own end mark.
    mark = data.rfind(_JPEG_END, _HEADER.size, end)
    if mark < 0:
        return None
    return ColourPicture(sequence, ticks, data[_HEADER.size : mark + 2], exposure_ms, gain)
