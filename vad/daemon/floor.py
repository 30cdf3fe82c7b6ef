"""The floor plan in force: kept across restarts, compared with every plan that comes, given its epoch."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import shutil
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vad.errors import VadError
from vad.mapping.plan_match import (
    IDENTITY,
    Occupancy,
    PlanTransform,
    agreement,
    match_plans,
)
from vad.mapping.reanchor import moved_covariance
from vad.robot.floor_plan import FREE, FloorPlan, Room
from vad.robot.map_server import load_floor_plan, save_floor_plan
from vad.robot.pose import MapSource, PoseSource
from vad.store.records import Estimate
from vad.streams import DropOldestQueue

_log = logging.getLogger(__name__)

MIN_FLOOR_M2 = 4.0
"""A robot that has only begun shows too little to tell one home from another."""
NEWS_SHARE = 0.01
"""A plan whose cells differ by less than this from the one in force is no news."""
SAY_WAITING_S = 0.5
SEEN_DIFFERENT = 2
"""So many plans in a row that do not fit make a new epoch; one of another map id at once."""


@dataclass(frozen=True, slots=True)
class Change:
    """The plan now in force, and what it means for what hangs on the one before.

    transform: from the old frame to the new one; None where it is not known, `reason` then says why.
    """

    plan: FloorPlan
    before: FloorPlan
    transform: PlanTransform | None
    reason: str = ""

    @property
    def new_epoch(self) -> bool:
        """Whether the frame has changed."""
        return self.plan.epoch != self.before.epoch


class FloorKeeper:
    """Owns the plan.

    folder: where it is kept; rooms: of the settings, in the frame of the first plan they are used with, and
    moved with it. A plan's own rooms go before them.
    """

    def __init__(self, folder: Path, rooms: tuple[Room, ...] = ()) -> None:
        self.plan: FloorPlan | None = None
        self._folder = folder
        self._rooms = rooms
        self._different = 0

    async def recall(self) -> FloorPlan | None:
        """The plan of the last run, in force from now on; None where there is none."""
        self.plan = await asyncio.to_thread(_newest, self._folder)
        return self.plan

    async def take(self, plan: FloorPlan) -> FloorPlan:
        """Put a plan in force without comparing it: the first, or one whose frame is known to be the same."""
        return await self._keep(plan if plan.rooms else replace(plan, rooms=self._rooms))

    async def take_new_epoch(self, plan: FloorPlan) -> Change:
        """Put a plan in force that has another epoch than the one before, by the user's word."""
        assert self.plan is not None
        return await self._changed(plan, self.plan)

    async def judge(self, plan: FloorPlan) -> Change | None:
        """What a plan of the robot changes; None where it is no news, or not yet believed."""
        before = self.plan
        assert before is not None
        if not shows_enough(plan):
            return None
        fit = await asyncio.to_thread(agreement, _occupancy(before), _occupancy(plan))
        if fit.same:
            self._different = 0
            if not _news(before, plan):
                return None
            rooms = plan.rooms or before.rooms
            kept = await self._keep(replace(plan, epoch=before.epoch, rooms=rooms))
            return Change(kept, before, IDENTITY)
        self._different += 1
        another = bool(plan.map_id and before.map_id and plan.map_id != before.map_id)
        if self._different < SEEN_DIFFERENT and not another:
            return None
        self._different = 0
        return await self._changed(replace(plan, epoch=before.epoch + 1), before)

    async def _changed(self, plan: FloorPlan, before: FloorPlan) -> Change:
        found = await asyncio.to_thread(match_plans, _occupancy(before), _occupancy(plan))
        transform = found.transform
        if not plan.rooms and transform is not None:
            moved = tuple(Room(room.name, transform.apply(room.polygon)) for room in before.rooms)
            plan = replace(plan, rooms=moved)
        kept = await self._keep(plan)
        if transform is None:
            reason = f"the robot's map changed (epoch {plan.epoch}) and {found.reason}"
            _log.warning("%s: what was measured on the old map is stale", reason)
            return Change(kept, before, None, reason)
        _log.warning(
            "the robot's map changed (epoch %d): turned by %.1f degrees, by (%.2f, %.2f) m%s; fit %.0f %%",
            plan.epoch,
            np.degrees(transform.angle_rad),
            transform.x_m,
            transform.y_m,
            ", mirrored" if transform.flipped else "",
            100 * found.agreement.score,
        )
        return Change(kept, before, transform)

    async def _keep(self, plan: FloorPlan) -> FloorPlan:
        self.plan = plan
        try:
            await asyncio.to_thread(_save, self._folder, plan)
        except (OSError, VadError) as error:
            _log.warning("the floor plan cannot be kept: %s", error)
        return plan


