"""Home Assistant over MQTT, against a real Mosquitto: what is retained, what is seen when something ends."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from link_world import TOPICS, closed_bus, home_assistant
from mosquitto_world import START_S, Mosquitto, Watcher, needs_mosquitto, retained_at
from waiting import free_port, until

from vad.bus import messages as m
from vad.bus.grid import grid_to_png
from vad.bus.node import Bus
from vad.homeassistant import broker as broker_module
from vad.homeassistant import link

LAMP, PHONE = "f4:f5:d8:d3:35:b2", "3a:11:22:33:44:55"

DRAWN_S = 320.0
"""Drawing gives way to all else on a machine."""

pytestmark = needs_mosquitto


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """The waits of a year's run, shortened; a broker on a busy machine has time."""
    monkeypatch.setattr(broker_module, "ANSWER_TIMEOUT_S", START_S)
    monkeypatch.setattr(broker_module, "FAREWELL_S", START_S)
    monkeypatch.setattr(link, "FIRST_RETRY_S", 0.05)
    monkeypatch.setattr(link, "LAST_RETRY_S", 0.2)
    monkeypatch.setattr(link, "STATUS_EVERY_NS", 50_000_000)
    monkeypatch.setattr(link, "DEVICE_EVERY_NS", 20_000_000)
    monkeypatch.setattr(link, "PICTURE_EVERY_S", 0.05)


@pytest.fixture
def bus() -> Bus:
    return closed_bus()


def device(mac: str, **changes: Any) -> m.DeviceMessage:
    fields: dict[str, Any] = {
        "source": "live",
        "mac": mac,
        "name": "Lamp",
        "state": "mapped",
        "x_m": 1.494,
        "y_m": -0.26,
        "covariance_m2": ((0.04, 0.0), (0.0, 0.01)),
        "radius90_m": 0.45,
        "room": "Living room",
        "macs": (mac,),
        "in_network": True,
    }
    return m.DeviceMessage(**(fields | changes))


def status(step: str, **parts: str) -> m.StatusMessage:
    told = tuple(
        m.Part(part=part, state="ok" if said == "ok" else "degraded", detail=said)
        for part, said in parts.items()
    )
    return m.StatusMessage(source="live", version="1", uptime_s=1.0, step=step, parts=told)


async def test_devices_and_health_are_there_for_who_comes_later(bus: Bus, tmp_path: Path) -> None:
    bus.publish_device(device(LAMP))
    bus.publish_status(status("waiting for somebody to walk", camera="ok", robot="no pose for 5 s"))
    with Mosquitto(tmp_path) as broker:
        async with Watcher(broker.port) as watcher, home_assistant(bus, tmp_path, broker.port):
            await watcher.until_says(TOPICS.availability, b"online")
            await watcher.until(lambda: TOPICS.status in watcher.payloads, "the status")
        kept = await retained_at(broker.port)
    assert set(kept) == {
        TOPICS.hub_config,
        TOPICS.device_config(LAMP),
        TOPICS.device(LAMP),
        TOPICS.status,
        TOPICS.availability,
    }
    assert kept[TOPICS.availability] == b"offline"  # the daemon has ended since
    said = msgspec.json.decode(kept[TOPICS.device(LAMP)])
    assert (said["room"], said["x_m"], said["y_m"], said["radius_90_m"]) == ("Living room", 1.49, -0.26, 0.45)
    assert (said["sigma_m"], said["mapping"], said["in_zones"]) == (0.2, "mapped", ["zone.home"])
    hub = msgspec.json.decode(kept[TOPICS.status])
    assert (hub["problem"], hub["problems"]) == ("ON", {"robot": "no pose for 5 s"})
    assert (hub["devices"], hub["mapped"], hub["step"]) == (1, 1, "waiting for somebody to walk")


