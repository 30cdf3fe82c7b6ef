"""The registry: what becomes of a device from joining to the map; what a restart or a new map does to it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np
import pytest
from daemon_world import ASK_S, LONG_AGO, settings_for
from waiting import free_port

from vad.bus import messages as m
from vad.bus.node import Bus
from vad.bus.session import BusSettings
from vad.client import VadClient
from vad.daemon.registry import Registry
from vad.devices.station import Kind, StationEvent
from vad.errors import VadError
from vad.mapping.evidence import Terms
from vad.mapping.posterior import Grid
from vad.sim.home import floor_plan
from vad.sim.scenario import make_home
from vad.store.records import DeviceRecord
from vad.store.store import Store
from vad.store.worker import StoreWorker

LAMP, TV, PHONE = (f"f4:f5:d8:00:00:0{k}" for k in (1, 2, 3))
PLAN = floor_plan(make_home(1))
GRID = Grid.over(PLAN.bounds_m, 0.1)
PLACE = (1.0, 1.5)

T = TypeVar("T")


def evidence(sigma_m: float, at: tuple[float, float] = PLACE, grid: Grid = GRID) -> Terms:
    """One walk that tells the place with this standard deviation."""
    square = ((grid.points_m - np.array(at)) ** 2).sum(axis=1)
    return Terms(grid, 1, -square / (2 * sigma_m**2), np.zeros(len(square)))


class Hub:
    """A registry with its store and bus, and a client that sees what others see."""

    def __init__(self, registry: Registry, client: VadClient) -> None:
        self.registry = registry
        self._client = client

    async def ask(self, question: Callable[[VadClient], T]) -> T:
        return await asyncio.to_thread(question, self._client)

    async def published(self, mac: str) -> m.DeviceMessage:
        found = await self.ask(lambda client: client.device(mac))
        assert found is not None
        return found


@asynccontextmanager
async def hub(folder: Path, *, epoch: int = 1, **sections: object) -> AsyncIterator[Hub]:
    """What a start of the daemon makes of the store in `folder`."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    settings = settings_for(folder, **sections)
    client = VadClient(endpoint, timeout_s=ASK_S)
    async with StoreWorker(folder / "vad.sqlite") as store, Bus(BusSettings(listen=(endpoint,))) as bus:
        registry = Registry(settings, replace(PLAN, epoch=epoch), bus, store)
        await registry.load()
        await asyncio.to_thread(client.open)
        try:
            yield Hub(registry, client)
        finally:
            await asyncio.to_thread(client.close)


async def test_from_joining_to_the_map(tmp_path: Path) -> None:
    async with hub(tmp_path) as home:
        registry = home.registry
        # Subscribed once this is answered; it is read afterwards, however long all this takes.
        arriving = await home.ask(lambda client: client.events(ASK_S))
        await registry.joined(LAMP, "lamp")
        joined = await home.published(LAMP)
        assert (joined.state, joined.name, joined.x_m, joined.walks) == ("discovered", "lamp", None, 0)
        assert registry.wish(LAMP) == "waiting for somebody to walk through the picture"

        await registry.capturing(LAMP)
        assert (await home.published(LAMP)).state == "capturing"
        await registry.add_evidence(LAMP, evidence(1.0), 5000, 14.0)
        vague = await home.published(LAMP)
        assert (vague.state, vague.walks) == ("waiting", 1)
        assert vague.x_m == pytest.approx(PLACE[0], abs=0.3)
        assert vague.radius90_m is not None
        assert vague.radius90_m > 1.0
        assert vague.reason == registry.wish(LAMP)
        assert "after 1 walk; another walk" in vague.reason

        await registry.add_evidence(LAMP, evidence(0.2), 6000, 16.0)
        sharp = await home.published(LAMP)
        assert (sharp.state, sharp.reason, sharp.walks, sharp.room) == ("mapped", "", 2, "Living room")
        assert (sharp.x_m, sharp.y_m) == (
            pytest.approx(PLACE[0], abs=0.05),
            pytest.approx(PLACE[1], abs=0.05),
        )
        assert sharp.radius90_m is not None
        assert sharp.radius90_m < 0.6
        assert sharp.evidence == {"packets": 11000, "walk_s": 30.0}
        assert len(sharp.region90) > 4
        assert registry.waiting() == []
        heatmap = await home.ask(lambda client: client.heatmap(LAMP))
        assert heatmap is not None
        assert m.probabilities(heatmap).sum() == pytest.approx(1.0, abs=1e-3)
        await registry.joined(TV, None)  # the last event: there is no other before it
        events = await asyncio.to_thread(lambda: list(islice(arriving, 3)))
        told = [(event.kind, event.mac) for event in events]
        assert told == [("joined", LAMP), ("mapped", LAMP), ("joined", TV)]
        assert "mapped in Living room, ±" in events[1].text
        await asyncio.to_thread(arriving.close)


