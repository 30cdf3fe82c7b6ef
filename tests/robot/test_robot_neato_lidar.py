"""Laser scans of a Neato: the protocol's table, the map drawn from scans, the way over a pty."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from vad.robot.floor_plan import FREE, OCCUPIED, FloorPlan
from vad.robot.neato import NeatoReply, ranges_from_reply
from vad.robot.neato_source import LDS_BEHIND_M, NeatoSource
from vad.robot.pose import MapSource, RobotPose
from vad.robot.scan_map import MAX_RANGE_M, ScanMap
from vad.sim.neato import Pose, VirtualNeato
from vad.streams import DropOldestQueue

ROOM = (-1.5, -1.0, 3.0, 2.0)
"""x0, y0, x1, y1 of a room's walls."""


def ranges_in_room(x: float, y: float, yaw: float) -> NDArray[np.float64]:
    """What a perfect scanner sees in ROOM, (360,)."""
    x0, y0, x1, y1 = ROOM
    bearing = yaw + np.radians(np.arange(360))
    c, s = np.cos(bearing), np.sin(bearing)
    with np.errstate(divide="ignore"):
        to_x = np.where(c > 0, (x1 - x) / c, (x0 - x) / c)
        to_y = np.where(s > 0, (y1 - y) / s, (y0 - y) / s)
    return np.minimum(np.abs(to_x), np.abs(to_y))


def lines_of(points: list[dict[str, int]]) -> tuple[str, ...]:
    rows = [f"{p['angle']},{p['dist']},{p['intensity']},{p['error']}" for p in points]
    return ("GetLDSScan", "AngleInDegrees,DistInMM,Intensity,ErrorCodeHEX", *rows, "ROTATION_SPEED,5.00")


def test_recorded_scans_are_read_and_drawn(shared_data: Path) -> None:
    files = sorted((shared_data / "robots" / "neato").glob("lidar-scan*.json"))
    assert len(files) == 6
    for file in files:
        tree = json.loads(file.read_bytes())
        ranges = ranges_from_reply(NeatoReply(lines_of(tree["points"])))
        assert ranges is not None
        assert np.count_nonzero(np.isfinite(ranges)) == tree["validPoints"], file.name
        drawn = ScanMap()
        for _ in range(3):
            drawn.add(1.0, 2.0, 0.7, ranges)
        plan = drawn.floor_plan(4)
        assert plan is not None
        bearing = 0.7 + np.radians(np.arange(360))
        near = np.isfinite(ranges) & (ranges > 0.3) & (ranges < MAX_RANGE_M)
        echo = np.stack([1 + ranges * np.cos(bearing), 2 + ranges * np.sin(bearing)], axis=1)[near]
        assert (plan.occupancy_at(echo) == OCCUPIED).mean() > 0.95, file.name
        half = np.stack([1 + ranges / 2 * np.cos(bearing), 2 + ranges / 2 * np.sin(bearing)], axis=1)[near]
        assert (plan.occupancy_at(half) == FREE).mean() > 0.8, file.name


def test_columns_are_found_by_their_labels() -> None:
    rows = tuple(f"0,{k},{1000 + k}" for k in range(360))
    ranges = ranges_from_reply(NeatoReply(("x", "ErrorCodeHEX,AngleInDegrees,DistInMM", *rows)))
    assert ranges is not None
    assert ranges[7] == pytest.approx(1.007)


@pytest.mark.parametrize("cut", [1, 2, 100, 361])
def test_a_table_that_is_cut_is_no_scan(cut: int) -> None:
    points = [{"angle": k, "dist": 1000, "intensity": 9, "error": 0} for k in range(360)]
    assert ranges_from_reply(NeatoReply(lines_of(points)[:cut])) is None


@given(st.lists(st.text(max_size=30), max_size=20))
def test_any_lines_are_no_scan(lines: list[str]) -> None:
    assert ranges_from_reply(NeatoReply(("AngleInDegrees,DistInMM,Intensity,ErrorCodeHEX", *lines))) is None


