"""Ears and captures: who is heard, what is waited for and why, and a walk from the first frame to a place."""

from __future__ import annotations

import asyncio
import json
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from daemon_world import settings_for
from home_time import LATENCY_NS, STEP_NS, HomeTime
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

pytestmark = pytest.mark.timeout(400)
PLAYED_S = 300.0
"""How long a machine may take for some seconds of a simulated home."""
TURN_LATE = 3
"""So many pictures later at most the capture loop has had a turn."""


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


Hearing = Callable[[float, float, int], CsiBatch]
"""What the card gives in a stretch of the home's time, whose zero is the last argument."""


@dataclass
class Hub:
    """The daemon's inner parts, and the queues that its adapters would fill."""

    captures: Captures
    registry: Registry
    eyes: Eyes
    frames: FrameQueue
    batches: DropOldestQueue[CsiBatch]
    running: asyncio.Task[None]
    time: HomeTime

    @asynccontextmanager
    async def shown(
        self, picture: Callable[[float], NDArray[np.uint8]], hearing: Hearing, from_s: float, to_s: float
    ) -> AsyncIterator[None]:
        """The home from this second of its time on, for the eyes and the ears; at to_s from there again.

        picture: what is seen at a time. It goes on when the picture has been seen, while the capture loop
        keeps up with who moves, and nothing is being solved.
        """
        seen = 0
        turns = deque([-1] * TURN_LATE, TURN_LATE)
        t_s = from_s - STEP_NS / S

        async def show(t_ns: int) -> None:
            nonlocal seen, t_s
            before_s, t_s = t_s, t_s + STEP_NS / S
            if t_s > to_s:
                before_s, t_s = from_s - STEP_NS / S, from_s
            image = await asyncio.to_thread(picture, t_s - LATENCY_NS / S)
            batch = await asyncio.to_thread(hearing, before_s, t_s, t_ns - round(t_s * S))
            seen = self.eyes.frames
            turns.append(self.captures.turns)
            self.batches.put(batch)
            self.frames.put(Frame(t_ns - LATENCY_NS, seen, image))

        def kept_up() -> bool:
            solving = self.captures.parts[2].detail.startswith("solving")
            turned = self.captures.turns > turns[0] or not self.eyes.movers() or self.running.done()
            return self.eyes.frames > seen and turned and not solving

        playing = asyncio.create_task(self.time.play(show, kept_up))
        try:
            yield
        finally:
            playing.cancel()
            with suppress(asyncio.CancelledError):
                await playing

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
    with HomeTime() as clock:
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
            world = Hub(captures, registry, eyes, frames, batches, running, clock)
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
        calibrating = "calibrating the camera: 0 %, "
        await until(lambda: world.captures.step.startswith(calibrating), "it says so")


async def test_what_is_missing_is_told_one_after_the_other(tmp_path: Path, network: PoseNetwork) -> None:
    radio = Radio(HOME, seed=1)
    async with hub(tmp_path, network, true_calibration(HOME)) as world:
        await until(
            lambda: world.captures.step == "watching: no device waits to be measured", "nothing to do"
        )
        await world.registry.joined(LAMP, "lamp")
        await until(lambda: world.registry.get(LAMP).state == "waiting", "the lamp waits")
        assert world.registry.get(LAMP).reason == "it is not heard at all"
        unheard = "waiting for CSI packets of a device"
        await until(lambda: world.captures.step == unheard, "it says so")

        world.time.stand()  # rates are of the last two seconds
        start_ns = world.time.now_ns() - int(WALK.start_s * S)
        world.batches.put(heard(radio, WALK.start_s - 0.1, WALK.start_s, start_ns))
        await until(
            lambda: "too few CSI packets" in world.registry.get(LAMP).reason, "20 packets/s are too few"
        )

        world.batches.put(heard(radio, WALK.start_s - 1.0, WALK.start_s, start_ns))
        walker = "waiting for somebody to walk through the picture"
        await until(lambda: world.registry.get(LAMP).reason == walker, "nobody walks")
        await until(lambda: world.captures.step == walker, "it says so")
        world.time.run_until(world.time.now_ns() + 5 * S)
        await until(lambda: world.registry.get(LAMP).reason != walker, "it is silent again")
    assert not (tmp_path / "sessions").exists()


async def test_an_empty_room_is_looked_at_half_as_often(tmp_path: Path, network: PoseNetwork) -> None:
    renderer = Renderer(HOME)
    still = renderer.frame(WALK.start_s - 5.0)
    async with hub(tmp_path, network, true_calibration(HOME)) as world:
        await until(lambda: world.frames.step_ns > 0, "it says how often")
        moving_ns = world.frames.step_ns

        async def shown(image: NDArray[np.uint8], numbers: range) -> None:
            for number in numbers:
                world.frames.put(Frame(number * S // 15, number, image))
                await until(lambda: world.eyes.frames == number + 1, "the picture is looked at")  # noqa: B023

        # How often is said after the look.
        await shown(still, range(40))
        await until(lambda: world.frames.step_ns > 1.2 * moving_ns, "half as often")
        await shown(renderer.frame(WALK.start_s + 3.0), range(40, 43))
        await until(lambda: world.frames.step_ns == moving_ns, "as often as before")


@asynccontextmanager
async def playing(world: Hub) -> AsyncIterator[None]:
    """The first walk, from the moment when the walker is in the middle of the picture."""
    renderer, radio = await asyncio.to_thread(Renderer, HOME), Radio(HOME, seed=1)

    def hearing(from_s: float, to_s: float, start_ns: int) -> CsiBatch:
        return heard(radio, from_s, to_s, start_ns)

    async with world.shown(renderer.frame, hearing, WALK.start_s + 3.0, WALK.end_s):
        yield


def session_state(folder: Path) -> tuple[str, str]:
    (session,) = (folder / "sessions").iterdir()
    capture = json.loads((session / "session.json").read_text())["capture"]
    return capture["state"], capture["reason"]


async def test_a_walk_becomes_a_session_and_a_place(tmp_path: Path, network: PoseNetwork) -> None:
    limits = {"min_s": 3.0, "max_s": 6.0, "mapped_radius_m": 5.0, "min_walks": 1}
    async with hub(tmp_path, network, true_calibration(HOME), capture=limits) as world:
        await world.registry.joined(LAMP, "lamp")
        async with playing(world):
            await until(lambda: world.registry.get(LAMP).state == "capturing", "a walker is seen", PLAYED_S)
            await until(lambda: world.captures.step.startswith("recording a walk for"), "it says so")
            await until(lambda: world.registry.get(LAMP).walks == 1, "the walk is solved", PLAYED_S)
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
            await until(lambda: world.captures.step.startswith("recording"), "a capture", PLAYED_S)
            await world.stop()
    assert session_state(tmp_path) == ("aborted", "the daemon stopped")


async def test_sessions_that_cannot_be_written_are_a_reason_and_no_end(
    tmp_path: Path, network: PoseNetwork
) -> None:
    (tmp_path / "sessions").write_text("in the way")
    async with hub(tmp_path, network, true_calibration(HOME)) as world:
        await world.registry.joined(LAMP, "lamp")
        async with playing(world):
            await until(
                lambda: "cannot be written" in world.registry.get(LAMP).reason, "it says why", PLAYED_S
            )
        assert world.registry.get(LAMP).state == "waiting"
        assert not world.running.done()
