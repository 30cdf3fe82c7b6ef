"""The capture loop at work: several devices in a walk, checks of mapped ones, crashes before, the story."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_daemon_parts import PLAYED_S, Hub, hub
from waiting import until

from vad.camera.folder import Recording
from vad.capture.archive import CUT_OFF, sessions_in, total_bytes
from vad.capture.session import SCHEMA, SessionAnchor, SessionDevice, SessionHeader, load_session
from vad.capture.session_writer import SessionWriter
from vad.csi.packets import CsiBatch
from vad.daemon.decisions import read
from vad.mapping.evidence import Terms
from vad.mapping.posterior import Grid
from vad.sim.calibration import true_calibration
from vad.sim.household import hear, make_household
from vad.sim.render import Renderer
from vad.vision.people import PoseNetwork

HOUSE = make_household(1, days=1, devices=4)
HOME = HOUSE.home
LAMP, TV = HOUSE.devices[0], HOUSE.devices[1]
VISIT = HOUSE.visits[0]
S = 1_000_000_000

pytestmark = pytest.mark.timeout(700)
GRID = Grid.over(HOUSE.plan.bounds_m, 0.1)
EARLIER = Terms(
    GRID,
    1,
    -((GRID.points_m - LAMP.place_m(0.0)[:2]) ** 2).sum(axis=1) / 2,
    np.zeros(GRID.rows * GRID.columns),
)
"""What an earlier walk said of the lamp: one metre of standard deviation."""
SHORT = {"min_s": 3.0, "max_s": 6.0, "mapped_radius_m": 5.0, "min_walks": 1}


@pytest.fixture(scope="module")
def network() -> PoseNetwork:
    return PoseNetwork()


@asynccontextmanager
async def playing(world: Hub, rates: Mapping[str, float]) -> AsyncIterator[None]:
    """The visit from its third second on, for the eyes and the ears, again and again."""
    renderer = await asyncio.to_thread(Renderer, replace(HOME, walks=(VISIT.walk,)))

    def hearing(from_s: float, to_s: float, start_ns: int) -> CsiBatch:
        batch = hear(HOUSE, VISIT, rates, from_s, to_s)
        arrival_ns = batch.packets.arrival_ns + start_ns
        return replace(batch, packets=replace(batch.packets, arrival_ns=arrival_ns))

    from_s = VISIT.walk.start_s + 3.0
    world.time.stand()
    before = hearing(from_s - 2.0, from_s, world.time.now_ns() - round(from_s * S))
    # All are heard well before anybody is there: who is heard first does not go without the others.
    world.batches.put(before)
    async with world.shown(renderer.frame, hearing, from_s, VISIT.walk.end_s + 3.0):
        yield


@pytest.mark.slow
async def test_one_walk_measures_two_devices_and_tells_its_story(
    tmp_path: Path, network: PoseNetwork
) -> None:
    limits = SHORT | {"keep_frames": True}
    async with hub(tmp_path, network, true_calibration(HOME), capture=limits) as world:
        for device in (LAMP, TV):
            await world.registry.joined(device.mac, device.name)
        async with playing(world, {LAMP.mac: 150.0, TV.mac: 150.0}):
            both = "recording a walk for lamp, tv"
            await until(lambda: world.captures.step.startswith(both), "both", PLAYED_S)
            walks = lambda mac: world.registry.get(mac).walks  # noqa: E731
            await until(lambda: walks(LAMP.mac) == walks(TV.mac) == 1, "both are solved", PLAYED_S)
            # What became of them is noted after that, before the loop goes on.
            solved = world.captures.turns
            await until(lambda: world.captures.turns > solved, "it goes on", PLAYED_S)
    sessions = [s for s in sessions_in(tmp_path / "sessions") if s.state == "done"][:2]
    assert [s.name for s in sessions] == ["lamp", "tv"]
    assert total_bytes(sessions) < 0.6 * sum(s.bytes for s in sessions), "their bytes are shared"
    for session, device in zip(sessions, (LAMP, TV), strict=True):
        loaded = load_session(session.folder)
        assert loaded.header.device == SessionDevice(device.mac, device.name)
        rate = len(loaded.t_ns) / ((loaded.t_ns[-1] - loaded.t_ns[0]) / S)
        assert rate == pytest.approx(150, rel=0.15)
        assert session.result is not None
        assert session.result.radius90_m is not None
        frames = list(Recording(session.folder / "frames").frames())
        assert len(frames) > 15
        assert frames[0].t_ns >= loaded.t_ns[0] - S
    told = [line.text for line in read(tmp_path)]
    for words in ("measuring lamp (new), tv (new)", "s walked: ", "lamp: mapped", "tv: mapped"):
        assert any(words in line for line in told), (words, told)


@pytest.mark.slow
async def test_a_mapped_device_stays_mapped_while_it_is_looked_at_again(
    tmp_path: Path, network: PoseNetwork
) -> None:
    limits = SHORT | {"recheck_h": 0.0001}
    async with hub(tmp_path, network, true_calibration(HOME), capture=limits) as world:
        await world.registry.joined(LAMP.mac, "lamp")
        await world.registry.add_evidence(LAMP.mac, EARLIER, 4000, 15.0)
        states = {world.registry.get(LAMP.mac).state}
        async with playing(world, {LAMP.mac: 200.0}):

            def checked() -> bool:
                states.add(world.registry.get(LAMP.mac).state)
                return "recording" in world.captures.step

            await until(checked, "it is measured again", PLAYED_S)
        assert states == {"mapped"}


@pytest.mark.slow
async def test_a_walk_ends_as_soon_as_the_place_is_sharp(tmp_path: Path, network: PoseNetwork) -> None:
    """What an earlier walk said and the first seconds of this one are enough."""
    limits = {"min_s": 3.0, "max_s": 60.0, "mapped_radius_m": 5.0, "min_walks": 2}
    async with hub(tmp_path, network, true_calibration(HOME), capture=limits) as world:
        await world.registry.joined(LAMP.mac, "lamp")
        await world.registry.add_evidence(LAMP.mac, EARLIER, 4000, 15.0)
        async with playing(world, {LAMP.mac: 200.0}):
            said = world.captures.parts[0].counters
            await until(lambda: said["sharper"] > 0, "it is mapped", PLAYED_S)
    told = [line.text for line in read(tmp_path)]
    assert any(line.endswith("s walked: sharp enough") for line in told), told


async def test_what_a_crash_cut_off_is_said_at_the_next_start(tmp_path: Path, network: PoseNetwork) -> None:
    name = "20260301T120000.000-f4f5d8000001"
    header = SessionHeader(
        schema=SCHEMA, id=name, source="simulated", device=SessionDevice(), anchor=SessionAnchor(0, 0)
    )
    writer = SessionWriter(tmp_path / "sessions" / name, header)
    before = sessions_in(tmp_path / "sessions")
    assert before[0].state == "recording"
    async with hub(tmp_path, network, true_calibration(HOME)) as world:
        await until(lambda: world.captures.step != "starting", "it has tidied up")
    (after,) = sessions_in(tmp_path / "sessions")
    assert (after.state, after.reason) == ("aborted", CUT_OFF)
    assert any("was cut off" in line.text for line in read(tmp_path))
    writer.abort("test over")


async def test_a_full_quota_takes_the_oldest_at_the_start(tmp_path: Path, network: PoseNetwork) -> None:
    archive = tmp_path / "sessions"
    for minute in range(3):
        folder = archive / f"20260301T12{minute:02d}00.000-f4f5d8000001"
        folder.mkdir(parents=True)
        (folder / "session.json").write_text(json.dumps({"capture": {"state": "done"}}))
        (folder / "csi.dat").write_bytes(bytes(4_500_000))
    quota = {"quota_mb": 10, "keep_free_mb": 0}  # this test's disk may be fuller than a hub's
    async with hub(tmp_path, network, true_calibration(HOME), capture=quota) as world:
        await until(lambda: world.captures.step != "starting", "it has tidied up")
    assert [s.id[9:13] for s in sessions_in(archive)] == ["1201", "1202"]
    assert any("1 old sessions deleted" in line.text for line in read(tmp_path))
