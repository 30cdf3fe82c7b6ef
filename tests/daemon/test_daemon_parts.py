"""Ears and captures: who is heard, what is waited for and why, and a walk from the first frame to a place."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from daemon_world import settings_for
from numpy.typing import NDArray
from waiting import free_port, until

from vad.bus.node import Bus
from vad.bus.session import BusSettings
from vad.camera.frame import Frame, FrameQueue
from vad.capture.session import SCHEMA, SessionAnchor, SessionDevice, SessionHeader, load_session
from vad.capture.session_writer import SessionWriter
from vad.csi.attribution import Attribution
from vad.csi.logfile import LogReader
from vad.csi.packets import CsiBatch
from vad.daemon.captures import Captures
from vad.daemon.ears import Ears
from vad.daemon.eyes import Eyes
from vad.daemon.registry import Registry
from vad.mac import mac_to_text
from vad.mapping.camera_calibration import CameraCalibration
from vad.sim.calibration import true_calibration
from vad.sim.home import floor_plan
from vad.sim.radio import OTHER_MAC, Radio
from vad.sim.render import Renderer
from vad.sim.scenario import make_home
from vad.store.worker import StoreWorker
from vad.streams import DropOldestQueue
from vad.vision.people import PoseNetwork

HOME = make_home(1)
LAMP = HOME.device_mac
WALK = HOME.walks[0]
S = 1_000_000_000


def heard(radio: Radio, from_s: float, to_s: float, start_ns: int) -> CsiBatch:
    """What the card gives in this stretch of the home's time, whose zero is start_ns."""
    batch = radio.generate(from_s, to_s)
    read = LogReader(Attribution()).feed(b"".join(data for _, data in radio.log_bytes(batch)))
    arrival_ns = start_ns + np.rint(batch.t_s * 1e9).astype(np.int64)
    return replace(read, packets=replace(read.packets, arrival_ns=arrival_ns))


@asynccontextmanager
async def listening(ears: Ears) -> AsyncIterator[DropOldestQueue[CsiBatch]]:
    """The queue of ears that listen meanwhile."""
    batches: DropOldestQueue[CsiBatch] = DropOldestQueue(256)
    task = asyncio.create_task(ears.run(batches))
    try:
        yield batches
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


async def taken(batches: DropOldestQueue[CsiBatch]) -> None:
    await until(lambda: not len(batches), "the batches are taken")


async def test_ears_tell_rates_over_the_last_two_seconds() -> None:
    ears, radio = Ears(), Radio(HOME, seed=1)
    start_s, now_ns = WALK.start_s, int((WALK.start_s + 3.0) * S)
    async with listening(ears) as batches:
        for k in range(150):
            batches.put(heard(radio, start_s + 0.02 * k, start_s + 0.02 * (k + 1), 0))
        await taken(batches)
        assert 370 < ears.heard_per_s(LAMP, now_ns) < 410
        assert 5 < ears.heard_per_s(mac_to_text(OTHER_MAC), now_ns) < 15
        assert ears.heard_per_s("00:11:22:33:44:55", now_ns) == 0
        assert 170 < ears.heard_per_s(LAMP, now_ns + S) < 230, "half of it is two seconds old"
        assert ears.heard_per_s(LAMP, now_ns + 3 * S) == 0


async def test_ears_forget_the_stations_heard_longest_ago() -> None:
    ears, radio = Ears(), Radio(HOME, seed=1)
    batch = heard(radio, WALK.start_s, WALK.start_s + 0.05, 0)
    now_ns = int(batch.packets.arrival_ns[-1])
    count = 2000
    async with listening(ears) as batches:
        for k in range(count):
            mac = np.full(len(batch.packets), 0x020000000000 + k, np.int64)
            batches.put(replace(batch, packets=replace(batch.packets, mac=mac)))
            if len(batches) > 200:
                await taken(batches)
        await taken(batches)
    known = [ears.heard_per_s(mac_to_text(0x020000000000 + k), now_ns) > 0 for k in range(count)]
    assert known[-1]
    assert sum(known) <= 512


def some_header(name: str) -> SessionHeader:
    return SessionHeader(
        schema=SCHEMA,
        id=name,
        source="simulated",
        device=SessionDevice(LAMP),
        anchor=SessionAnchor(*HOME.anchor_m),
    )