async def test_a_killed_broker_is_trouble_and_its_return_brings_everything(bus: Bus, tmp_path: Path) -> None:
    bus.publish_device(device(LAMP))
    with Mosquitto(tmp_path) as broker:
        async with home_assistant(bus, tmp_path, broker.port) as running:
            async with Watcher(broker.port) as watcher:
                await watcher.until_says(TOPICS.availability, b"online")
                assert running.health.state == "ok"
                broker.kill()
                await until(lambda: running.health.state == "degraded")
            bus.publish_device(device(LAMP, room="Kitchen"))
            bus.publish_device(device(PHONE, name="Phone"))
            broker.start()
            async with Watcher(broker.port) as watcher:
                await watcher.until(lambda: TOPICS.device(PHONE) in watcher.payloads, "what came meanwhile")
                await watcher.until_says(TOPICS.availability, b"online")
                assert watcher.json(TOPICS.device(LAMP))["room"] == "Kitchen"
            assert running.health.state == "ok"
            assert running.health.counters["connects"] == 2


async def test_no_broker_is_no_reason_to_end(bus: Bus, tmp_path: Path) -> None:
    async with home_assistant(bus, tmp_path, free_port()) as running:
        await until(lambda: running.health.state == "degraded")
        assert "refused" in running.health.detail
        assert "mqtt.host" in running.health.detail


@pytest.fixture
async def mute() -> AsyncIterator[int]:
    """A port where somebody takes connections and says nothing."""
    writers: list[asyncio.StreamWriter] = []
    server = await asyncio.start_server(lambda _, writer: writers.append(writer), "127.0.0.1", 0)
    async with server:
        yield server.sockets[0].getsockname()[1]
        for writer in writers:
            writer.transport.abort()