async def test_one_sharp_walk_is_not_enough_and_eight_vague_ones_fail(tmp_path: Path) -> None:
    async with hub(tmp_path) as home:
        await home.registry.joined(LAMP, None)
        await home.registry.add_evidence(LAMP, evidence(0.2), 5000, 14.0)
        assert (await home.published(LAMP)).state == "waiting", "min_walks is 2"
        await home.registry.joined(TV, None)
        for _ in range(8):
            await home.registry.add_evidence(TV, evidence(30.0), 5000, 14.0)
        failed = await home.published(TV)
        assert failed.state == "failed"
        assert "walk elsewhere" in failed.reason


async def test_the_device_with_the_fewest_walks_is_next(tmp_path: Path) -> None:
    async with hub(tmp_path) as home:
        for mac in (LAMP, TV, PHONE):
            await home.registry.joined(mac, None)
        await home.registry.add_evidence(LAMP, evidence(2.0), 5000, 14.0)
        assert [device.mac for device in home.registry.waiting()] == [TV, PHONE, LAMP]


async def test_a_restart_keeps_everything(tmp_path: Path) -> None:
    async with hub(tmp_path) as home:
        await home.registry.joined(LAMP, "lamp")
        for _ in range(2):
            await home.registry.add_evidence(LAMP, evidence(0.2), 5000, 14.0)
        await home.registry.joined(TV, "tv")
        await home.registry.add_evidence(TV, evidence(1.0), 5000, 14.0)
        before = [await home.published(mac) for mac in (LAMP, TV)]
        heat_before = await home.ask(lambda client: client.heatmap(LAMP))
    async with hub(tmp_path) as home:
        after = [await home.published(mac) for mac in (LAMP, TV)]
        assert [replace_times(one) for one in after] == [replace_times(one) for one in before]
        heat_after = await home.ask(lambda client: client.heatmap(LAMP))
        assert heat_before is not None
        assert heat_after is not None
        np.testing.assert_allclose(m.probabilities(heat_after), m.probabilities(heat_before), atol=1e-6)
        # And evidence goes on where it was.
        await home.registry.add_evidence(TV, evidence(0.3), 5000, 14.0)
        assert (await home.published(TV)).walks == 2


def replace_times(message: m.DeviceMessage) -> m.DeviceMessage:
    """Without what a restart does change: nobody is in the network until a source says so."""
    return msgspec.structs.replace(message, published_at="", in_network=False)


async def test_another_map_makes_places_stale_until_they_are_measured_anew(tmp_path: Path) -> None:
    async with hub(tmp_path) as home:
        await home.registry.joined(LAMP, None)
        for _ in range(2):
            await home.registry.add_evidence(LAMP, evidence(0.2), 5000, 14.0)
    async with hub(tmp_path, epoch=2) as home:
        registry = home.registry
        stale = await home.published(LAMP)
        assert (stale.state, stale.epoch) == ("stale", 1)
        assert stale.reason == "measured on map epoch 1, the map is now epoch 2"
        assert [device.mac for device in registry.waiting()] == [LAMP]
        await registry.wait(LAMP, "it is not heard at all")
        waiting = await home.published(LAMP)
        assert waiting.state == "stale"
        assert waiting.reason.endswith("epoch 2; it is not heard at all")
        # A capture that comes to nothing does not make old coordinates good.
        await registry.capturing(LAMP)
        await registry.wait(LAMP, registry.wish(LAMP))
        assert (await home.published(LAMP)).state == "stale"

        new_place = (3.0, 2.0)
        await registry.add_evidence(LAMP, evidence(0.2, new_place), 5000, 14.0)
        fresh = await home.published(LAMP)
        assert (fresh.state, fresh.epoch, fresh.walks) == ("waiting", 2, 1)
        assert fresh.x_m == pytest.approx(new_place[0], abs=0.05), "nothing of the old map is left in it"
        assert fresh.evidence["packets"] == 5000


async def test_a_plan_that_has_grown_keeps_what_was_measured(tmp_path: Path) -> None:
    async with hub(tmp_path) as home:
        await home.registry.joined(LAMP, None)
        await home.registry.add_evidence(LAMP, evidence(0.5), 5000, 14.0)
        x0, y0, x1, y1 = PLAN.bounds_m
        wider = Grid.over((x0 - 1, y0 - 1, x1 + 1, y1 + 1), 0.1)
        await home.registry.add_evidence(LAMP, evidence(0.5, grid=wider), 5000, 14.0)
        message = await home.published(LAMP)
        assert message.walks == 2
        assert message.x_m == pytest.approx(PLACE[0], abs=0.15), "the plan's walls pull a little"