def _occupancy(plan: FloorPlan) -> Occupancy:
    return Occupancy(plan.cells, plan.resolution_m, plan.origin)


async def first_plan(
    keeper: FloorKeeper,
    of_file: FloorPlan | None,
    robot: PoseSource,
    say_waiting: Callable[[PoseSource], None],
) -> tuple[FloorPlan, Change | None]:
    """The plan to begin with, and the change to make once everything stands.

    That of the last run, so that what hangs on it can be moved; else the file's; else the robot's, which is
    waited for: `say_waiting` is called all along.
    """
    kept = await keeper.recall()
    if of_file is not None:
        if kept is None or kept.epoch == of_file.epoch:
            return await keeper.take(of_file), None
        return kept, await keeper.take_new_epoch(of_file)
    if kept is not None:
        return kept, None
    assert isinstance(robot, MapSource)  # the settings were checked
    while True:
        say_waiting(robot)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(SAY_WAITING_S):
                plan = await robot.plans.get()
            if shows_enough(plan):
                return await keeper.take(replace(plan, epoch=1)), None


async def follow_plans(
    keeper: FloorKeeper, plans: DropOldestQueue[FloorPlan], use: Callable[[Change], Awaitable[None]]
) -> None:
    """Judge every plan the robot sends, until cancelled."""
    while True:
        change = await keeper.judge(await plans.get())
        if change is not None:
            await use(change)


def moved_estimate(place: Estimate, transform: PlanTransform, plan: FloorPlan) -> Estimate:
    """A device's place in the frame of `plan`, with the room it is in there."""
    ((x_m, y_m),) = transform.apply(np.array([[place.x_m, place.y_m]])).tolist()
    (a, b), (_, c) = moved_covariance(np.array(place.covariance_m2), transform).tolist()
    outline = transform.apply(np.array(place.region90, np.float64).reshape(-1, 2)).tolist()
    return replace(
        place,
        x_m=x_m,
        y_m=y_m,
        covariance_m2=((a, b), (b, c)),
        region90=tuple((x, y) for x, y in outline),
        room=plan.room_at(x_m, y_m),
    )


def shows_enough(plan: FloorPlan) -> bool:
    """Whether there is floor enough on a plan to know it by."""
    return bool(np.count_nonzero(plan.cells == FREE) * plan.resolution_m**2 >= MIN_FLOOR_M2)


def _news(before: FloorPlan, plan: FloorPlan) -> bool:
    if [room.name for room in plan.rooms or before.rooms] != [room.name for room in before.rooms]:
        return True
    if (before.cells.shape, before.origin) != (plan.cells.shape, plan.origin):
        return True
    return bool(np.mean(before.cells != plan.cells) > NEWS_SHARE)


def _newest(folder: Path) -> FloorPlan | None:
    for place in _kept(folder):
        try:
            return load_floor_plan(place / "plan.yaml", epoch=_numbers(place)[0])
        except VadError as error:
            _log.warning("a kept floor plan cannot be read: %s", error)
    return None


def _save(folder: Path, plan: FloorPlan) -> None:
    """Write a folder of its own and rename it: a plan is there whole or not at all."""
    kept = _kept(folder)
    serial = 1 + max((_numbers(place)[1] for place in kept), default=0)
    draft = folder / "draft"
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir(parents=True)
    save_floor_plan(plan, draft / "plan.yaml")
    draft.rename(folder / f"{plan.epoch}-{serial}")
    for place in kept:
        if _numbers(place)[0] == plan.epoch:
            shutil.rmtree(place, ignore_errors=True)


def _kept(folder: Path) -> list[Path]:
    """Folders `epoch-serial`, the one written last first."""
    if not folder.is_dir():
        return []
    found = [place for place in folder.iterdir() if all(part.isdecimal() for part in place.name.split("-"))]
    return sorted(
        (place for place in found if place.name.count("-") == 1), key=lambda p: _numbers(p)[1], reverse=True
    )


def _numbers(place: Path) -> tuple[int, int]:
    epoch, serial = place.name.split("-")
    return int(epoch), int(serial)
