"""Neato Botvac D3-D7 serial protocol: bytes <-> values, no I/O (formats.md, section 5).

A command is an ASCII line; the reply repeats the command, then CRLF lines, then 0x1A. Commands must not
overlap.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

POSE_COMMAND = b"GetRobotPos Smooth\n"
SCAN_COMMAND = b"GetLDSScan\n"
END_OF_REPLY = 0x1A
MAX_REPLY_BYTES = 32_768
"""Three times the longest known reply (GetLDSScan, 360 lines)."""

MAX_COORDINATE_M = 500.0
REPLY_TIMEOUT_NS = 1_000_000_000
SCAN_TIMEOUT_NS = 2_500_000_000
"""Three times the 0.8 s that a scan takes over the line."""
BEAMS = 360
DRAIN_NS = 500_000_000
"""How long nothing is asked after a missing reply, so that a late one is not taken for the next one."""
COMMAND_GAP_NS = 50_000_000
"""The pause the protocol document asks for between a reply and the next command."""

_POSE_LINE = re.compile(r"Robot\s+Smooth\s+pose:(?P<fields>.*)", re.IGNORECASE)
_FIELD = re.compile(r"(?<![\w.])(\w+)=([-+]?\d{1,9}(?:\.\d{1,9})?)(?=\s*(?:,|$))")


@dataclass(frozen=True, slots=True)
class NeatoReply:
    """One reply: `lines` are its non-empty lines, the first one being the repeated command."""

    lines: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class NeatoPosition:
    """The smoothed (SLAM) position in the robot's own map: metres, radians in (-pi, pi], robot clock in s."""

    x_m: float
    y_m: float
    yaw_rad: float
    robot_time_s: float
    localised: bool


@dataclass(frozen=True, slots=True)
class NeatoReading:
    """A position and when it held: t_ns is the middle between request and reply, on the timeline."""

    t_ns: int
    round_trip_ns: int
    position: NeatoPosition


@dataclass(frozen=True, slots=True, eq=False)
class NeatoScan:
    """One turn of the laser. t_ns: when it was asked for; ranges_m: (360,), counter-clockwise from the
    front, NaN without an echo."""

    t_ns: int
    ranges_m: NDArray[np.float64]


