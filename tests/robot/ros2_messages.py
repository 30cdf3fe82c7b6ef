"""ROS 2 messages as bytes for the tests, written field by field and not with the decoder under test."""

from __future__ import annotations

import math
import struct

import numpy as np
from numpy.typing import NDArray


class Writer:
    """Little-endian CDR; alignment counts from the fourth byte."""

    def __init__(self) -> None:
        self.data = bytearray(b"\x00\x01\x00\x00")

    def put(self, code: str, *values: float) -> Writer:
        for value in values:
            size = struct.calcsize(code)
            self.data += bytes(-(len(self.data) - 4) % size) + struct.pack("<" + code, value)
        return self

    def text(self, value: str) -> Writer:
        raw = value.encode() + b"\0"
        self.put("I", len(raw))
        self.data += raw
        return self

    def header(self, stamp_ns: int, frame: str) -> Writer:
        return self.put("i", stamp_ns // 10**9).put("I", stamp_ns % 10**9).text(frame)

    def pose(self, x: float, y: float, yaw: float) -> Writer:
        return self.put("d", x, y, 0.0, 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))


def tf(*links: tuple[str, str, float, float, float], stamp_ns: int) -> bytes:
    """(parent, child, x, y, yaw) each."""
    w = Writer().put("I", len(links))
    for parent, child, x, y, yaw in links:
        w.header(stamp_ns, parent).text(child).pose(x, y, yaw)
    return bytes(w.data)


def pose_stamped(x: float, y: float, yaw: float, *, stamp_ns: int, frame: str = "map") -> bytes:
    return bytes(Writer().header(stamp_ns, frame).pose(x, y, yaw).data)


def with_covariance(x: float, y: float, yaw: float, *, stamp_ns: int, xx: float = 0.01) -> bytes:
    covariance = np.diag([xx, 0.0025, 0, 0, 0, 0.0004]).ravel().tolist()
    return bytes(Writer().header(stamp_ns, "map").pose(x, y, yaw).put("d", *covariance).data)


def odometry(x: float, y: float, yaw: float, *, stamp_ns: int) -> bytes:
    w = Writer().header(stamp_ns, "odom").text("base_link").pose(x, y, yaw)
    return bytes(w.put("d", *[0.0] * 36, *[0.0] * 6, *[0.0] * 36).data)


def grid(
    cells: NDArray[np.int8], *, stamp_ns: int = 0, frame: str = "map", x: float = -1.0, y: float = -2.0
) -> bytes:
    rows, cols = cells.shape
    w = Writer().header(stamp_ns, frame).put("i", 0).put("I", 0).put("f", 0.05).put("I", cols, rows)
    w.pose(x, y, 0.0).put("I", cells.size)
    return bytes(w.data) + cells.tobytes()