async def test_a_recording_holds_what_came_while_it_was_on(tmp_path: Path) -> None:
    ears, radio = Ears(), Radio(HOME, seed=1)
    stretches = [heard(radio, WALK.start_s + 0.1 * k, WALK.start_s + 0.1 * (k + 1), 0) for k in range(6)]
    writer = SessionWriter(tmp_path / "s1", some_header("s1"))
    async with listening(ears) as batches:
        batches.put(stretches[0])
        await taken(batches)
        ears.start_recording()
        for stretch in stretches[1:4]:
            batches.put(stretch)
        await taken(batches)
        await ears.drain(writer)
        batches.put(stretches[4])
        await taken(batches)
        await ears.drain(writer)
        batches.put(stretches[5])
        await taken(batches)
        ears.stop_recording()
        await ears.drain(writer)
    writer.abort("test over")
    assert (tmp_path / "s1" / "csi.dat").read_bytes() == b"".join(s.raw for s in stretches[1:5])
    arrivals = np.load(tmp_path / "s1" / "csi_arrival.npy")
    np.testing.assert_array_equal(arrivals, np.concatenate([s.packets.arrival_ns for s in stretches[1:5]]))


async def test_a_cancelled_write_is_finished_first(tmp_path: Path) -> None:
    ears, radio = Ears(), Radio(HOME, seed=1)
    stretch = heard(radio, WALK.start_s, WALK.start_s + 2.0, 0)
    writer = SessionWriter(tmp_path / "s1", some_header("s1"))
    async with listening(ears) as batches:
        ears.start_recording()
        for _ in range(20):
            batches.put(stretch)
        await taken(batches)
        draining = asyncio.create_task(ears.drain(writer))
        await asyncio.sleep(0)
        draining.cancel()
        with suppress(asyncio.CancelledError):
            await draining
    writer.abort("the daemon stopped")
    assert (tmp_path / "s1" / "csi.dat").stat().st_size == 20 * len(stretch.raw)
    assert len(np.load(tmp_path / "s1" / "csi_arrival.npy")) == 20 * len(stretch.packets)


@pytest.fixture(scope="module")
def network() -> PoseNetwork:
    return PoseNetwork()


@dataclass
class Hub:
    """The daemon's inner parts, and the queues that its adapters would fill."""

    captures: Captures
    registry: Registry
    eyes: Eyes
    frames: FrameQueue
    batches: DropOldestQueue[CsiBatch]
    running: asyncio.Task[None]

    async def stop(self) -> None:
        """Cancel the capture loop, as the daemon does when it ends."""
        self.running.cancel()
        with suppress(asyncio.CancelledError):
            await self.running


@asynccontextmanager
async def hub(
    folder: Path, network: PoseNetwork, known: CameraCalibration | None, **sections: Any
) -> AsyncIterator[Hub]:
    """Eyes, ears, registry and captures as the daemon wires them; the lamp has joined."""
    settings = settings_for(folder, **sections)
    plan = floor_plan(HOME)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with StoreWorker(folder / "vad.sqlite") as store, Bus(BusSettings(listen=(endpoint,))) as bus:
        eyes = Eyes(network, max_fps=10.0, focal_px=None, known=known, on_calibration=lambda _: None)
        ears = Ears()
        registry = Registry(settings, plan, bus, store)
        await registry.load()
        captures = Captures(settings, folder, plan, eyes, ears, registry, bus)
        frames = FrameQueue(2)
        batches: DropOldestQueue[CsiBatch] = DropOldestQueue(256)
        seeing = asyncio.create_task(eyes.run(frames))
        running = asyncio.create_task(captures.run())
        world = Hub(captures, registry, eyes, frames, batches, running)
        try:
            async with listening(ears) as world.batches:
                yield world
        finally:
            await world.stop()
            seeing.cancel()
            with suppress(asyncio.CancelledError):
                await seeing


async def test_without_a_calibration_everything_waits_for_it(tmp_path: Path, network: PoseNetwork) -> None:
    async with hub(tmp_path, network, known=None) as world:
        await world.registry.joined(LAMP, "lamp")
        await until(lambda: world.registry.get(LAMP).state == "waiting", "the lamp waits")
        assert world.registry.get(LAMP).reason == "the camera does not know yet where it is"
        assert world.captures.step.startswith("calibrating the camera: 0 %, ")


async def test_what_is_missing_is_told_one_after_the_other(tmp_path: Path, network: PoseNetwork) -> None:
    radio = Radio(HOME, seed=1)
    async with hub(tmp_path, network, true_calibration(HOME)) as world:
        await until(
            lambda: world.captures.step == "watching: no device waits to be measured", "nothing to do"
        )
        await world.registry.joined(LAMP, "lamp")
        await until(lambda: world.registry.get(LAMP).state == "waiting", "the lamp waits")
        assert world.registry.get(LAMP).reason == "it is not heard at all"
        assert world.captures.step == "waiting for CSI packets of a device"

        start_ns = time.monotonic_ns() - int(WALK.start_s * S)
        world.batches.put(heard(radio, WALK.start_s - 0.1, WALK.start_s, start_ns))
        await until(
            lambda: "too few CSI packets" in world.registry.get(LAMP).reason, "20 packets/s are too few"
        )

        world.batches.put(heard(radio, WALK.start_s - 1.0, WALK.start_s, start_ns))
        walker = "waiting for somebody to walk through the picture"
        await until(lambda: world.registry.get(LAMP).reason == walker, "nobody walks")
        assert world.captures.step == walker
        await until(lambda: world.registry.get(LAMP).reason != walker, "it is silent again")
    assert not (tmp_path / "sessions").exists()