async def test_something_else_at_the_brokers_port(
    bus: Bus, tmp_path: Path, mute: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(broker_module, "ANSWER_TIMEOUT_S", 0.2)
    async with home_assistant(bus, tmp_path, mute) as running:
        await until(lambda: "no MQTT broker" in running.health.detail)


async def test_the_daemon_ends_soon_while_a_broker_does_not_answer(
    bus: Bus, tmp_path: Path, mute: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It does not wait for the answer: that would be half an hour here."""
    monkeypatch.setattr(broker_module, "ANSWER_TIMEOUT_S", 1800.0)
    monkeypatch.setattr(broker_module, "FAREWELL_S", 0.5)
    async with home_assistant(bus, tmp_path, mute) as running:
        await until(_connecting)
        assert running.health.state == "starting"


async def test_a_broker_that_hangs_at_the_end_leaves_no_connection(
    bus: Bus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else its socket, and a task beside it, would be nobody's: `no_leaked_tasks` looks for that."""
    monkeypatch.setattr(broker_module, "FAREWELL_S", 0.2)
    with Mosquitto(tmp_path) as broker:
        async with home_assistant(bus, tmp_path, broker.port) as running:
            await until(lambda: running.health.state == "ok", "it is connected")
            broker.freeze()


def _connecting() -> bool:
    """Whether the client's own connection, after the one that only tries the way, is on."""
    return any(task.get_coro().__qualname__ == "Client.__aenter__" for task in asyncio.all_tasks())


async def test_birth_of_home_assistant_brings_discovery_again(bus: Bus, tmp_path: Path) -> None:
    bus.publish_device(device(LAMP))
    with Mosquitto(tmp_path) as broker:
        async with Watcher(broker.port) as watcher, home_assistant(bus, tmp_path, broker.port) as running:
            await watcher.until_says(TOPICS.availability, b"online")
            watcher.payloads.clear()
            await watcher.put("homeassistant/status", b"offline")
            await watcher.put("homeassistant/status", b"online")
            await watcher.until(lambda: TOPICS.device_config(LAMP) in watcher.payloads, "discovery again")
            await watcher.until(lambda: TOPICS.hub_config in watcher.payloads, "the hub again")
            await watcher.until(lambda: TOPICS.device(LAMP) in watcher.payloads, "the state again")
            await watcher.until_says(TOPICS.availability, b"online")
            assert running.health.counters["births"] == 1


async def test_a_killed_daemon_leaves_its_last_will(bus: Bus, tmp_path: Path) -> None:
    """The connection breaks without a word, as it does when the daemon is killed."""
    with Mosquitto(tmp_path) as broker:
        async with (
            Watcher(broker.port) as watcher,
            _Relay(broker.port) as relay,
            home_assistant(bus, tmp_path, relay.port),
        ):
            await watcher.until_says(TOPICS.availability, b"online")
            relay.cut()
            await watcher.until_says(TOPICS.availability, b"offline")


async def test_what_an_earlier_run_left_is_cleaned_up(bus: Bus, tmp_path: Path) -> None:
    bus.publish_device(device(LAMP))
    foreign = "homeassistant/sensor/other/config"
    with Mosquitto(tmp_path) as broker:
        async with Watcher(broker.port) as watcher:
            for topic in (TOPICS.device_config(PHONE), TOPICS.device(PHONE), TOPICS.camera("old"), foreign):
                await watcher.put(topic, b"{}", retain=True)
            await watcher.put(TOPICS.device_config(LAMP), b"{}", retain=True)
        async with Watcher(broker.port) as watcher, home_assistant(bus, tmp_path, broker.port):
            await watcher.until_says(TOPICS.device_config(PHONE), b"")
            await watcher.until_says(TOPICS.device(PHONE), b"")
            await watcher.until_says(TOPICS.camera("old"), b"")
            await watcher.until_says(TOPICS.availability, b"online")
        kept = await retained_at(broker.port)
    assert TOPICS.device_config(PHONE) not in kept
    assert TOPICS.device(PHONE) not in kept
    assert kept[foreign] == b"{}"
    assert b"Lamp" in kept[TOPICS.device_config(LAMP)]


async def test_a_forgotten_or_ignored_device_vanishes(bus: Bus, tmp_path: Path) -> None:
    bus.publish_device(device(LAMP))
    bus.publish_device(device(PHONE))
    with Mosquitto(tmp_path) as broker:
        async with Watcher(broker.port) as watcher, home_assistant(bus, tmp_path, broker.port):
            await watcher.until_says(TOPICS.availability, b"online")
            bus.forget_device(PHONE)
            await watcher.until_says(TOPICS.device(PHONE), b"")
            kept = await retained_at(broker.port)
            assert TOPICS.device_config(PHONE) not in kept
            assert TOPICS.device_config(LAMP) in kept
            bus.publish_device(device(PHONE))
            for topic in (TOPICS.device(PHONE), TOPICS.device_config(PHONE)):
                await watcher.until(lambda topic=topic: watcher.payloads[topic] != b"", f"{topic} is back")


async def test_a_storm_of_changes_becomes_few_updates_and_the_last_counts(
    bus: Bus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(link, "DEVICE_EVERY_NS", 200_000_000)
    bus.publish_device(device(LAMP))
    with Mosquitto(tmp_path) as broker:
        async with Watcher(broker.port) as watcher, home_assistant(bus, tmp_path, broker.port):
            await watcher.until_says(TOPICS.availability, b"online")
            before, begun_s = len(watcher.came), time.monotonic()
            for i in range(1000):
                bus.publish_device(device(LAMP, x_m=float(i)))
                bus.publish_device(device(LAMP, x_m=float(i)))
                if i % 50 == 0:
                    await asyncio.sleep(0)
            await watcher.until(
                lambda: watcher.json(TOPICS.device(LAMP))["x_m"] == 999.0, "the last of a thousand"
            )
            took_s = time.monotonic() - begun_s
            came = [topic for topic, _ in watcher.came[before:]]
    # One that was due, one on its way, and then one each 0.2 s, however long the storm takes.
    assert came.count(TOPICS.device(LAMP)) <= 2 + took_s / 0.2
    assert TOPICS.device_config(LAMP) not in came


async def test_a_hundred_devices_cost_little_and_the_loop_goes_on(bus: Bus, tmp_path: Path) -> None:
    macs = [f"02:00:00:00:00:{i:02x}" for i in range(100)]
    with Mosquitto(tmp_path) as broker:
        async with Watcher(broker.port) as watcher:
            bare_s = await _bare_s(watcher, 2 * len(macs))
        async with Watcher(broker.port) as watcher, home_assistant(bus, tmp_path, broker.port):
            await watcher.until_says(TOPICS.availability, b"online")
            stalls = asyncio.create_task(_longest_stall_s())
            begun_s, used_s = time.monotonic(), time.process_time()
            for mac in macs:
                bus.publish_device(device(mac))
            wanted = {topic for mac in macs for topic in (TOPICS.device(mac), TOPICS.device_config(mac))}
            try:
                await watcher.until(lambda: wanted <= set(watcher.payloads), "a hundred devices")
            finally:
                took_s, used_s = time.monotonic() - begun_s, time.process_time() - used_s
                stalls.cancel()
                stall_s = await stalls
    print(  # noqa: T201 - the measured figure
        f"100 devices: {took_s:.2f} s, {used_s:.2f} s of a core ({bare_s:.2f} s by hand), "
        f"the loop stood still {stall_s * 1e3:.0f} ms"
    )
    assert used_s < 6.0 * bare_s  # as much was measured


async def _bare_s(watcher: Watcher, count: int) -> float:
    """What so many messages cost this machine's processor, to and from the broker, without anything else."""
    used_s = time.process_time()
    for i in range(count):
        await watcher.put(f"bare/{i}", bytes(600), retain=True)
    await watcher.until(lambda: f"bare/{count - 1}" in watcher.payloads, "the last one")
    return time.process_time() - used_s


async def _longest_stall_s() -> float:
    """How long the event loop did nothing else, at most, until cancelled."""
    longest_s = 0.0
    try:
        while True:
            slept_s = time.monotonic()
            await asyncio.sleep(0.01)  # seldom: what this takes grows with the time
            longest_s = max(longest_s, time.monotonic() - slept_s - 0.01)
    except asyncio.CancelledError:
        return longest_s


@pytest.mark.slow
@pytest.mark.timeout(700)
async def test_the_map_is_a_picture_that_follows(bus: Bus, tmp_path: Path) -> None:
    cells = np.zeros((40, 60), np.int8)
    cells[0, :] = cells[-1, :] = 100
    bus.publish_map(
        m.MapMessage(
            source="live",
            epoch=1,
            bounds_m=(0, 0, 3, 2),
            resolution_m=0.05,
            origin=(0, 0, 0),
            width=60,
            height=40,
            rooms=(m.Room(name="Living room", polygon_m=((0, 0), (3, 0), (3, 2), (0, 2))),),
        )
    )
    bus.publish_grid(grid_to_png(cells))
    bus.publish_device(device(LAMP, y_m=1.0))
    with Mosquitto(tmp_path) as broker:
        async with Watcher(broker.port) as watcher, home_assistant(bus, tmp_path, broker.port):
            await watcher.until(lambda: TOPICS.map in watcher.payloads, "the picture", DRAWN_S)
            first = watcher.payloads[TOPICS.map]
            assert first.startswith(b"\x89PNG")
            bus.publish_device(device(LAMP, y_m=1.0, last_seen="2026-01-01T00:00:00Z"))
            bus.publish_device(device(LAMP, y_m=1.5))
            await watcher.until(lambda: watcher.payloads[TOPICS.map] != first, "another picture", DRAWN_S)
            assert [topic for topic, _ in watcher.came].count(TOPICS.map) == 2


class _Relay:
    """A TCP connection in between that can be cut."""

    def __init__(self, to_port: int) -> None:
        self._to_port = to_port
        self._writers: list[asyncio.StreamWriter] = []
        self.port = 0

    async def __aenter__(self) -> _Relay:
        self._group = asyncio.TaskGroup()
        await self._group.__aenter__()
        self._server = await asyncio.start_server(self._accept, "127.0.0.1", 0)
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        self.cut()
        await self._group.__aexit__(None, None, None)

    def cut(self) -> None:
        """Nobody gets through any more."""
        self._server.close()
        for writer in self._writers:
            writer.transport.abort()

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there, back = await asyncio.open_connection("127.0.0.1", self._to_port)
        self._writers += [writer, back]
        self._group.create_task(self._copy(reader, back))
        self._group.create_task(self._copy(there, writer))

    @staticmethod
    async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while data := await reader.read(65536):
                writer.write(data)
        except ConnectionError:
            return
        finally:
            writer.close()
