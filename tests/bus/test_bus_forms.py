"""The forms of an answer beside messages: GeoJSON, pictures, arrays, the past, last events, schemas."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable

import cv2
import numpy as np
import pytest
import zenoh
from bus_world import ask_raw, device, mac, settings
from waiting import until

from vad.bus import messages as m
from vad.bus.answers import HistoryError
from vad.bus.board import EVENTS_KEPT
from vad.bus.grid import heatmap_to_npy, heatmap_to_png, npy_to_heatmap
from vad.bus.node import MAX_LATER, Bus
from vad.bus.schemas import json_schemas
from vad.bus.selectors import HistoryQuestion
from vad.bus.session import BusSettings, open_session
from vad.client import QueryError, VadClient
from vad.errors import ProtocolError
from vad.wall import now_rfc3339

NOON = "2026-01-31T12:00:00.000Z"


class Memory:
    """A past of two devices, known since noon; `gate` holds every answer back."""

    def __init__(self) -> None:
        self.gate = asyncio.Event()
        self.gate.set()
        self.asked: list[tuple[str, str | None]] = []

    async def devices_at(self, at: str, mac_: str | None) -> list[m.DeviceMessage]:
        self.asked.append((at, mac_))
        await self.gate.wait()
        if at < NOON:
            raise HistoryError("nothing is kept of that time", where=at)
        known = [device(i, name="then", updated_at=NOON) for i in range(2)]
        return [one for one in known if mac_ in (None, one.mac)]

    async def history(self, mac_: str, question: HistoryQuestion) -> m.HistoryMessage | None:
        if mac_ != mac(0):
            return None
        entry = m.HistoryEntry(at=NOON, state="mapped", epoch=1, x_m=1.0, y_m=2.0, walks=question.limit)
        return m.HistoryMessage(source="live", mac=mac_, entries=(entry,))


async def asking(endpoint: str, question: Callable[[VadClient], object]) -> object:
    def ask() -> object:
        with VadClient(endpoint) as client:
            return question(client)

    return await asyncio.to_thread(ask)


async def test_devices_as_geojson(endpoint: str) -> None:
    async with Bus(settings(endpoint)) as bus:
        bus.publish_device(device(1))
        bus.publish_device(device(0, room="Tom & Jerry"))
        bus.publish_device(device(2, state="waiting", x_m=None, y_m=None, covariance_m2=None))
        found = await asking(endpoint, VadClient.devices_geojson)
        assert isinstance(found, dict)
        assert found["type"] == "FeatureCollection"
        assert [f["id"] for f in found["features"]] == [mac(0), mac(1), mac(2)]
        assert found["features"][1]["geometry"] == {"type": "Point", "coordinates": [1.0, 1.0]}
        assert found["features"][1]["properties"]["radius90_m"] == 0.3
        assert found["features"][2]["geometry"] is None
        narrowed = await asking(endpoint, lambda c: c.devices_geojson(room="Tom & Jerry"))
        assert isinstance(narrowed, dict)
        assert [f["id"] for f in narrowed["features"]] == [mac(0)]
        (one,) = await asyncio.to_thread(ask_raw, endpoint, f"vad/*/devices/{mac(1)}?format=geojson")
        assert one.ok is not None
        assert str(one.ok.encoding) == "application/geo+json"
        assert json.loads(one.ok.payload.to_bytes()) == found["features"][1]


async def test_all_devices_in_one_reply_follow_every_change(endpoint: str) -> None:
    async with Bus(settings(endpoint), source="simulated") as bus:

        async def together() -> m.DevicesMessage:
            (reply,) = await asyncio.to_thread(ask_raw, endpoint, "vad/home/devices")
            assert reply.ok is not None
            assert str(reply.ok.encoding) == "application/json;vad.devices.v1"
            return m.decode(reply.ok.payload.to_bytes(), m.DevicesMessage)

        nothing = await together()
        assert (nothing.devices, nothing.source, nothing.hub) == ((), "simulated", "home")
        bus.publish_device(device(1))
        bus.publish_device(device(0))
        assert [d.mac for d in (await together()).devices] == [mac(0), mac(1)]
        bus.publish_device(device(1, x_m=7.0))
        assert [d.x_m for d in (await together()).devices] == [0.0, 7.0]
        bus.forget_device(mac(0))
        assert [d.mac for d in (await together()).devices] == [mac(1)]
        wild = await asyncio.to_thread(ask_raw, endpoint, "vad/home/**")
        keys = [str(reply.ok.key_expr) for reply in wild if reply.ok is not None]
        assert len(keys) == len(wild) == len(set(keys))
        assert f"vad/home/devices/{mac(1)}" in keys
        assert "vad/home/devices" not in keys, "nobody wants every device twice"


async def test_since_tells_what_changed(endpoint: str) -> None:
    async with Bus(settings(endpoint)) as bus:
        bus.publish_device(device(0))
        bus.publish_device(device(1))
        first = await asking(endpoint, VadClient.devices)
        assert isinstance(first, list)
        last = max(d.published_at for d in first)
        await until(lambda: now_rfc3339() > last, "a later time: the stamps count milliseconds")
        bus.publish_device(device(0))  # the same again
        bus.publish_device(device(1, x_m=3.0))
        changed = await asking(endpoint, lambda c: c.devices(since=last))
        assert isinstance(changed, list)
        assert [d.mac for d in changed] == [mac(1)]
        boxed = await asking(endpoint, lambda c: c.devices(bbox=(2.5, 0.0, 3.5, 2.0)))
        assert isinstance(boxed, list)
        assert [d.mac for d in boxed] == [mac(1)]


async def test_a_heatmap_as_picture_and_array(endpoint: str) -> None:
    probability = np.zeros((20, 30), np.float32)
    probability[3, 25] = 0.75
    probability[4, 25] = 0.25
    heat = m.heatmap_message(
        probability, source="live", mac=mac(0), epoch=1, bounds_m=(0, 0, 3, 2), step_m=0.1
    )
    async with Bus(settings(endpoint)) as bus:
        bus.publish_heatmap(heat)
        np.testing.assert_array_equal(await asking(endpoint, lambda c: c.heatmap_array(mac(0))), probability)
        png = await asking(endpoint, lambda c: c.heatmap_png(mac(0)))
        assert isinstance(png, bytes)
        picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
        assert picture is not None
        assert picture.shape == (20, 30, 4)
        opaque = picture[..., 3]
        assert (opaque[19 - 3, 25], opaque[19 - 4, 25]) == (255, 147), "top row is the highest y"
        assert np.count_nonzero(opaque) == 2, "clear where the device is not"
        assert await asking(endpoint, lambda c: (c.heatmap_png(mac(1)), c.heatmap_array(mac(1)))) == (
            None,
            None,
        )


@pytest.mark.parametrize("payload", [b"", b"no array", heatmap_to_npy(np.ones((2, 2)))[:-1]])
def test_a_damaged_array_is_a_protocol_error(payload: bytes) -> None:
    with pytest.raises(ProtocolError, match="no array"):
        npy_to_heatmap(payload)


def test_an_array_of_another_kind_is_a_protocol_error() -> None:
    wide = heatmap_to_npy(np.ones((2, 2), np.float32)).replace(b"<f4", b"<i4")
    with pytest.raises(ProtocolError, match="not float32 of two axes"):
        npy_to_heatmap(wide)


def test_a_heatmap_of_nothing_is_a_clear_picture() -> None:
    picture = cv2.imdecode(np.frombuffer(heatmap_to_png(np.zeros((4, 5), np.float32)), np.uint8), -1)
    assert picture is not None
    assert not picture[..., 3].any()


async def test_the_past_is_asked_of_who_remembers(endpoint: str) -> None:
    memory = Memory()
    async with Bus(settings(endpoint)) as bus:
        bus.ask_past(memory)
        bus.publish_device(device(0, name="now"))
        one = await asking(endpoint, lambda c: c.device(mac(0), at="2026-01-31T14:00:00+01:00"))
        assert isinstance(one, m.DeviceMessage)
        assert (one.name, one.hub) == ("then", "home")
        assert memory.asked == [("2026-01-31T13:00:00.000Z", mac(0))]
        kitchen = await asking(endpoint, lambda c: c.devices(room="Kitchen", at=NOON))
        assert isinstance(kitchen, list)
        assert [d.mac for d in kitchen] == [mac(1)]
        places = await asking(endpoint, lambda c: c.devices_geojson(at=NOON))
        assert isinstance(places, dict)
        assert [f["id"] for f in places["features"]] == [mac(0), mac(1)]
        each = await asyncio.to_thread(ask_raw, endpoint, f"vad/home/devices/*?at={NOON}")
        assert len(each) == 2
        history = await asking(endpoint, lambda c: c.history(mac(0), limit=7))
        assert isinstance(history, m.HistoryMessage)
        assert [(e.at, e.walks) for e in history.entries] == [(NOON, 7)]
        assert await asking(endpoint, lambda c: c.history(mac(5))) is None
        with pytest.raises(QueryError, match="nothing is kept of that time") as caught:
            await asking(endpoint, lambda c: c.device(mac(0), at="2025-01-01T00:00:00Z"))
        assert caught.value.code == "out_of_history"


async def test_too_many_questions_about_the_past_are_told_to_wait(endpoint: str) -> None:
    memory = Memory()
    memory.gate.clear()
    async with Bus(settings(endpoint)) as bus:
        bus.ask_past(memory)
        selector = f"vad/home/devices?at={NOON}"
        waiting = [asyncio.create_task(asyncio.to_thread(ask_raw, endpoint, selector)) for _ in range(3)]
        await until(lambda: len(memory.asked) == 3, "asked")
        with zenoh_session(endpoint) as session:
            replies = [session.get(selector, timeout=40.0) for _ in range(MAX_LATER)]
            await until(lambda: bus.health.counters["refused"] == 3, "three are too many")
            memory.gate.set()
            errors = [r for replied in replies for r in await asyncio.to_thread(list, replied) if r.err]
        assert [m.decode(r.err.payload.to_bytes(), m.ErrorMessage).code for r in errors if r.err] == [
            "busy"
        ] * 3
        for task in waiting:
            (reply,) = await task
            assert reply.ok is not None


async def test_closing_does_not_wait_for_the_past(endpoint: str) -> None:
    memory = Memory()
    memory.gate.clear()
    bus = Bus(settings(endpoint))
    await bus.open()
    bus.ask_past(memory)
    with zenoh_session(endpoint) as session:
        session.get(f"vad/home/devices?at={NOON}", timeout=40.0)
        await until(lambda: len(memory.asked) == 1, "asked")
        async with asyncio.timeout(40):
            await bus.close()


async def test_the_last_events_are_answered(endpoint: str) -> None:
    async with Bus(settings(endpoint)) as bus:
        for i in range(EVENTS_KEPT + 4):
            bus.publish_event(m.EventMessage(source="live", kind="joined", mac=mac(i), text=str(i)))
        kept = await asking(endpoint, VadClient.recent_events)
        assert isinstance(kept, list)
        assert sorted(int(event.text) for event in kept) == list(range(4, EVENTS_KEPT + 4))
        stamps = [(at, m.decode(payload, m.EventMessage).published_at) for at, payload in bus._board.events]
        assert all(at == told for at, told in stamps), "`since` means the times that the events tell"
        newest = max(event.published_at for event in kept)
        assert await asking(endpoint, lambda c: c.recent_events(since=newest)) == []


async def test_schemas_are_published_and_answered(endpoint: str) -> None:
    async with Bus(settings(endpoint)):
        found = await asking(endpoint, VadClient.schemas)
        assert found == {name: json.loads(text) for name, text in json_schemas().items()}
        (one,) = await asyncio.to_thread(ask_raw, endpoint, "vad/home/schema/vad.device.v1")
        assert one.ok is not None
        assert one.ok.payload.to_bytes().decode() == json_schemas()["vad.device.v1"]


def zenoh_session(endpoint: str) -> zenoh.Session:
    return open_session(BusSettings(mode="client", connect=(endpoint,)))
