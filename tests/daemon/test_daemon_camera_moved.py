"""A camera that was moved, through the whole daemon: noticed, said, calibrated anew by the robot, kept."""

from __future__ import annotations

import asyncio
import signal
import time
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from daemon_world import LONG_AGO, Vad, connect
from waiting import free_port

from vad.bus.messages import CameraMessage
from vad.client import VadClient
from vad.geometry import project
from vad.mapping.camera_calibration import CameraCalibration
from vad.mapping.camera_view import CameraView
from vad.sim.calibration import true_calibration
from vad.sim.home import SimulatedHome
from vad.sim.render import Renderer
from vad.sim.render_shapes import View
from vad.sim.scenario import Scenario, make_home
from vad.store.records import CameraRecord
from vad.store.store import Store

NOTICED_S, CALIBRATED_S = 60.0, 120.0
PICTURES_PER_S = 10
"""That are looked at where a machine keeps up: on a busy one a minute is as many pictures."""
PATIENCE_S = 400.0
EPOCH = 1


class Restless(Scenario):
    """A home whose robot drives there and back for ever: a busy machine sees little of it each time."""

    def robot_at(self, t_s: float) -> tuple[float, float, float]:
        """Where it is on its way, like a scenario's."""
        whole_s = self.drive_end_s - self.drive_start_s
        way_s = max(0.0, t_s - self.drive_start_s) % (2 * whole_s)
        return super().robot_at(self.drive_start_s + min(way_s, 2 * whole_s - way_s))


_home = make_home(1, walks=1)
HOME = Restless(**{field.name: getattr(_home, field.name) for field in fields(_home)})


def moved(scenario: Scenario) -> Scenario:
    """Somebody has taken the camera down and put it back: 12 cm beside, turned by some degrees."""
    camera = scenario.camera
    eye, target = np.add(camera.eye_m, (0.1, 0.06, -0.05)), np.add(camera.target_m, (0.3, -0.2, 0.0))
    place = replace(camera, eye_m=tuple(eye.tolist()), target_m=tuple(target.tolist()))
    return replace(scenario, camera=place)


def kept(state_dir: Path) -> CameraCalibration:
    """The calibration that the next start would use."""
    with Store(state_dir / "vad.sqlite") as store:
        (record,) = store.cameras(EPOCH)
    return CameraCalibration.from_dict(record.calibration)


async def camera(
    daemon: Vad, client: VadClient, fits: Callable[[CameraMessage], bool], within_s: float
) -> CameraMessage:
    """What the daemon says of its camera, once it fits: after so long a time of pictures at most."""
    until = time.monotonic() + PATIENCE_S
    said: list[CameraMessage] = []
    while time.monotonic() < until and await pictures(client) <= within_s * PICTURES_PER_S:
        assert daemon.running, daemon.said
        said = await asyncio.to_thread(client.cameras)
        if said and fits(said[0]):
            return said[0]
        await asyncio.sleep(0.2)
    raise AssertionError(f"not within {within_s:.0f} s of pictures; last: {said}")


async def pictures(client: VadClient) -> int:
    """How many the daemon has looked at."""
    status = await asyncio.to_thread(client.status)
    parts = () if status is None else status.parts
    return sum(part.counters.get("frames", 0) for part in parts if part.part == "vision")


@pytest.mark.slow
@pytest.mark.timeout(1200)
async def test_it_is_noticed_within_a_minute_and_calibrated_anew_and_kept(tmp_path: Path) -> None:
    state, bus_port = tmp_path / "state", free_port()
    known = replace(true_calibration(HOME), view=CameraView.of(Renderer(HOME).frame(0.0)))
    with Store(state / "vad.sqlite") as store:
        store.save_camera(CameraRecord("main", EPOCH, known.to_dict(), LONG_AGO))
    elsewhere = moved(HOME)
    world = SimulatedHome(elsewhere, tmp_path, bus_port=bus_port, connector=False)
    ready = asyncio.Event()
    playing = asyncio.create_task(world.run(ready))
    try:
        await ready.wait()
        with Vad("run", "--config", tmp_path / "vad.yaml", log=tmp_path / "daemon.log") as daemon:
            client = await asyncio.to_thread(connect, daemon, bus_port)
            try:
                said = await camera(daemon, client, lambda c: c.state == "recalibrating", NOTICED_S)
                assert "moved" in said.reason
                assert said.position_m is None, "the old place is not told any more"
                said = await camera(daemon, client, lambda c: c.state == "valid", NOTICED_S + CALIBRATED_S)
            finally:
                await asyncio.to_thread(client.close)
            await asyncio.to_thread(daemon.end, signal.SIGTERM)
    finally:
        playing.cancel()
        await asyncio.gather(playing, return_exceptions=True)
    assert said.epoch == EPOCH
    # What is kept under the map's epoch is the new place, good to some centimetres on the floor.
    found = kept(state)
    assert found.status == "valid"
    drive_s = np.linspace(elsewhere.drive_start_s, elsewhere.drive_end_s, 60)
    floor = np.array([elsewhere.robot_at(float(t))[:2] for t in drive_s])
    view = View.of(elsewhere.camera)
    px = project(np.column_stack([floor, np.zeros(len(floor))]), view.intrinsics, view.camera_from_map)
    inside = ((px > 0.0) & (px < (view.intrinsics.width_px, view.intrinsics.height_px))).all(axis=1)
    assert np.count_nonzero(inside) > 20
    xy, _ = found.floor_point(px[inside], 1.0)
    assert float(np.mean(np.linalg.norm(xy - floor[inside], axis=1))) < 0.05
