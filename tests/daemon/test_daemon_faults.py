"""Whatever goes away: the daemon goes on, its status says which part and why, and it recovers by itself.

The daemon is a process; robot, camera, radio and hostapd are played here, so that each can be unplugged.
"""

from __future__ import annotations

import asyncio
import signal
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import pytest
import yaml
from daemon_world import Vad, connect, store_calibration
from waiting import free_port

from vad.bus.messages import DeviceMessage, Part, StatusMessage
from vad.client import VadClient
from vad.robot.map_server import save_floor_plan
from vad.sim.driver import FifoSender
from vad.sim.driver import run as play_radio
from vad.sim.home import floor_plan
from vad.sim.hostapd import HostapdEmulator
from vad.sim.mjpeg import MjpegServer
from vad.sim.neato import VirtualNeato
from vad.sim.radio import Radio
from vad.sim.scenario import make_home

HOME = make_home(1)
LAMP = HOME.device_mac
TV = "f4:f5:d8:aa:bb:cc"
RECOVERS_S = 60.0
"""It takes some seconds; on a busy machine many times as many."""
OUTAGE_S = 4.0
"""In so long everything is tried again some times."""

pytestmark = pytest.mark.timeout(600)

T = TypeVar("T")


def _encoded(picture: np.ndarray) -> bytes:
    ok, data = cv2.imencode(".jpg", picture)
    assert ok
    return bytes(data)


PICTURE = _encoded(np.full((480, 640, 3), 90, np.uint8))


async def eventually(ask: Callable[[], Awaitable[T]], fits: Callable[[T], bool], what: str) -> T:
    """The first answer that fits."""
    answer: T | None = None
    try:
        async with asyncio.timeout(RECOVERS_S):
            while not fits(answer := await ask()):  # noqa: ASYNC110 - the answer is another process’s
                await asyncio.sleep(0.05)
    except TimeoutError:
        raise AssertionError(f"not within {RECOVERS_S:.0f} s: {what}; last: {answer}") from None
    return answer


class Hub:
    """The daemon, what it says of itself, and the plugs of everything around it.

    stations: who hostapd lets in when it is plugged.
    """

    def __init__(self, folder: Path, camera_port: int, daemon: Vad, client: VadClient) -> None:
        self.folder = folder
        self.daemon = daemon
        self.stations: tuple[str, ...] = (LAMP,)
        self._camera_port = camera_port
        self._client = client
        self._plugged: dict[str, asyncio.Task[None]] = {}

    async def _robot(self) -> None:
        robot = VirtualNeato(lambda _: (1.0, 1.0, 0.0), link=self.folder / "neato.tty")
        await robot.run()

    async def _camera(self) -> None:
        async with MjpegServer("127.0.0.1", self._camera_port) as server:
            while True:
                server.publish(PICTURE, time.monotonic_ns())
                await asyncio.sleep(0.1)

    async def _radio(self) -> None:
        start_ns = time.monotonic_ns() - int(HOME.join_s * 1e9)
        await play_radio(Radio(HOME, seed=1), start_ns, FifoSender(self.folder / "csi.fifo"))

    async def _hostapd(self) -> None:
        emulator = HostapdEmulator(self.folder / "hostapd.sock")
        for mac in self.stations:
            emulator.announce(mac)
        await emulator.run()

    def plug(self, name: str) -> None:
        """Let a part appear: robot, camera, radio or hostapd."""
        players: dict[str, Callable[[], Awaitable[None]]] = {
            "robot": self._robot,
            "camera": self._camera,
            "radio": self._radio,
            "hostapd": self._hostapd,
        }
        self._plugged[name] = asyncio.ensure_future(players[name]())  # type: ignore[arg-type]

    async def unplug(self, name: str) -> None:
        """Let it vanish."""
        task = self._plugged.pop(name)
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task

    async def unplug_all(self) -> None:
        for name in tuple(self._plugged):
            await self.unplug(name)

    async def status(self) -> StatusMessage:
        """What the daemon says of itself."""
        assert self.daemon.running, self.daemon.said
        found = await asyncio.to_thread(self._client.status)
        return found or StatusMessage(source="simulated", version="", uptime_s=0.0, step="starting")

    async def part(self, name: str) -> Part:
        """What it says of the part whose name begins like this."""
        parts = (await self.status()).parts
        return next((part for part in parts if part.part.startswith(name)), Part(part=name, state="starting"))

    async def becomes(self, name: str, state: str, *words: str) -> None:
        """Wait until the part is in this state and says one of these words, if any are given."""

        def is_so(part: Part) -> bool:
            return part.state == state and (not words or any(word in part.detail for word in words))

        await eventually(lambda: self.part(name), is_so, f"{name} {state} {' or '.join(words)}")

    async def counts_on(self, name: str, counter: str) -> None:
        """Wait until a counter of a part goes up: it works again, whatever it says."""
        before = (await self.part(name)).counters[counter]
        await eventually(lambda: self.part(name), lambda p: p.counters[counter] > before, f"{counter} go on")

    async def says(self, step: str) -> None:
        """Wait until this is going on."""
        await eventually(self.status, lambda status: status.step == step, step)

    async def devices(self) -> list[DeviceMessage]:
        return await asyncio.to_thread(self._client.devices)

    async def knows(self, *macs: str) -> None:
        """Wait until these are its devices and no others."""
        await eventually(
            self.devices, lambda found: {device.mac for device in found} == {*macs}, f"devices {macs}"
        )