async def test_an_empty_room_is_looked_at_half_as_often(tmp_path: Path, network: PoseNetwork) -> None:
    renderer = Renderer(HOME)
    still = renderer.frame(WALK.start_s - 5.0)
    async with hub(tmp_path, network, true_calibration(HOME)) as world:
        await until(lambda: world.frames.step_ns > 0, "it says how often")
        moving_ns = world.frames.step_ns

        async def shown(image: NDArray[np.uint8], numbers: range) -> int:
            for number in numbers:
                world.frames.put(Frame(number * S // 15, number, image))
                await until(lambda: world.eyes.frames == number + 1, "the picture is looked at")  # noqa: B023
            return world.frames.step_ns

        still_ns = await shown(still, range(40))
        assert still_ns > 1.2 * moving_ns
        assert await shown(renderer.frame(WALK.start_s + 3.0), range(40, 43)) == moving_ns


async def play(world: Hub, renderer: Renderer, from_s: float) -> None:
    """The home from this second of its time on, for the eyes and the ears, until cancelled."""
    radio = Radio(HOME, seed=1)
    start_ns = time.monotonic_ns() - int(from_s * S)
    number, t_s = 0, from_s
    while True:
        image = await asyncio.to_thread(renderer.frame, t_s)
        until_s = (time.monotonic_ns() - start_ns) / S
        world.batches.put(await asyncio.to_thread(heard, radio, t_s, until_s, start_ns))
        world.frames.put(Frame(start_ns + int(t_s * S), number, image))
        t_s = until_s
        number += 1
        await asyncio.sleep(max(0.0, 0.1 - (time.monotonic_ns() - start_ns) / S + t_s))


@asynccontextmanager
async def playing(world: Hub) -> AsyncIterator[None]:
    """The first walk, from the moment when the walker is in the middle of the picture."""
    renderer = await asyncio.to_thread(Renderer, HOME)
    task = asyncio.create_task(play(world, renderer, WALK.start_s + 3.0))
    try:
        yield
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


def session_state(folder: Path) -> tuple[str, str]:
    (session,) = (folder / "sessions").iterdir()
    capture = json.loads((session / "session.json").read_text())["capture"]
    return capture["state"], capture["reason"]


async def test_a_walk_becomes_a_session_and_a_place(tmp_path: Path, network: PoseNetwork) -> None:
    limits = {"min_s": 3.0, "max_s": 6.0, "mapped_radius_m": 5.0, "min_walks": 1}
    async with hub(tmp_path, network, true_calibration(HOME), capture=limits) as world:
        await world.registry.joined(LAMP, "lamp")
        async with playing(world):
            await until(lambda: world.registry.get(LAMP).state == "capturing", "a walker is seen", 15)
            await until(lambda: world.captures.step.startswith("recording a walk for"), "it says so")
            await until(lambda: world.registry.get(LAMP).walks == 1, "the walk is solved", 25)
        known = world.registry.get(LAMP)
        assert known.estimate is not None
        assert known.evidence["packets"] > 1500
        assert 4.0 < known.evidence["walk_s"] < 7.0
    assert session_state(tmp_path) == ("done", "")
    (folder,) = (tmp_path / "sessions").iterdir()
    session = load_session(folder)
    assert session.header.device == SessionDevice(LAMP, "lamp")
    assert session.header.anchor.z_m == pytest.approx(HOME.camera.eye_m[2])
    assert session.t_ns[0] <= session.walk_t_ns[0]
    assert session.t_ns[-1] >= session.walk_t_ns[-1]


async def test_a_stop_in_the_middle_leaves_an_aborted_session(tmp_path: Path, network: PoseNetwork) -> None:
    async with hub(tmp_path, network, true_calibration(HOME)) as world:
        await world.registry.joined(LAMP, "lamp")
        async with playing(world):
            await until(lambda: world.captures.step.startswith("recording"), "a capture", 15)
            await world.stop()
    assert session_state(tmp_path) == ("aborted", "the daemon stopped")


async def test_sessions_that_cannot_be_written_are_a_reason_and_no_end(
    tmp_path: Path, network: PoseNetwork
) -> None:
    (tmp_path / "sessions").write_text("in the way")
    async with hub(tmp_path, network, true_calibration(HOME)) as world:
        await world.registry.joined(LAMP, "lamp")
        async with playing(world):
            await until(lambda: "cannot be written" in world.registry.get(LAMP).reason, "it says why", 15)
        assert world.registry.get(LAMP).state == "waiting"
        assert not world.running.done()
