"""The floor plan in force: kept, judged, its epochs; devices and camera go with it."""

from __future__ import annotations

import asyncio
import contextlib
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_daemon_registry import LAMP, PLACE, PLAN, TV, evidence, hub

from vad.daemon.floor import Change, FloorKeeper, first_plan, follow_plans, moved_estimate
from vad.mapping.plan_match import PlanTransform
from vad.mapping.posterior import Grid
from vad.robot.floor_plan import FloorPlan, Room
from vad.robot.valetudo_source import ValetudoSource
from vad.store.records import Estimate
from vad.streams import DropOldestQueue

STEP_M = 0.05


def home(**changes: object) -> FloorPlan:
    """Three rooms of 8 m x 6 m, nothing symmetrical."""
    cells = np.full((140, 180), -1, np.int8)
    for x0, y0, x1, y1, value in (
        (0, 0, 8, 6, 100),
        (0.1, 0.1, 3.5, 5.9, 0),
        (3.6, 2.5, 7.9, 5.9, 0),
        (3.6, 0.1, 6.0, 2.4, 0),
        (3.5, 4.0, 3.6, 4.9, 0),
        (4.5, 2.4, 5.3, 2.5, 0),
        (1.0, 1.0, 1.6, 2.8, 100),
    ):
        a, b, c, d = (round((v + 0.5) / STEP_M) for v in (x0, y0, x1, y1))
        cells[b:d, a:c] = value
    west = Room("West", np.array([[0.0, 0.0], [3.5, 0.0], [3.5, 6.0], [0.0, 6.0]]))
    plan = FloorPlan(1, STEP_M, (-0.5, -0.5, 0.0), cells, (west,))
    return replace(plan, **changes)  # type: ignore[arg-type]


def turned(plan: FloorPlan) -> tuple[FloorPlan, PlanTransform]:
    """The robot made its map anew: a quarter turn, elsewhere, a tenth of the cells changed, no rooms."""
    rng = np.random.default_rng(1)
    cells = np.rot90(plan.cells).copy()
    hit = rng.random(cells.shape) < 0.1
    cells[hit] = rng.choice(np.array([-1, 0, 100], np.int8), int(hit.sum()))
    width_m = plan.cells.shape[1] * plan.resolution_m
    new = FloorPlan(0, STEP_M, (10.0, 20.0, 0.0), cells, map_id="second")
    return new, PlanTransform(-math.pi / 2, 10.0 - plan.origin[1], 20.0 + width_m + plan.origin[0])


def another_home() -> FloorPlan:
    cells = np.full((120, 120), -1, np.int8)
    cells[10:60, 10:110] = 0
    cells[60:110, 10:40] = 0
    cells[30:34, 50:90] = 100
    return FloorPlan(0, STEP_M, (0.0, 0.0, 0.0), cells)


def damage(folder: Path, pattern: str) -> None:
    (place,) = folder.glob(pattern)
    (place / "plan.pgm").write_bytes(b"P5")


async def test_a_plan_survives_a_restart_whole(tmp_path: Path) -> None:
    keeper = FloorKeeper(tmp_path / "plans")
    assert await keeper.recall() is None
    await keeper.take(home(epoch=3))
    await keeper.take(home(epoch=3))
    assert len(list((tmp_path / "plans").iterdir())) == 1
    (tmp_path / "plans" / "draft").mkdir()
    (tmp_path / "plans" / "note.txt").touch()
    again = await FloorKeeper(tmp_path / "plans").recall()
    assert again is not None
    assert again.epoch == 3
    np.testing.assert_array_equal(again.cells, home().cells)
    assert again.rooms[0].name == "West"


async def test_a_kept_plan_that_is_damaged_is_passed_over(tmp_path: Path) -> None:
    keeper = FloorKeeper(tmp_path)
    await keeper.take(home(epoch=1))
    await keeper.take(home(epoch=2))
    damage(tmp_path, "2-*")
    again = await FloorKeeper(tmp_path).recall()
    assert again is not None
    assert again.epoch == 1


async def test_the_same_map_is_no_news_and_a_grown_one_keeps_its_epoch(tmp_path: Path) -> None:
    keeper = FloorKeeper(tmp_path)
    await keeper.take(home())
    assert await keeper.judge(home(epoch=0)) is None
    grown = home().cells.copy()
    grown[20:60, 130:170] = 0
    change = await keeper.judge(home(epoch=0, cells=grown, rooms=(), map_id="other"))
    assert change is not None
    assert not change.new_epoch
    assert change.plan.epoch == 1
    assert change.plan.rooms[0].name == "West"


async def test_a_map_made_anew_is_a_new_epoch_with_the_way_there(tmp_path: Path) -> None:
    keeper = FloorKeeper(tmp_path)
    await keeper.take(home())
    new, truth = turned(home())
    # Without another name it is believed when it comes twice.
    assert await keeper.judge(new) is None
    change = await keeper.judge(new)
    assert change is not None
    assert change.plan.epoch == 2
    assert change.transform is not None
    place = np.array([[2.0, 3.0]])
    assert np.linalg.norm(change.transform.apply(place) - truth.apply(place)) < 0.1
    assert change.plan.room_at(*truth.apply(place)[0].tolist()) == "West"
    assert await keeper.judge(new) is None