def test_scans_from_many_places_make_the_room() -> None:
    drawn = ScanMap()
    rng = np.random.default_rng(0)
    for x, y, yaw in [(0, 0, 0), (1, 1, 2), (2.5, -0.5, -1), (-1, 1.5, 4), (0, 1, 1)]:
        drawn.add(x, y, yaw, ranges_in_room(x, y, yaw) + rng.normal(0, 0.01, 360))
    plan = drawn.floor_plan(1)
    assert plan is not None
    check_room(plan)
    # Nothing is seen through walls.
    outside = plan.occupancy_at(np.array([[3.3, 0.0], [0.0, -1.3], [-1.8, 0.5], [0.0, 2.3]]))
    assert (outside != FREE).all()


def check_room(plan: FloorPlan) -> None:
    x0, y0, x1, y1 = ROOM
    inside = np.stack(np.meshgrid(np.arange(x0 + 0.2, x1 - 0.1, 0.2), np.arange(y0 + 0.2, y1 - 0.1, 0.2)), -1)
    assert (plan.occupancy_at(inside.reshape(-1, 2)) == FREE).mean() > 0.97
    for x, y in ((x0, 0.5), (x1, 0.5), (0.5, y0), (0.5, y1)):
        around = np.array([[x + dx, y + dy] for dx in (-0.05, 0, 0.05) for dy in (-0.05, 0, 0.05)])
        assert (plan.occupancy_at(around) == OCCUPIED).any(), (x, y)


def test_what_was_moved_away_is_forgotten() -> None:
    drawn = ScanMap()
    with_box = ranges_in_room(0, 0, 0)
    with_box[:20] = 1.0
    for _ in range(3):
        drawn.add(0, 0, 0, with_box)
    first = drawn.floor_plan(1)
    assert first is not None
    assert first.occupancy_at(np.array([[1.001, 0.05]]))[0] == OCCUPIED
    for _ in range(20):
        drawn.add(0, 0, 0, ranges_in_room(0, 0, 0))
    later = drawn.floor_plan(1)
    assert later is not None
    assert later.occupancy_at(np.array([[1.001, 0.05]]))[0] == FREE
    assert later.bounds_m == first.bounds_m


def test_nothing_and_nonsense_draw_nothing() -> None:
    drawn = ScanMap()
    drawn.add(0, 0, 0, np.full(360, np.nan))
    drawn.add(1e6, 0, 0, np.full(360, 1.0))
    assert drawn.floor_plan(1) is None


@pytest.mark.usefixtures("patient")
async def test_over_a_pty_the_map_is_drawn_while_poses_come() -> None:
    where: list[Pose] = [(0.0, 0.0, 0.3)]

    def scan_at(_t_ns: int) -> list[int]:
        x, y, yaw = where[0]
        lds = x - LDS_BEHIND_M * math.cos(yaw), y - LDS_BEHIND_M * math.sin(yaw)
        return [round(float(mm)) for mm in ranges_in_room(*lds, yaw) * 1000]

    robot = VirtualNeato(lambda _t_ns: where[0], scan_at=scan_at)
    source = NeatoSource(robot.path, rate_hz=10.0, epoch=2, lidar=True, scan_every_ns=150_000_000)
    assert isinstance(source, MapSource)
    out: DropOldestQueue[RobotPose] = DropOldestQueue(512)
    tasks = [asyncio.create_task(robot.run()), asyncio.create_task(source.run(out))]
    try:
        async with asyncio.timeout(40):
            for place in ((0.0, 0.0, 0.3), (2.0, 1.0, 2.0)):
                where[0] = place
                plan = await source.plans.get()
    finally:
        for task in tasks:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
    assert plan.epoch == 2
    check_room(plan)
    assert out.accepted >= 10
    assert source.health.counters["bad_input"] == 0