class ReplyParser:
    """Splits a byte stream into replies; never keeps more than MAX_REPLY_BYTES."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._overflowing = False
        self.overflows = 0

    def __len__(self) -> int:
        return len(self._buffer)

    def reset(self) -> None:
        """Forget a reply that has not ended."""
        self._buffer.clear()
        self._overflowing = False

    def feed(self, data: bytes) -> list[NeatoReply]:
        """The replies that end in `data`, in order; one that is too long is dropped up to its end."""
        replies = []
        start = 0
        while (end := data.find(END_OF_REPLY, start)) >= 0:
            self._keep(data[start:end])
            if not self._overflowing:
                replies.append(NeatoReply(_lines(bytes(self._buffer))))
            self.reset()
            start = end + 1
        self._keep(data[start:])
        return replies

    def _keep(self, piece: bytes) -> None:
        if self._overflowing:
            return
        if len(self._buffer) + len(piece) > MAX_REPLY_BYTES:
            self._buffer.clear()
            self._overflowing = True
            self.overflows += 1
            return
        self._buffer += piece


def _lines(reply: bytes) -> tuple[str, ...]:
    text = reply.decode("ascii", "replace")
    return tuple(line.strip() for line in re.split(r"[\r\n]+", text) if line.strip())


def position_from_reply(reply: NeatoReply) -> NeatoPosition | None:
    """The position in a reply to `GetRobotPos Smooth`; None where there is none or it makes no sense.

    The last pose line counts, because an interrupted reply may stand before it. Labels are matched, not
    places.
    """
    for line in reversed(reply.lines):
        if match := _POSE_LINE.search(line):
            return _position_from_fields(match["fields"])
    return None


def _position_from_fields(fields: str) -> NeatoPosition | None:
    values = {name.lower(): float(number) for name, number in _FIELD.findall(fields)}
    try:
        x_m, y_m, theta_deg, time_s = (values[name] for name in ("x", "y", "theta", "time"))
    except KeyError:
        return None
    if max(abs(x_m), abs(y_m)) > MAX_COORDINATE_M or abs(theta_deg) > 360.0:
        return None
    localised = not (x_m == 0.0 and y_m == 0.0 and theta_deg == 0.0)
    yaw_rad = math.remainder(math.radians(theta_deg), math.tau)
    return NeatoPosition(x_m, y_m, math.pi if yaw_rad == -math.pi else yaw_rad, time_s, localised)


def ranges_from_reply(reply: NeatoReply) -> NDArray[np.float64] | None:
    """The ranges in a reply to `GetLDSScan`, (360,) metres; None where they are not all there.

    Columns are found by their labels. Readings with an error code, or of 0 mm, are NaN.
    """
    head = next(
        (k for k, line in enumerate(reply.lines) if "angle" in line.lower() and "dist" in line.lower()), None
    )
    if head is None:
        return None
    labels = [label.strip().lower() for label in reply.lines[head].split(",")]
    columns = [
        next((k for k, label in enumerate(labels) if label.startswith(name)), -1)
        for name in ("angle", "dist", "err")
    ]
    if -1 in columns:
        return None
    ranges, seen = np.full(BEAMS, np.nan), np.zeros(BEAMS, np.bool_)
    for line in reply.lines[head + 1 :]:
        words = line.split(",")
        values = [words[k].strip() for k in columns if k < len(words)]
        if len(values) < 3 or not (values[0].isdecimal() and values[1].isdecimal()):
            continue
        angle, mm = int(values[0][:9]), int(values[1][:9])
        if angle < BEAMS:
            seen[angle] = True
            if mm > 0 and values[2] == "0":
                ranges[angle] = mm / 1000
    return ranges if seen.all() else None


class NeatoPoller:
    """Asks for the position `rate_hz` times a second and pairs replies with requests; one per connection.

    Implements `serial_port.SerialDialogue`. `bad` counts replies that were missing, late or not understood.
    scan_every_ns: how often a laser scan is asked for, too; the line is busy with it for 0.8 s.
    """

    def __init__(self, rate_hz: float, scan_every_ns: int | None = None) -> None:
        if not (math.isfinite(rate_hz) and rate_hz > 0):
            raise ValueError("rate_hz must be positive")
        self._period_ns = round(1e9 / rate_hz)
        self._parser = ReplyParser()
        self._asked_ns: int | None = None
        self._next_ns: int | None = None
        self._scan_every_ns = scan_every_ns
        self._next_scan_ns: int | None = None
        self._scanning = False
        self.bad = 0

    def to_send(self, now_ns: int) -> bytes:
        """The next command when it is due, else nothing."""
        if self._asked_ns is not None:
            if now_ns - self._asked_ns >= (SCAN_TIMEOUT_NS if self._scanning else REPLY_TIMEOUT_NS):
                self._asked_ns = None
                self._next_ns = now_ns + DRAIN_NS
                self.bad += 1
            return b""
        if self._next_ns is not None and now_ns < self._next_ns:
            return b""
        due_ns = now_ns if self._next_ns is None else self._next_ns
        # Counting from when it was due keeps the rate; a long stall is not made up for.
        self._next_ns = max(due_ns + self._period_ns, now_ns)
        self._asked_ns = now_ns
        self._parser.reset()
        self._scanning = self._scan_is_due(now_ns)
        return SCAN_COMMAND if self._scanning else POSE_COMMAND

    def due_ns(self) -> int | None:
        """When the next command is due, or the reply to the last one overdue."""
        if self._asked_ns is not None:
            return self._asked_ns + (SCAN_TIMEOUT_NS if self._scanning else REPLY_TIMEOUT_NS)
        return self._next_ns

    def _scan_is_due(self, now_ns: int) -> bool:
        if self._scan_every_ns is None:
            return False
        if self._next_scan_ns is None:
            self._next_scan_ns = now_ns + self._scan_every_ns  # a position comes first
        if now_ns < self._next_scan_ns:
            return False
        self._next_scan_ns = now_ns + self._scan_every_ns
        return True

    def receive(self, data: bytes, now_ns: int) -> list[NeatoReading | NeatoScan]:
        """The readings that `data`, arrived at `now_ns`, completes."""
        readings: list[NeatoReading | NeatoScan] = []
        for reply in self._parser.feed(data):
            asked_ns, self._asked_ns = self._asked_ns, None
            if self._scanning and asked_ns is not None:
                ranges = ranges_from_reply(reply)
                if ranges is None:
                    self.bad += 1
                else:
                    readings.append(NeatoScan(asked_ns, ranges))
                self._next_ns = now_ns + COMMAND_GAP_NS
                continue
            position = position_from_reply(reply)
            if asked_ns is None or position is None:
                self.bad += 1
                continue
            readings.append(NeatoReading((asked_ns + now_ns) // 2, now_ns - asked_ns, position))
            self._next_ns = max(self._next_ns or now_ns, now_ns + COMMAND_GAP_NS)
        return readings