async def test_another_home_is_refused_with_the_reason(tmp_path: Path) -> None:
    keeper = FloorKeeper(tmp_path)
    await keeper.take(home(map_id="first"))
    change = await keeper.judge(replace(another_home(), map_id="second"))
    assert change is not None
    assert change.new_epoch
    assert change.transform is None
    assert "do not fit" in change.reason


async def test_a_robot_that_only_begins_says_nothing_yet(tmp_path: Path) -> None:
    keeper = FloorKeeper(tmp_path)
    await keeper.take(home())
    for _ in range(3):
        assert await keeper.judge(FloorPlan(0, STEP_M, (0, 0, 0), np.zeros((9, 9), np.int8))) is None


async def test_the_first_plan_comes_from_file_memory_or_robot(tmp_path: Path) -> None:
    robot = ValetudoSource("http://127.0.0.1:9", epoch=1)
    said = []
    robot.plans.put(home(epoch=0))
    plan, change = await first_plan(FloorKeeper(tmp_path / "a"), None, robot, said.append)
    assert (plan.epoch, change, len(said)) == (1, None, 1)
    plan, change = await first_plan(FloorKeeper(tmp_path / "a"), None, robot, said.append)
    assert (plan.epoch, change, len(said)) == (1, None, 1)
    new, _ = turned(home())
    plan, change = await first_plan(FloorKeeper(tmp_path / "a"), replace(new, epoch=5), robot, said.append)
    assert plan.epoch == 1
    assert change is not None
    assert (change.plan.epoch, change.transform is not None) == (5, True)


async def test_plans_are_followed(tmp_path: Path) -> None:
    keeper = FloorKeeper(tmp_path)
    await keeper.take(home(map_id="first"))
    plans: DropOldestQueue[FloorPlan] = DropOldestQueue(1)
    changes: DropOldestQueue[Change] = DropOldestQueue(4)

    async def use(change: Change) -> None:
        changes.put(change)

    task = asyncio.create_task(follow_plans(keeper, plans, use))
    plans.put(turned(home())[0])
    async with asyncio.timeout(40):
        assert (await changes.get()).plan.epoch == 2
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task


def test_an_estimate_moves_with_its_region_and_finds_its_room() -> None:
    there = PlanTransform(math.pi / 2, 1.0, 0.0)
    place = Estimate(2.0, 1.0, ((0.04, 0.0), (0.0, 0.01)), 0.5, ((1.8, 1.0), (2.2, 1.0), (2.0, 1.2)))
    moved = moved_estimate(place, there, home())
    assert (moved.x_m, moved.y_m) == pytest.approx((0.0, 2.0))
    assert moved.covariance_m2[0][0] == pytest.approx(0.01)
    assert moved.covariance_m2[1][1] == pytest.approx(0.04)
    assert moved.region90[0] == pytest.approx((0.0, 1.8))
    assert moved.radius90_m == 0.5


async def test_devices_go_with_the_map_and_more_walks_add_to_what_moved(tmp_path: Path) -> None:
    way = PlanTransform(math.pi / 2, 3.0, -2.0)
    ((x_m, y_m),) = way.apply(np.array([PLACE])).tolist()
    x0, y0, x1, y1 = PLAN.bounds_m
    corners = way.apply(np.array([[x0, y0], [x1, y1]]))
    low, high = corners.min(axis=0), corners.max(axis=0)
    rooms = tuple(Room(room.name, way.apply(room.polygon)) for room in PLAN.rooms)
    cells = np.rot90(PLAN.cells, -1).copy()
    new = FloorPlan(2, PLAN.resolution_m, (float(low[0]), float(low[1]), 0.0), cells, rooms)
    async with hub(tmp_path) as there:
        await there.registry.joined(LAMP, None)
        await there.registry.joined(TV, None)
        await there.registry.add_evidence(LAMP, evidence(0.5), 5000, 14.0)
        before = await there.published(LAMP)
        await there.registry.use_plan(new, way, "")
        moved = await there.published(LAMP)
        assert (moved.epoch, moved.walks, moved.state, moved.room) == (2, 1, "waiting", before.room)
        assert (moved.x_m, moved.y_m) == (pytest.approx(x_m, abs=0.3), pytest.approx(y_m, abs=0.3))
        assert (await there.published(TV)).epoch == 2
        heatmap = await there.ask(lambda client: client.heatmap(LAMP))
        assert heatmap is not None
        assert heatmap.epoch == 2
        grid = Grid.over((float(low[0]), float(low[1]), float(high[0]), float(high[1])), 0.1)
        await there.registry.add_evidence(LAMP, evidence(0.2, (x_m, y_m), grid), 5000, 14.0)
        sharp = await there.published(LAMP)
        assert (sharp.walks, sharp.state) == (2, "mapped")
        assert (sharp.x_m, sharp.y_m) == (pytest.approx(x_m, abs=0.06), pytest.approx(y_m, abs=0.06))


async def test_devices_of_another_home_are_stale_with_the_reason(tmp_path: Path) -> None:
    async with hub(tmp_path) as there:
        await there.registry.joined(LAMP, None)
        await there.registry.add_evidence(LAMP, evidence(0.2), 5000, 14.0)
        await there.registry.use_plan(replace(PLAN, epoch=2), None, "the plans do not fit")
        gone = await there.published(LAMP)
        assert (gone.state, gone.reason, gone.epoch) == ("stale", "the plans do not fit", 1)
        assert [device.mac for device in there.registry.waiting()] == [LAMP]
