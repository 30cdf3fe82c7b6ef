"""Who left the network is not asked after: a guest's phone must not take the walks of those who are there."""

from __future__ import annotations

from pathlib import Path

from daemon_world import settings_for

from vad.bus.node import Bus
from vad.bus.session import BusSettings
from vad.capture.schedule import View
from vad.daemon.decisions import DecisionLog
from vad.daemon.measuring import AWAY, Hearing, Measuring
from vad.daemon.registry import Registry
from vad.devices.station import Kind, StationEvent
from vad.sim.home import floor_plan
from vad.sim.scenario import make_home
from vad.store.worker import StoreWorker

GUEST, LAMP = "f4:f5:d8:00:00:21", "f4:f5:d8:00:00:22"
S = 1_000_000_000


def event(kind: Kind, mac: str, at_s: int, interface: str = "wlan0") -> StationEvent:
    return StationEvent(at_s * S, kind, mac, interface)


async def test_who_left_is_not_provoked_and_is_once_it_is_back(tmp_path: Path) -> None:
    settings = settings_for(tmp_path)
    async with StoreWorker(tmp_path / "vad.sqlite") as store:
        registry = Registry(settings, floor_plan(make_home(1)), Bus(BusSettings()), store)
        log = DecisionLog(tmp_path)
        measuring = Measuring(settings.capture, registry, log, provoked_per_s=400.0, now_ns=0)

        async def provoked(at_s: int, per_s: float = 0.0) -> set[str]:
            hearing = lambda _mac: Hearing(per_s, True, "it is not heard at all")  # noqa: E731
            decision = await measuring.decide(at_s * S, View("", (1,)), hearing)
            return set(decision.provoke)

        await registry.take([event("joined", GUEST, 1), event("joined", LAMP, 1)])
        assert await provoked(2) == {GUEST, LAMP}
        await registry.take([event("left", GUEST, 3)])
        assert registry.away(GUEST)
        assert not registry.away(LAMP)
        assert GUEST not in await provoked(4)
        assert AWAY in registry.get(GUEST).reason
        await registry.take([event("joined", GUEST, 500)])
        assert not registry.away(GUEST)
        assert GUEST in await provoked(501)
        await log.close()


async def test_who_went_to_another_access_point_is_not_away(tmp_path: Path) -> None:
    async with StoreWorker(tmp_path / "vad.sqlite") as store:
        registry = Registry(settings_for(tmp_path), floor_plan(make_home(1)), Bus(BusSettings()), store)
        await registry.take([event("joined", LAMP, 1), event("joined", LAMP, 2, "wlan1")])
        await registry.take([event("left", LAMP, 3)])
        assert not registry.away(LAMP)
        await registry.take([event("left", LAMP, 4, "wlan1")])
        assert registry.away(LAMP)