async def test_a_capture_that_was_cut_off_waits_again(tmp_path: Path) -> None:
    async with hub(tmp_path) as home:
        await home.registry.joined(LAMP, None)
        await home.registry.capturing(LAMP)
    async with hub(tmp_path) as home:
        message = await home.published(LAMP)
        assert (message.state, message.reason) == ("waiting", "the daemon stopped during a capture")


async def test_ignored_devices_do_not_exist_and_given_names_win(tmp_path: Path) -> None:
    devices = {"ignore": [PHONE.upper()], "static": [{"mac": TV.upper(), "name": "the big one"}]}
    async with hub(tmp_path, devices=devices) as home:
        for mac, name in ((PHONE, "phone"), (TV, "LG-webOS"), (LAMP, None)):
            await home.registry.joined(mac, name)
        found = await home.ask(lambda client: client.devices())
        assert [(one.mac, one.name) for one in found] == [(LAMP, None), (TV, "the big one")]
        await home.registry.joined(LAMP, "lamp")
        assert (await home.published(LAMP)).name == "lamp", "a name that comes later is taken"


async def test_the_same_reason_again_is_no_news(tmp_path: Path) -> None:
    async with hub(tmp_path) as home:
        await home.registry.joined(LAMP, None)
        await home.registry.wait(LAMP, "it is not heard at all")
        before = home.registry.get(LAMP)
        await home.registry.wait(LAMP, "it is not heard at all")
        assert home.registry.get(LAMP) is before


RANDOM, RANDOM_LATER = "02:00:00:00:00:0a", "06:00:00:00:00:0b"


def event(kind: Kind, mac: str, after_s: float = 0.0, **facts: str) -> StationEvent:
    return StationEvent(time.monotonic_ns() + round(after_s * 1e9), kind, mac, "wlan0", **facts)


async def test_who_a_device_is_is_published_and_survives_a_restart(tmp_path: Path) -> None:
    makers = tmp_path / "manuf"
    makers.write_text("f4f5d8 Google\n")
    devices = {"hostapd": ["x"], "makers": str(makers)}
    async with hub(tmp_path, devices=devices) as home:
        assert await home.registry.take([event("joined", LAMP)]) == [LAMP]
        told = event("told", LAMP, host_name="nest-mini", ip="192.168.1.20")
        assert await home.registry.take([told]) == []
        message = await home.published(LAMP)
        assert (message.vendor, message.host_name, message.ip) == ("Google", "nest-mini", "192.168.1.20")
        assert (message.name, message.macs, message.random_mac) == ("nest-mini", (LAMP,), False)
        assert (message.in_network, message.moved, message.agent) == (True, False, None)
        assert message.first_seen is not None
        assert home.registry.ip_of(LAMP) == "192.168.1.20"
        await home.registry.take([event("left", LAMP)])
        before = await home.published(LAMP)
        assert (before.in_network, before.last_seen is None) == (False, False)
    async with hub(tmp_path, devices=devices) as home:
        assert replace_times(await home.published(LAMP)) == replace_times(before)
        assert home.registry.ip_of(LAMP) == "192.168.1.20"


async def test_a_phone_with_a_new_address_keeps_its_walks(tmp_path: Path) -> None:
    async with hub(tmp_path) as home:
        registry = home.registry
        await registry.take([event("joined", RANDOM, host_name="Annas-Phone", ip="10.0.0.5")])
        for _ in range(2):
            await registry.add_evidence(RANDOM, evidence(0.2), 5000, 14.0)
        await registry.take([event("left", RANDOM)])
        assert await registry.take([event("joined", RANDOM_LATER)]) == [RANDOM_LATER]
        assert (await home.published(RANDOM_LATER)).state == "discovered"
        await registry.take([event("told", RANDOM_LATER, host_name="Annas-Phone", ip="10.0.0.6")])
        assert await home.ask(lambda client: client.device(RANDOM_LATER)) is None
        phone = await home.published(RANDOM)
        assert (phone.state, phone.walks, phone.macs) == ("mapped", 2, (RANDOM, RANDOM_LATER))
        assert registry.sends_as(RANDOM) == RANDOM_LATER
        assert registry.ip_of(RANDOM) == "10.0.0.6"
        assert [device.mac for device in registry.all()] == [RANDOM]
    async with hub(tmp_path) as home:
        assert [device.mac for device in home.registry.all()] == [RANDOM]
        assert home.registry.sends_as(RANDOM) == RANDOM_LATER


