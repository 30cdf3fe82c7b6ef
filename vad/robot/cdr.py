"""ROS 2 messages as CDR: bytes -> values, no I/O (formats.md, section 3).

Little-endian only, as every ROS 2 robot sends; alignment is counted from byte 4. Numbers are handed on as
they are: whether they make sense is for the reader to judge.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from vad.errors import ProtocolError

MAX_TRANSFORMS = 4096
"""In one TFMessage; more is taken for damage."""

Covariance6 = tuple[float, ...]
"""36 numbers, row-major: x, y, z, roll, pitch, yaw."""


class Transform(NamedTuple):
    """A motion in space: metres, unit quaternion. As a pose: where the child is in the parent."""

    x: float
    y: float
    z: float
    qx: float
    qy: float
    qz: float
    qw: float

    @property
    def yaw_rad(self) -> float:
        """Counter-clockwise about the vertical."""
        return math.atan2(
            2.0 * (self.qw * self.qz + self.qx * self.qy), 1.0 - 2.0 * (self.qy * self.qy + self.qz * self.qz)
        )


@dataclass(frozen=True, slots=True)
class PoseMessage:
    """PoseStamped, PoseWithCovarianceStamped or Odometry (whose twist is left out).

    stamp_ns: the robot's clock; child_frame: of an Odometry, else empty.
    """

    stamp_ns: int
    frame: str
    pose: Transform
    covariance: Covariance6 | None = None
    child_frame: str = ""


class TransformMessage(NamedTuple):
    """One transform of a TFMessage: the pose of `child_frame` in `frame`."""

    stamp_ns: int
    frame: str
    child_frame: str
    transform: Transform


@dataclass(frozen=True, slots=True, eq=False)
class GridMessage:
    """OccupancyGrid. origin: pose of the lowest cell's corner; cells: (height, width) int8, row 0 lowest."""

    stamp_ns: int
    frame: str
    resolution_m: float
    origin: Transform
    cells: NDArray[np.int8]


_STAMP = struct.Struct("<iI")
_LENGTH = struct.Struct("<I")
_POSE = struct.Struct("<7d")
_POSE_COVARIANCE = struct.Struct("<43d")
_GRID = struct.Struct("<iIfII")
_BEGIN = 4

T = TypeVar("T")


def pose_stamped(data: bytes) -> PoseMessage:
    """geometry_msgs/msg/PoseStamped; ProtocolError for anything else."""
    return _checked(_pose_stamped, data)


def pose_with_covariance_stamped(data: bytes) -> PoseMessage:
    """geometry_msgs/msg/PoseWithCovarianceStamped; ProtocolError for anything else."""
    return _checked(_pose_with_covariance_stamped, data)


def odometry(data: bytes) -> PoseMessage:
    """nav_msgs/msg/Odometry; ProtocolError for anything else."""
    return _checked(_odometry, data)


def tf_message(data: bytes) -> list[TransformMessage]:
    """tf2_msgs/msg/TFMessage; ProtocolError for anything else."""
    return _checked(_tf_message, data)


def occupancy_grid(data: bytes) -> GridMessage:
    """nav_msgs/msg/OccupancyGrid; ProtocolError for anything else."""
    return _checked(_occupancy_grid, data)


def _checked(read: Callable[[bytes], T], data: bytes) -> T:
    if data[:2] != b"\x00\x01":
        raise ProtocolError("this is not little-endian CDR", remedy="Does the topic have the type named?")
    try:
        return read(data)
    except (struct.error, UnicodeDecodeError, ValueError) as error:
        raise ProtocolError(
            f"the CDR message is damaged or of another type: {error}",
            remedy="Does the topic have the type named?",
        ) from error


def _pose_stamped(data: bytes) -> PoseMessage:
    stamp_ns, frame, at = _header(data, _BEGIN)
    return PoseMessage(stamp_ns, frame, Transform._make(_POSE.unpack_from(data, _align8(at))))


def _pose_with_covariance_stamped(data: bytes) -> PoseMessage:
    stamp_ns, frame, at = _header(data, _BEGIN)
    numbers = _POSE_COVARIANCE.unpack_from(data, _align8(at))
    return PoseMessage(stamp_ns, frame, Transform._make(numbers[:7]), numbers[7:])


def _odometry(data: bytes) -> PoseMessage:
    stamp_ns, frame, at = _header(data, _BEGIN)
    child, at = _string(data, _align4(at))
    numbers = _POSE_COVARIANCE.unpack_from(data, _align8(at))
    return PoseMessage(stamp_ns, frame, Transform._make(numbers[:7]), numbers[7:], child)


def _tf_message(data: bytes) -> list[TransformMessage]:
    (count,) = _LENGTH.unpack_from(data, _BEGIN)
    if count > MAX_TRANSFORMS:
        raise ValueError(f"{count} transforms")
    at = _BEGIN + _LENGTH.size
    found = []
    for _ in range(count):
        stamp_ns, frame, at = _header(data, _align4(at))
        child, at = _string(data, _align4(at))
        at = _align8(at)
        found.append(TransformMessage(stamp_ns, frame, child, Transform._make(_POSE.unpack_from(data, at))))
        at += _POSE.size
    return found


def _occupancy_grid(data: bytes) -> GridMessage:
    stamp_ns, frame, at = _header(data, _BEGIN)
    at = _align4(at)
    _, _, resolution_m, width, height = _GRID.unpack_from(data, at)
    at = _align8(at + _GRID.size)
    origin = Transform._make(_POSE.unpack_from(data, at))
    at += _POSE.size
    (count,) = _LENGTH.unpack_from(data, at)
    at += _LENGTH.size
    if count != width * height:
        raise ValueError(f"{count} cells for {width} x {height}")
    cells = np.frombuffer(data, np.int8, count, at).reshape(height, width)
    return GridMessage(stamp_ns, frame, resolution_m, origin, cells)


def _header(data: bytes, at: int) -> tuple[int, str, int]:
    """std_msgs/Header at an aligned place: stamp in ns, frame, where it ends."""
    sec, nanosec = _STAMP.unpack_from(data, at)
    frame, at = _string(data, at + _STAMP.size)
    return sec * 1_000_000_000 + nanosec, frame, at


def _string(data: bytes, at: int) -> tuple[str, int]:
    """A string at an aligned place (length with the closing NUL, then the bytes) and where it ends."""
    (length,) = _LENGTH.unpack_from(data, at)
    at += _LENGTH.size
    end = at + length
    if end > len(data):
        raise ValueError("a string runs past the end")
    return str(data[at : max(at, end - 1)], "utf-8"), end


def _align4(at: int) -> int:
    return at + (-at & 3)


def _align8(at: int) -> int:
    return at + (-(at - _BEGIN) & 7)
