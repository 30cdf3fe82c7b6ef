"""The asyncio client: many questions at once, events while it asks, a daemon that comes back."""

from __future__ import annotations

import asyncio
from contextlib import aclosing

import numpy as np
import pytest
from bus_world import BROKEN_HEATMAP, device, mac, settings
from waiting import until

from vad.bus import messages as m
from vad.bus.node import Bus
from vad.bus.session import BusSettings, open_session
from vad.client import AsyncVadClient, Change, QueryError, UnreachableError
from vad.errors import VadError


async def test_everything_is_asked_at_once(endpoint: str) -> None:
    heat = m.heatmap_message(
        np.ones((2, 3)), source="live", mac=mac(0), epoch=1, bounds_m=(0, 0, 3, 2), step_m=1
    )
    async with Bus(settings(endpoint)) as bus:
        for i in range(20):
            bus.publish_device(device(i))
        bus.publish_heatmap(heat)
        bus.publish_status(m.StatusMessage(source="live", version="1", uptime_s=1.0))
        bus.publish_camera(m.CameraMessage(source="live", id="front", state="valid"))
        bus.publish_grid(b"png")
        async with AsyncVadClient(endpoint) as client:
            assert await client.hubs() == ["home"]
            found = await asyncio.gather(*(client.device(mac(i)) for i in range(20)))
            assert [one.mac for one in found if one is not None] == [mac(i) for i in range(20)]
            assert len(await client.devices(room="Kitchen")) == 10
            assert len((await client.devices_geojson(state="mapped"))["features"]) == 20
            status = await client.status()
            assert status is not None
            assert status.version == "1"
            assert [camera.id for camera in await client.cameras()] == ["front"]
            assert await client.grid_png() == b"png"
            assert (await client.map(), await client.captures(), await client.recent_events()) == (
                None,
                [],
                [],
            )
            assert await client.device(mac(99)) is None
            array = await client.heatmap_array(mac(0))
            assert array is not None
            assert array.shape == (2, 3)
            assert (await client.heatmap_png(mac(0)) or b"")[:4] == b"\x89PNG"
            assert (await client.heatmap(mac(0))) is not None
            assert "vad.device.v1" in await client.schemas()
            with pytest.raises(QueryError, match="keeps no history") as caught:
                await client.history(mac(0))
            assert caught.value.code == "not_available"
            with pytest.raises(VadError, match="not a device state"):
                await client.devices(state="maped")
            bus.publish_heatmap(BROKEN_HEATMAP)
            with pytest.raises(QueryError, match="ProtocolError"):
                await client.heatmap_png(mac(0))


async def test_events_and_changes_arrive_while_it_asks(endpoint: str) -> None:
    events: list[str] = []
    changes: list[Change] = []

    async def follow_events(client: AsyncVadClient) -> None:
        async for event in client.events():
            events.append(event.text)

    async def follow_changes(client: AsyncVadClient) -> None:
        async with aclosing(client.changes()) as arriving:  # type: ignore[type-var]
            async for change in arriving:
                changes.append(change)
                if change.device is None:
                    return

    client = AsyncVadClient(endpoint)
    async with Bus(settings(endpoint)) as bus:
        await client.open()
        tasks = [asyncio.create_task(follow_events(client)), asyncio.create_task(follow_changes(client))]
        bus.publish_device(device(0))
        for i in range(50):  # until the subscription stands
            bus.publish_event(m.EventMessage(source="live", kind="moved", mac=mac(0), text=str(i)))
            bus.publish_device(device(0, x_m=float(i)))
            assert await client.device(mac(0)) is not None
        await until(lambda: bool(events and changes), "heard")
        bus.forget_device(mac(0))
        await asyncio.wait_for(tasks[1], 40)
    with pytest.raises(UnreachableError, match="no vad daemon answers"):
        await asyncio.wait_for(tasks[0], 40)
    await client.close()
    await client.close()
    assert events[-1] == "49"
    assert changes[-1] == Change(mac(0), None)
    assert changes[-2].device is not None
    assert changes[-2].device.x_m == 49.0


async def test_it_finds_the_restarted_daemon(endpoint: str) -> None:
    async def macs() -> list[str] | None:
        try:
            return [found.mac for found in await client.devices()]
        except UnreachableError:
            return None

    client = AsyncVadClient(endpoint)
    async with Bus(settings(endpoint)) as bus:
        bus.publish_device(device(1))
        await client.open()
        assert await macs() == [mac(1)]
    assert await macs() is None
    async with Bus(settings(endpoint)) as bus:
        bus.publish_device(device(2))
        async with asyncio.timeout(40):
            while await macs() != [mac(2)]:  # noqa: ASYNC110 - the daemon's return has no event
                await asyncio.sleep(0.05)
    await client.close()


async def test_nobody_there_is_said(endpoint: str) -> None:
    with pytest.raises(UnreachableError, match=f"no vad daemon answers at {endpoint}"):
        await AsyncVadClient(endpoint).open()
    router = await asyncio.to_thread(open_session, BusSettings(listen=(endpoint,)))
    with pytest.raises(UnreachableError, match="as hub 'cellar'"):
        await AsyncVadClient(endpoint, "cellar").open()
    await asyncio.to_thread(router.close)  # type: ignore[arg-type]
    with pytest.raises(VadError, match="async with"):
        await AsyncVadClient(endpoint).devices()
