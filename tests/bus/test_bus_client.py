"""What the client says when a daemon restarts, dies, or answers nonsense."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import threading
import zlib

import pytest
from bus_world import BROKEN_HEATMAP, ROOT, device, mac, settings
from waiting import until

from vad.bus import messages as m
from vad.bus.node import Bus
from vad.bus.session import BusSettings, open_session
from vad.client import QueryError, UnreachableError, VadClient
from vad.errors import ProtocolError


async def test_the_client_says_what_the_daemon_refused(endpoint: str) -> None:
    def ask() -> None:
        with VadClient(endpoint) as client, pytest.raises(QueryError, match="ProtocolError") as caught:
            client.heatmap_png(mac(0))
        assert caught.value.code == "internal"

    async with Bus(settings(endpoint)) as bus:
        bus.publish_heatmap(BROKEN_HEATMAP)
        await asyncio.to_thread(ask)


async def test_a_message_of_another_version_is_said_so(endpoint: str) -> None:
    def ask() -> None:
        with VadClient(endpoint) as client, pytest.raises(ProtocolError, match=r"not vad\.devices\.v1"):
            client.devices()

    async with Bus(settings(endpoint)) as bus:
        bus.publish_device(device(0, schema="vad.device.v9"))
        await asyncio.to_thread(ask)


async def test_events_arrive_and_end_with_the_daemon(endpoint: str) -> None:
    heard: list[str] = []
    ready = threading.Event()

    def listen() -> None:
        with VadClient(endpoint) as client:
            events = client.events()
            ready.set()
            with pytest.raises(UnreachableError):
                heard.extend(event.text for event in iter(lambda: next(events), None))

    def listen_a_little() -> list[m.EventMessage]:
        with VadClient(endpoint) as client:
            return list(client.events(timeout_s=0.05))

    async with Bus(settings(endpoint)) as bus:
        assert await asyncio.to_thread(listen_a_little) == []
        listening = asyncio.create_task(asyncio.to_thread(listen))
        await until(ready.is_set, "subscribed")
        for i in range(3):
            bus.publish_event(m.EventMessage(source="live", kind="moved", mac=mac(i), text=str(i)))
        await until(lambda: len(heard) == 3, "all heard")
    await asyncio.wait_for(listening, 40)
    assert heard == ["0", "1", "2"]


async def test_a_client_finds_the_restarted_daemon(endpoint: str) -> None:
    def ask(client: VadClient) -> list[str] | None:
        try:
            return [found.mac for found in client.devices()]
        except UnreachableError:
            return None

    client = VadClient(endpoint)
    async with Bus(settings(endpoint)) as bus:
        bus.publish_device(device(1))
        await asyncio.to_thread(client.open)
        assert await asyncio.to_thread(ask, client) == [mac(1)]
    assert await asyncio.to_thread(ask, client) is None, "a dead daemon is not an empty home"
    async with Bus(settings(endpoint)) as bus:
        bus.publish_device(device(2))
        await until(lambda: ask(client) == [mac(2)], "found again")
    client.close()
    client.close()


async def test_a_killed_daemon_is_noticed(endpoint: str) -> None:
    daemon = (
        "import asyncio, sys\nfrom vad.bus.node import Bus\nfrom vad.bus.session import BusSettings\n"
        "async def main():\n"
        "    async with Bus(BusSettings(listen=(sys.argv[1],))):\n"
        "        print('up', flush=True)\n"
        "        await asyncio.Event().wait()\n"
        "asyncio.run(main())\n"
    )
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", daemon, endpoint, stdout=subprocess.PIPE, cwd=ROOT
    )
    assert process.stdout is not None
    client = VadClient(endpoint)
    try:
        assert await process.stdout.readline() == b"up\n"
        await asyncio.to_thread(client.open)
        assert await asyncio.to_thread(client.devices) == []
    finally:
        process.kill()
        await process.wait()
    await until(lambda: not client.hubs(), "the token is gone")
    with pytest.raises(UnreachableError, match=f"no vad daemon answers at {endpoint}"):
        await asyncio.to_thread(client.devices)
    client.close()
    with pytest.raises(UnreachableError, match="Start it"):
        await asyncio.to_thread(client.open)


def test_a_router_without_a_daemon_is_no_daemon(endpoint: str) -> None:
    router = open_session(BusSettings(listen=(endpoint,)))
    with pytest.raises(UnreachableError, match="as hub 'cellar'"), VadClient(endpoint, "cellar"):
        pass
    router.close()


@pytest.mark.parametrize(
    "payload", [b"", b"no zlib", zlib.compress(b"\0" * 20), zlib.compress(b"\0" * 10**6)]
)
def test_a_damaged_heatmap_is_a_protocol_error(payload: bytes) -> None:
    heat = m.HeatmapMessage(
        source="live",
        mac=mac(0),
        epoch=1,
        bounds_m=(0, 0, 3, 2),
        step_m=1,
        width=3,
        height=2,
        probability=payload,
    )
    with pytest.raises(ProtocolError, match="heatmap"):
        m.probabilities(heat)