@asynccontextmanager
async def hub(folder: Path) -> AsyncIterator[Hub]:
    """Everything plugged in, the camera calibrated, the lamp joined, nobody there; in the end it stops."""
    camera_port, bus_port = free_port(), free_port()
    save_floor_plan(floor_plan(HOME), folder / "floor.yaml")
    store_calibration(folder / "state", HOME)
    settings = {
        "source": "simulated",
        "state_dir": "state",
        "map": {"file": "floor.yaml"},
        "robot": {"type": "neato", "port": str(folder / "neato.tty")},
        "camera": {"source": {"type": "mjpeg", "url": f"http://127.0.0.1:{camera_port}/stream"}},
        "radio": {"source": {"type": "follow", "path": "csi.fifo"}},
        "devices": {"hostapd": ["hostapd.sock"]},
        "bus": {"listen": [f"tcp/127.0.0.1:{bus_port}"]},
    }
    (folder / "vad.yaml").write_text(yaml.safe_dump(settings))
    with Vad("run", "--config", folder / "vad.yaml", log=folder / "daemon.log") as daemon:
        client = await asyncio.to_thread(connect, daemon, bus_port)
        world = Hub(folder, camera_port, daemon, client)
        try:
            for name in ("robot", "camera", "radio", "hostapd"):
                world.plug(name)
            for name in ("robot", "camera", "csi.follow", "hostapd", "vision"):
                await world.becomes(name, "ok")
            await world.knows(LAMP)
            yield world
            await asyncio.to_thread(daemon.end, signal.SIGTERM)
        finally:
            await world.unplug_all()
            await asyncio.to_thread(client.close)


async def test_the_robots_port_vanishes_and_comes_back(tmp_path: Path) -> None:
    async with hub(tmp_path) as world:
        await world.unplug("robot")
        await world.becomes("robot", "degraded", "gone", "no such port")
        await world.becomes("camera", "ok")
        await world.counts_on("camera", "frames")  # the others go on
        world.plug("robot")
        await world.becomes("robot", "ok")
        await world.counts_on("robot", "poses")


async def test_the_cameras_server_restarts(tmp_path: Path) -> None:
    async with hub(tmp_path) as world:
        await world.unplug("camera")
        await world.becomes("camera", "degraded", "127.0.0.1")  # it says which camera
        await world.becomes("robot", "ok")
        await world.counts_on("robot", "poses")
        world.plug("camera")
        await world.becomes("camera", "ok")
        await world.counts_on("vision", "frames")


async def test_hostapd_restarts_with_a_new_station(tmp_path: Path) -> None:
    async with hub(tmp_path) as world:
        await world.unplug("hostapd")
        await world.becomes("hostapd", "degraded", "hostapd")
        assert [device.mac for device in await world.devices()] == [LAMP], "what was known stays"
        world.stations = (LAMP, TV)
        world.plug("hostapd")
        await world.becomes("hostapd", "ok")
        await world.knows(LAMP, TV)


async def test_the_csi_logs_writer_goes_away(tmp_path: Path) -> None:
    async with hub(tmp_path) as world:
        walker = "waiting for somebody to walk through the picture"
        await world.says(walker)
        await world.unplug("radio")
        await world.says("waiting for CSI packets of a device")
        await eventually(world.devices, lambda found: "heard" in found[0].reason, "it says why")
        await world.becomes("camera", "ok")
        world.plug("radio")
        await world.says(walker)
        await world.counts_on("csi.follow", "packets")


async def test_everything_at_once(tmp_path: Path) -> None:
    async with hub(tmp_path) as world:
        before = len(world.daemon.said)
        await world.unplug_all()
        for name in ("robot", "camera", "hostapd"):
            await world.becomes(name, "degraded")
        lasts_s = (await world.status()).uptime_s + OUTAGE_S
        await eventually(world.status, lambda status: status.uptime_s > lasts_s, "it goes on without them")
        told = [line.partition(" WARNING ")[2] for line in world.daemon.said[before:].splitlines()]
        told = [words for words in told if words]
        assert len(told) >= 3
        assert len(set(told)) == len(told), "trouble is told when it is new, not over and over"
        for name in ("hostapd", "radio", "camera", "robot"):
            world.plug(name)
        for name in ("robot", "camera", "csi.follow", "hostapd"):
            await world.becomes(name, "ok")
        await world.counts_on("robot", "poses")
        await world.counts_on("vision", "frames")
        await world.counts_on("csi.follow", "packets")
