"""Roomba and Create 2 Open Interface stream: bytes <-> values, no I/O (formats.md, section 5).

Beside the wheel encoders the wheel drops (packet 7) and the charging sources (34) are asked for: a robot
that was lifted has lost its place, and its dock gives it back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

START = b"\x80"
STREAM_COMMAND = bytes([148, 4, 7, 34, 43, 44])
ASK_AGAIN_NS = 1_000_000_000
PERIOD_NS = 15_000_000

FRAME_HEAD = 19
_SIZES = {7: 1, 34: 1, 43: 2, 44: 2}
MAX_FRAME_BYTES = 3 + sum(1 + size for size in _SIZES.values())

TICK_M = math.pi * 0.072 / 508.8
AXLE_M = 0.235
COUNTS = 1 << 16
MAX_TICKS_PER_S = 2500.0
"""Twice the 0.5 m/s the wheels can do; a larger step is a restarted robot."""
SLACK_S = 0.2

SIGMA_M = 0.01
SIGMA_PER_M = 0.03
SIGMA_YAW_RAD = 0.01
SIGMA_YAW_PER_RAD = 0.03
SIGMA_YAW_PER_M = 0.02

_WHEEL_DROPS = 0x0C
_HOME_BASE = 0x02


@dataclass(frozen=True, slots=True)
class RoombaReading:
    """One frame. t_ns: timeline; left, right: encoder counts, 16 bits; lifted: a wheel hangs."""

    t_ns: int
    left: int
    right: int
    lifted: bool
    docked: bool


class StreamDialogue:
    """Asks for the stream and reads it; one per connection. Implements `serial_port.SerialDialogue`.

    `bad` counts frames whose bytes do not sum to 0 mod 256, or that carry something else.
    """

    def __init__(self) -> None:
        self.bad = 0
        self._buffer = bytearray()
        self._asked_ns: int | None = None

    def to_send(self, now_ns: int) -> bytes:
        """The request, again while nothing comes: a robot that was asleep has not heard it."""
        if self._asked_ns is not None and now_ns - self._asked_ns < ASK_AGAIN_NS:
            return b""
        self._asked_ns = now_ns
        return START + STREAM_COMMAND

    def due_ns(self) -> int | None:
        """When it is asked again."""
        return None if self._asked_ns is None else self._asked_ns + ASK_AGAIN_NS

    def receive(self, data: bytes, now_ns: int) -> list[RoombaReading]:
        """The readings of the frames that end in `data`, arrived at `now_ns`; earlier ones by 15 ms each."""
        self._buffer += data
        values: list[dict[int, int]] = []
        while (start := self._buffer.find(FRAME_HEAD)) >= 0:
            del self._buffer[:start]
            if len(self._buffer) < 2:
                break
            length = self._buffer[1] + 3
            if length > MAX_FRAME_BYTES:
                del self._buffer[0]  # a 19 that begins no frame of ours
                continue
            if len(self._buffer) < length:
                break
            found = _frame(bytes(self._buffer[:length]))
            if found is None:
                self.bad += 1
                del self._buffer[0]  # the true frame may begin inside the false one
                continue
            values.append(found)
            del self._buffer[:length]
        else:
            self._buffer.clear()
        if values:
            self._asked_ns = now_ns
        last = len(values) - 1
        return [_reading(found, now_ns - (last - k) * PERIOD_NS) for k, found in enumerate(values)]


def _frame(frame: bytes) -> dict[int, int] | None:
    """Values by packet id; None for a wrong checksum or unexpected content."""
    if sum(frame) % 256:
        return None
    values = {}
    at, end = 2, len(frame) - 1
    while at < end:
        size = _SIZES.get(frame[at])
        if size is None or at + 1 + size > end:
            return None
        values[frame[at]] = int.from_bytes(frame[at + 1 : at + 1 + size], "big")
        at += 1 + size
    return values if {43, 44} <= values.keys() else None


def _reading(values: dict[int, int], t_ns: int) -> RoombaReading:
    return RoombaReading(
        t_ns,
        left=values[43],
        right=values[44],
        lifted=bool(values.get(7, 0) & _WHEEL_DROPS),
        docked=bool(values.get(34, 0) & _HOME_BASE),
    )


@dataclass(frozen=True, slots=True)
class Odometry:
    """Where the wheels say the robot is, from where counting began: x forward, y left; with deviations."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0
    sigma_m: float = SIGMA_M
    sigma_yaw_rad: float = SIGMA_YAW_RAD


class WheelOdometry:
    """Dead reckoning. `lost`: lifted or restarted since; a dock whose place is known gives the place back."""

    def __init__(self) -> None:
        self.lost = False
        self.lifted = False
        self.place = Odometry()
        self._last: RoombaReading | None = None
        self._dock: Odometry | None = None

    def update(self, reading: RoombaReading) -> None:
        """Take the next reading; counts wrap at 16 bits."""
        last, self._last = self._last, reading
        self.lifted = reading.lifted
        if reading.lifted:
            self.lost = True
        elif last is not None and not self.lost:
            self._advance(last, reading)
        if reading.docked and not reading.lifted:
            if self.lost and self._dock is not None:
                self.place, self.lost = self._dock, False
            elif not self.lost and (self._dock is None or not (last and last.docked)):
                # The first place of the dock stays: later ones carry the drive's error.
                self._dock = self._dock or self.place
                self.place = self._dock

    def _advance(self, last: RoombaReading, reading: RoombaReading) -> None:
        left, right = (_signed(b - a) for a, b in ((last.left, reading.left), (last.right, reading.right)))
        allowed = MAX_TICKS_PER_S * ((reading.t_ns - last.t_ns) / 1e9 + SLACK_S)
        if max(abs(left), abs(right)) > allowed:
            self.lost = True
            return
        along, turn = (left + right) / 2 * TICK_M, (right - left) * TICK_M / AXLE_M
        place = self.place
        heading = place.yaw_rad + turn / 2
        self.place = replace(
            place,
            x_m=place.x_m + along * math.cos(heading),
            y_m=place.y_m + along * math.sin(heading),
            yaw_rad=math.remainder(place.yaw_rad + turn, math.tau),
            sigma_m=place.sigma_m + abs(along) * (SIGMA_PER_M + place.sigma_yaw_rad),
            sigma_yaw_rad=place.sigma_yaw_rad + abs(turn) * SIGMA_YAW_PER_RAD + abs(along) * SIGMA_YAW_PER_M,
        )


def _signed(difference: int) -> int:
    return (difference + COUNTS // 2) % COUNTS - COUNTS // 2