async def test_who_comes_back_after_a_while_may_have_been_carried(tmp_path: Path) -> None:
    async with hub(tmp_path) as home:
        registry = home.registry
        assert await registry.take([event("joined", LAMP)]) == [LAMP]
        assert await registry.take([event("left", LAMP, 10.0), event("joined", LAMP, 12.0)]) == []
        assert await registry.take([event("left", LAMP, 20.0)]) == []
        assert await registry.take([event("joined", LAMP, 60.0)]) == [LAMP]


async def test_what_is_ignored_vanishes_and_comes_back_as_it_was(tmp_path: Path) -> None:
    async with hub(tmp_path) as home:
        await home.registry.joined(LAMP, "lamp")
        for _ in range(2):
            await home.registry.add_evidence(LAMP, evidence(0.2), 5000, 14.0)
        await home.registry.ignore(LAMP.upper(), on=True)
        assert await home.ask(lambda client: client.devices()) == []
        assert await home.ask(lambda client: client.heatmap(LAMP)) is None
        await home.registry.joined(LAMP, "lamp")
        assert home.registry.all() == []
    async with hub(tmp_path) as home:
        assert home.registry.all() == []
        assert await home.ask(lambda client: client.devices()) == []
        await home.registry.ignore(LAMP, on=False)
        again = await home.published(LAMP)
        assert (again.state, again.walks, again.name) == ("mapped", 2, "lamp")
        with pytest.raises(VadError, match="no device with the address"):
            await home.registry.ignore(TV, on=True)


async def test_a_device_is_renamed_and_forgotten(tmp_path: Path) -> None:
    async with hub(tmp_path, devices={"static": [{"mac": TV, "name": "the big one"}]}) as home:
        await home.registry.joined(LAMP, "ESP_1234")
        await home.registry.joined(TV, None)
        await home.registry.rename(LAMP, "lamp")
        assert (await home.published(LAMP)).name == "lamp"
        with pytest.raises(VadError, match="'the big one' in the settings"):
            await home.registry.rename(TV, "small")
    async with hub(tmp_path) as home:
        assert (await home.published(LAMP)).name == "lamp"
        await home.registry.rename(LAMP, "")
        assert (await home.published(LAMP)).name == "ESP_1234"
        await home.registry.add_evidence(LAMP, evidence(0.2), 5000, 14.0)
        await home.registry.forget(LAMP)
        assert await home.ask(lambda client: client.device(LAMP)) is None
        await home.registry.joined(LAMP, None)
        fresh = await home.published(LAMP)
        assert (fresh.state, fresh.walks, fresh.name) == ("discovered", 0, None)


@pytest.mark.slow
async def test_several_thousand_passers_by_leave_the_home_as_it_was(tmp_path: Path) -> None:
    async with hub(tmp_path) as home:
        registry = home.registry
        await registry.joined(LAMP, "lamp")
        await registry.add_evidence(LAMP, evidence(0.2), 5000, 14.0)
        for begin in range(0, 3000, 500):
            events = []
            for number in range(begin, begin + 500):
                mac = f"02:00:00:00:{number >> 8:02x}:{number & 255:02x}"
                events += [event("joined", mac, host_name=f"p-{number}"), event("left", mac)]
            await registry.take(events)
        assert len(registry.all()) <= 1000
        assert (await home.published(LAMP)).walks == 1
        assert len(await home.ask(lambda client: client.devices())) == len(registry.all())
    async with hub(tmp_path) as home:
        assert len(home.registry.all()) <= 1000
        assert home.registry.get(LAMP).walks == 1


async def test_devices_of_a_store_without_a_table_are_taken_in(tmp_path: Path) -> None:
    with Store(tmp_path / "vad.sqlite") as store:
        store.save_device(DeviceRecord(LAMP, "waiting", LONG_AGO, LONG_AGO, name="lamp"))
    async with hub(tmp_path) as home:
        message = await home.published(LAMP)
        assert (message.name, message.first_seen, message.macs) == ("lamp", LONG_AGO, (LAMP,))


async def test_a_doubted_place_says_so(tmp_path: Path) -> None:
    async with hub(tmp_path) as home:
        await home.registry.joined(LAMP, None)
        for _ in range(2):
            await home.registry.add_evidence(LAMP, evidence(0.2), 5000, 14.0)
        await home.registry.doubt(LAMP, on=True)
        assert (await home.published(LAMP)).moved
        await home.registry.doubt(LAMP, on=False)
        assert not (await home.published(LAMP)).moved
