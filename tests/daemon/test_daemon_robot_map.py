"""The whole daemon on a robot that brings its own map, and makes it anew: everything goes with it."""

from __future__ import annotations

import asyncio
import json
import math
import signal
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest
import yaml
from daemon_world import LONG_AGO, Vad, connect, store_calibration, wait_for
from test_daemon_floor import home, turned
from waiting import free_port

from vad.robot.floor_plan import FREE, OCCUPIED, FloorPlan
from vad.sim.calibration import true_calibration
from vad.sim.scenario import make_home
from vad.sim.valetudo import ValetudoServer
from vad.store.records import DeviceRecord, Estimate
from vad.store.store import Store

LAMP = "f4:f5:d8:00:00:01"
SIDE_CM = 5000


def valetudo_json(plan: FloorPlan, nonce: str) -> bytes:
    """The plan as a robot with Valetudo sends it; its frame's origin is the picture's lower left corner."""
    x_m, y_m, _ = plan.origin
    layers = []
    for kind, value in (("floor", FREE), ("wall", OCCUPIED)):
        rows, columns = np.nonzero(plan.cells == value)
        x = columns + round(x_m / 0.05)
        y = SIDE_CM // 5 - 1 - (rows + round(y_m / 0.05))
        layers.append({"type": kind, "pixels": np.stack([x, y], axis=1).ravel().tolist()})
    robot = {"type": "robot_position", "points": [1000, 1000], "metaData": {"angle": 90}}
    size = {"x": SIDE_CM, "y": SIDE_CM}
    tree = {"metaData": {"nonce": nonce}, "size": size, "pixelSize": 5, "layers": layers, "entities": [robot]}
    return json.dumps(tree).encode()


class Robot:
    """A Valetudo server on a thread of its own."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=lambda: self._loop.run_until_complete(self._serve()))
        self._thread.start()
        assert self._ready.wait(40)

    async def _serve(self) -> None:
        async with ValetudoServer(keep_alive_s=0.5) as self._server:
            self.url = self._server.url
            self._ready.set()
            await self._stop.wait()

    def publish(self, data: bytes) -> None:
        asyncio.run_coroutine_threadsafe(self._server.publish(data), self._loop).result(40)

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(40)
        self._loop.close()


@contextmanager
def robot() -> Iterator[Robot]:
    made = Robot()
    try:
        yield made
    finally:
        made.close()


@pytest.mark.timeout(400)
def test_a_map_made_anew_moves_devices_and_camera(tmp_path: Path) -> None:
    plan = home(origin=(5.0, 5.0, 0.0))
    new, way = turned(plan)
    port = free_port()
    (tmp_path / "state").mkdir()
    store_calibration(tmp_path / "state", make_home(1))
    place = Estimate(7.0, 8.0, ((0.04, 0.0), (0.0, 0.01)), 0.5)
    with Store(tmp_path / "state" / "vad.sqlite") as store:
        store.save_device(DeviceRecord(LAMP, "mapped", LONG_AGO, LONG_AGO, epoch=1, walks=2, estimate=place))
    with robot() as valetudo:
        settings = tmp_path / "vad.yaml"
        settings.write_text(
            yaml.safe_dump(
                {
                    "source": "simulated",
                    "state_dir": "state",
                    "robot": {"type": "valetudo", "url": valetudo.url},
                    "camera": {"source": {"type": "mjpeg", "url": "http://127.0.0.1:9/stream"}},
                    "radio": {"source": {"type": "follow", "path": "csi.fifo"}},
                    "devices": {},
                    "bus": {"listen": [f"tcp/127.0.0.1:{port}"]},
                }
            )
        )
        with Vad("run", "--config", settings, log=tmp_path / "vad.log") as vad:
            with closing(connect(vad, port)) as client:
                told = wait_for(client.status, "a status")
                assert told.step == "waiting for the robot's map"
                assert client.map() is None
                valetudo.publish(valetudo_json(plan, "one"))
                first = wait_for(client.map, "the map")
                assert (first.epoch, first.bounds_m) == (1, pytest.approx((5.4, 5.4, 13.6, 11.6), abs=0.1))
                lamp = wait_for(lambda: client.device(LAMP), "the lamp")
                assert (lamp.state, lamp.x_m) == ("mapped", 7.0)

                valetudo.publish(valetudo_json(new, "two"))
                second = wait_for(lambda: (m := client.map()) and m.epoch == 2 and m, "the new map")
                assert second.bounds_m != first.bounds_m
                lamp = wait_for(lambda: (d := client.device(LAMP)) and d.epoch == 2 and d, "the moved lamp")
                truth = way.apply(np.array([[7.0, 8.0]]))[0]
                assert math.dist((lamp.x_m or 0, lamp.y_m or 0), truth) < 0.1
                assert lamp.state == "mapped"
                (camera,) = wait_for(lambda: [c for c in client.cameras() if c.epoch == 2], "the camera")
                position = true_calibration(make_home(1)).position_m
                assert position is not None
                assert camera.state == "valid"
                assert camera.position_m is not None
                assert math.dist(camera.position_m[:2], way.apply(position[None, :2])[0]) < 0.2
            vad.end(signal.SIGTERM)
        # The next start goes on where this one was.
        with Vad("run", "--config", settings, log=tmp_path / "vad2.log") as vad:
            with closing(connect(vad, port)) as client:
                again = wait_for(client.map, "the kept map")
                assert again.epoch == 2
                lamp = wait_for(lambda: client.device(LAMP), "the lamp")
                assert lamp.state == "mapped"
            vad.end(signal.SIGTERM)
