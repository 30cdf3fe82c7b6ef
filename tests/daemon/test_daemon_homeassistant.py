"""The daemon in Home Assistant: real processes, a simulated home, a real Mosquitto."""

from __future__ import annotations

import asyncio
import signal
import sys
from contextlib import closing
from pathlib import Path

import pytest
from daemon_world import WAIT_S, Vad, change_settings, connect, store_calibration, wait_for
from waiting import free_port

from vad.bus import messages as m
from vad.client import QueryError
from vad.homeassistant.topics import Topics
from vad.sim.scenario import make_home

sys.path.append(str(Path(__file__).parents[1] / "homeassistant"))
from mosquitto_world import Mosquitto, Watcher, needs_mosquitto, retained_at

HOME = make_home(1)


@needs_mosquitto
@pytest.mark.slow
@pytest.mark.timeout(900)
async def test_a_home_in_home_assistant(tmp_path: Path) -> None:
    """A device joins and is there; the daemon is killed and is offline; an ignored device vanishes."""
    port = free_port()
    folder = tmp_path / "home"
    play = ("sim", "--dir", folder, "--seed", "1", "--bus-port", str(port), "--fifo")
    start = ("--start-at", str(HOME.walks[0].start_s - 4.0))
    with Mosquitto(tmp_path) as broker, Vad(*play, *start, log=tmp_path / "sim.log") as sim:
        settings = folder / "vad.yaml"
        await asyncio.to_thread(wait_for, settings.exists, "the home's settings")
        store_calibration(folder / "state", HOME)
        change_settings(settings, mqtt={"host": "127.0.0.1", "port": broker.port})
        async with Watcher(broker.port) as watcher:
            with Vad("run", "--config", settings, log=tmp_path / "daemon.log") as vad:
                topics, mac = await _hub(vad, port)
                await watcher.until(
                    lambda: {topics.device_config(mac), topics.device(mac)} <= watcher.payloads.keys(),
                    "it is announced and told",
                )
                await watcher.until_says(topics.availability, b"online")
                assert watcher.json(topics.device(mac))["in_zones"] == ["zone.home"]
                assert watcher.json(topics.device(mac))["source"] == "simulated"
                await watcher.until(lambda: topics.map in watcher.payloads, "the map", 320)
                vad.send(signal.SIGKILL)
                await watcher.until_says(topics.availability, b"offline")
            with Vad("run", "--config", settings, log=tmp_path / "daemon.log") as vad:
                await watcher.until_says(topics.availability, b"online", WAIT_S)
                await asyncio.to_thread(_ignore, vad, port, mac)
                await watcher.until_says(topics.device(mac), b"")
                await asyncio.to_thread(vad.end, signal.SIGTERM)
                await watcher.until_says(topics.availability, b"offline")
        kept = await retained_at(broker.port)
        sim.send(signal.SIGTERM)
    assert topics.device_config(mac) not in kept
    assert topics.hub_config in kept


async def _hub(vad: Vad, port: int) -> tuple[Topics, str]:
    """The hub's topics and its first device."""

    def ask() -> tuple[Topics, str]:
        with closing(connect(vad, port)) as client:
            found: list[m.DeviceMessage] = wait_for(client.devices, "a device")
            return Topics("vad", "homeassistant", found[0].hub), found[0].mac

    return await asyncio.to_thread(ask)


def _ignore(vad: Vad, port: int, mac: str) -> None:
    with closing(connect(vad, port)) as client:
        try:
            client.wish(m.DeviceWish(mac=mac, ignore=True))
        except QueryError as error:
            if error.code != "waiting":  # for a busy disk: it is granted all the same
                raise


@pytest.mark.slow
def test_a_broker_that_is_not_there_is_trouble_and_no_more(tmp_path: Path) -> None:
    port = free_port()
    folder = tmp_path / "home"
    play = ("sim", "--dir", folder, "--seed", "1", "--bus-port", str(port), "--fifo")
    with Vad(*play, log=tmp_path / "sim.log") as sim:
        settings = folder / "vad.yaml"
        wait_for(settings.exists, "the home's settings")
        change_settings(settings, mqtt={"host": "127.0.0.1", "port": free_port()})
        with Vad("run", "--config", settings, log=tmp_path / "daemon.log") as vad:
            with closing(connect(vad, port)) as client:

                def trouble() -> m.Part | None:
                    status = client.status()
                    parts = () if status is None else status.parts
                    found = (part for part in parts if part.part == "home assistant")
                    return next((part for part in found if part.state == "degraded"), None)

                part = wait_for(trouble, "the trouble with the broker")
            assert "connection refused" in part.detail
            vad.end(signal.SIGTERM)
        sim.send(signal.SIGTERM)
