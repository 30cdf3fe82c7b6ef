"""How fast the robot's messages are read: microseconds a message, the best of several rounds.

python tools/bench_robot.py [FOLDER with Valetudo maps]
"""

from __future__ import annotations

import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from vad.mapping.plan_match import Occupancy, match_plans
from vad.robot import cdr
from vad.robot.json_source import pose_from_json
from vad.robot.ros2 import Frames, Ros2Reader
from vad.robot.valetudo import map_from_payload

ROUNDS = 7


def header(frame: bytes) -> bytes:
    """std_msgs/Header, its string padded so that what follows is aligned to 8 from byte 4."""
    data = struct.pack("<iII", 1_800_000_000, 5, len(frame) + 1) + frame + b"\0"
    return data + bytes(-len(data) % 8)


def seconds(work: Callable[[], object], repeats: int) -> float:
    """For one call, the best round."""
    best = float("inf")
    for _ in range(ROUNDS):
        begin = time.perf_counter()
        for _ in range(repeats):
            work()
        best = min(best, (time.perf_counter() - begin) / repeats)
    return best


def show(name: str, took_s: float, limit_s: float | None = None) -> bool:
    """A row; whether it keeps its limit."""
    kept = limit_s is None or took_s <= limit_s
    limit = "" if limit_s is None else f"{limit_s * 1e6:10.0f}  {'ok' if kept else 'TOO SLOW'}"
    print(f"{name:44}{took_s * 1e6:12.2f}{limit}")
    return kept


def main() -> int:
    """Print the table; 1 where a limit is not kept."""
    head = b"\x00\x01\x00\x00"
    pose7 = struct.pack("<7d", 1.0, 2.0, 0.0, 0.0, 0.0, 0.6, 0.8)
    pose = head + header(b"map") + pose7
    covariance = head + header(b"map") + pose7 + bytes(36 * 8)
    child = struct.pack("<I", 10) + b"base_link\0"
    link = header(b"odom") + child + bytes(-(len(header(b"odom")) + len(child)) % 8)
    odometry = head + link + pose7 + bytes(36 * 8 + 6 * 8 + 36 * 8)
    tf_link = struct.pack("<I", 1) + struct.pack("<iII", 1_800_000_000, 5, 4) + b"map\0"
    tf_link += struct.pack("<I", 5) + b"odom\0"
    tf = head + tf_link + bytes(-len(tf_link) % 8) + pose7
    cells = np.zeros((400, 400), np.int8)
    grid = head + header(b"map") + struct.pack("<iIfII", 0, 0, 0.05, 400, 400)
    grid += bytes(-(len(grid) - 4) % 8) + pose7 + struct.pack("<I", cells.size) + cells.tobytes()

    reader, ticks = Ros2Reader(Frames(), 1), iter(range(1_000_000, 1 << 31))
    print(f"{'':44}{'us':>12}{'limit':>10}")
    kept = [
        show("PoseStamped", seconds(lambda: cdr.pose_stamped(pose), 5000), 10e-6),
        show(
            "PoseWithCovarianceStamped",
            seconds(lambda: cdr.pose_with_covariance_stamped(covariance), 5000),
            10e-6,
        ),
        show("Odometry", seconds(lambda: cdr.odometry(odometry), 5000), 10e-6),
        show("TFMessage, one transform", seconds(lambda: cdr.tf_message(tf), 5000), 10e-6),
        show("OccupancyGrid 400 x 400", seconds(lambda: cdr.occupancy_grid(grid), 200), 1e-3),
        show("OccupancyGrid 400 x 400 -> floor plan", seconds(lambda: reader.floor_plan(grid), 50), 1e-3),
    ]

    def stamped() -> None:
        arrival_ns = next(ticks) * 20_000_000
        stamp = struct.pack("<iI", arrival_ns // 10**9, arrival_ns % 10**9)
        reader.pose("pose", pose[:4] + stamp + pose[12:], arrival_ns)

    show("PoseStamped -> pose on the timeline", seconds(stamped, 500))
    line = b'{"x_m": 1.2, "y_m": -0.4, "yaw_rad": 1.57}'
    show("JSON -> pose", seconds(lambda: pose_from_json(line, 0, 1), 5000))
    for path in sorted(Path(sys.argv[1]).glob("*.json")) if len(sys.argv) > 1 else []:
        payload = path.read_bytes()
        show(f"Valetudo {path.stem[:34]}", seconds(lambda: map_from_payload(payload, 1), 2))  # noqa: B023
        plan = map_from_payload(payload, 1).plan
        old = Occupancy(plan.cells, plan.resolution_m, plan.origin)
        new = Occupancy(np.rot90(plan.cells).copy(), plan.resolution_m, (0.0, 0.0, 0.0))
        begin = time.perf_counter()
        match_plans(old, new)
        show("    matched with itself, turned", time.perf_counter() - begin)
    return 0 if all(kept) else 1


if __name__ == "__main__":
    sys.exit(main())
