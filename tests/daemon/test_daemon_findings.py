"""What a walk changes: sharper, doubted, moved; and that nothing known is lost for one odd walk."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np
import pytest
from daemon_world import settings_for

from vad.bus import messages as m
from vad.bus.node import Bus
from vad.bus.session import BusSettings
from vad.daemon.findings import DeviceGoneError, Findings
from vad.daemon.registry import DOUBTED, Registry
from vad.daemon.solver_child import SolvedWalk
from vad.mapping.evidence import Terms
from vad.mapping.posterior import Grid
from vad.sim.household import make_household
from vad.store.worker import StoreWorker

HOUSE = make_household(1, days=1)
PLAN = HOUSE.plan
GRID = Grid.over(PLAN.bounds_m, 0.1)
LAMP = "f4:f5:d8:00:00:01"
STUDY = np.array([PLAN.bounds_m[2] - 0.6, PLAN.bounds_m[1] + 0.8])
KITCHEN = np.array([PLAN.bounds_m[0] + 1.0, PLAN.bounds_m[3] - 0.8])
LIVING_ROOM = np.array([PLAN.bounds_m[0] + 3.5, PLAN.bounds_m[1] + 0.8])


class RecordingBus(Bus):
    """A bus that nobody listens to; it keeps the events."""

    def __init__(self) -> None:
        super().__init__(BusSettings())
        self.events: list[m.EventMessage] = []

    def publish_event(self, message: m.EventMessage) -> None:
        self.events.append(message)


class House:
    """The lamp has joined."""

    def __init__(self, registry: Registry, bus: RecordingBus) -> None:
        self.registry = registry
        self.bus = bus
        self.findings = Findings(registry)

    async def walk(self, at: np.ndarray[tuple[int, ...], np.dtype[np.float64]], sigma_m: float = 0.3) -> str:
        square = ((GRID.points_m - at) ** 2).sum(axis=1)
        terms = Terms(GRID, 1, -square / (2 * sigma_m**2), np.zeros(len(square)))
        walk = SolvedWalk("located", "", terms, 4000, 15.0, 1)
        finding = await self.findings.take(LAMP, walk)
        return f"{finding.verdict}: {finding.text}"

    def events(self) -> list[str]:
        return [event.kind for event in self.bus.events]


@asynccontextmanager
async def house(folder: Path) -> AsyncIterator[House]:
    bus = RecordingBus()
    async with StoreWorker(folder / "vad.sqlite") as store:
        registry = Registry(settings_for(folder), PLAN, bus, store)
        await registry.load()
        await registry.joined(LAMP, "lamp")
        yield House(registry, bus)


async def test_walks_that_agree_make_it_sharper(tmp_path: Path) -> None:
    async with house(tmp_path) as home:
        assert (await home.walk(STUDY)).startswith("sharper: lamp: waiting, Study, ±")
        assert (await home.walk(STUDY + 0.2)).startswith("sharper: lamp: mapped, Study, ±")
        assert home.events() == ["joined", "mapped"]


async def test_one_walk_that_says_otherwise_changes_nothing(tmp_path: Path) -> None:
    async with house(tmp_path) as home:
        await home.walk(STUDY)
        await home.walk(STUDY)
        before = home.registry.get(LAMP)
        said = await home.walk(KITCHEN)
        assert said.startswith("contradicts: lamp: this walk says Kitchen, the map says Study")
        assert home.findings.doubted(LAMP)
        doubted = home.registry.get(LAMP)
        assert (doubted.state, doubted.reason) == ("mapped", DOUBTED)
        assert (doubted.estimate, doubted.walks) == (before.estimate, 2)
        said = await home.walk(STUDY)
        assert said.endswith("the walk before that said otherwise is left out")
        after = home.registry.get(LAMP)
        assert (after.state, after.reason, after.walks) == ("mapped", "", 3)
        assert not home.findings.doubted(LAMP)
        assert "moved" not in home.events()


async def test_two_walks_in_a_row_move_it(tmp_path: Path) -> None:
    async with house(tmp_path) as home:
        for _ in range(4):
            await home.walk(STUDY)
        await home.walk(KITCHEN)
        said = await home.walk(KITCHEN + 0.2)
        assert said.startswith("moved: lamp was moved, from Study to Kitchen")
        known = home.registry.get(LAMP)
        assert (known.state, known.walks) == ("mapped", 2)
        assert known.estimate is not None
        assert known.estimate.room == "Kitchen"
        assert home.events() == ["joined", "mapped", "mapped", "moved"]


async def test_two_walks_that_contradict_the_map_and_each_other_leave_the_last(tmp_path: Path) -> None:
    async with house(tmp_path) as home:
        await home.walk(STUDY)
        await home.walk(STUDY)
        await home.walk(KITCHEN)
        await home.walk(LIVING_ROOM)
        known = home.registry.get(LAMP)
        assert (known.state, known.walks) == ("waiting", 1)
        assert known.estimate is not None
        assert known.estimate.room == "Living room"


async def test_a_first_walk_that_was_wrong_is_dropped_without_an_alarm(tmp_path: Path) -> None:
    async with house(tmp_path) as home:
        await home.walk(KITCHEN)
        await home.walk(STUDY)
        assert (await home.walk(STUDY)).startswith(
            "begun anew: lamp: its first walks were wrong; mapped, Study"
        )
        assert home.events() == ["joined", "mapped"]


async def test_a_device_that_is_forgotten_meanwhile_does_not_come_back(tmp_path: Path) -> None:
    async with house(tmp_path) as home:
        await home.walk(STUDY)
        await home.registry.forget(LAMP)
        with pytest.raises(DeviceGoneError):
            await home.walk(STUDY)
        assert home.registry.all() == []
        await home.registry.joined(LAMP, "lamp")
        await home.walk(KITCHEN)
        assert home.registry.get(LAMP).walks == 1, "nothing of the old place"


async def test_a_vague_walk_is_evidence_and_no_contradiction(tmp_path: Path) -> None:
    async with house(tmp_path) as home:
        await home.walk(STUDY)
        assert (await home.walk(STUDY + np.array([-1.0, 1.0]), 1.5)).startswith("sharper")
