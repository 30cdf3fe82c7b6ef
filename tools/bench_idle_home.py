"""A home that costs the machine next to nothing to play: its pictures and packets are made beforehand."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from bisect import bisect_left
from pathlib import Path

import cv2
import numpy as np

from vad.mac import normal_mac
from vad.robot.map_server import save_floor_plan
from vad.sim.calibration import true_calibration
from vad.sim.driver import FifoSender, run
from vad.sim.home import JPEG_QUALITY, floor_plan
from vad.sim.hostapd import HostapdEmulator
from vad.sim.mjpeg import MjpegServer
from vad.sim.neato import VirtualNeato
from vad.sim.radio import Radio
from vad.sim.render import Renderer
from vad.sim.scenario import CARRIER_HZ, Scenario, make_home
from vad.store.records import CameraRecord
from vad.store.store import Store

FPS = 15.0
STILL_PICTURES = 30
"""So many pictures of the empty room, different by the sensor's noise alone, come again and again."""
PACKETS_PER_S = 1000.0
BEFORE_S, AFTER_S = 1.0, 4.0
"""Of the room before and after the walk."""


class PreparedHome:
    """One home: at rest until `walk`, then once through a walk, then at rest again.

    Args:
        seed: which home. folder: where its files go, vad.yaml among them. bus_port: of the daemon.
    """

    def __init__(self, seed: int, folder: Path, bus_port: int) -> None:
        self.scenario: Scenario = make_home(seed)
        self.walk_s = self.scenario.walks[0].end_s - self.scenario.walks[0].start_s
        self._folder, self._bus_port = folder, bus_port
        self._begin_s = self.scenario.walks[0].start_s - BEFORE_S
        self._end_s = self.scenario.walks[0].end_s + AFTER_S
        self._start_ns = 0
        self._walk_from_ns: int | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._task: asyncio.Task[None] | None = None
        self._ready = threading.Event()
        self._over = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()), name="home", daemon=True)
        self._still, self._moving = still_and_moving(self.scenario)
        radio = Radio(self.scenario, packets_per_s=PACKETS_PER_S, seed=seed)
        self._packets = radio.log_bytes(radio.generate(self._begin_s, self._end_s))
        quiet = Radio(self.scenario, packets_per_s=PACKETS_PER_S, seed=seed)
        self._background = quiet.log_bytes(quiet.generate(0.0, 20.0))
        self._times = [t_s for t_s, _ in self._packets]
        self._background_times = [t_s for t_s, _ in self._background]

    def __enter__(self) -> PreparedHome:
        self._thread.start()
        if not self._ready.wait(30.0):
            raise TimeoutError("the home did not start")
        return self

    def __exit__(self, *_: object) -> None:
        if self._loop is not None and self._task is not None:
            self._loop.call_soon_threadsafe(self._task.cancel)
        self._thread.join(10.0)

    def walk(self) -> None:
        """Somebody walks through the picture once; returns when the walk is over."""
        self._over.clear()
        self._walk_from_ns = time.monotonic_ns()
        if not self._over.wait(self._end_s - self._begin_s + 30.0):
            raise TimeoutError("the walk did not end")

    def join(self) -> None:
        """The device joins the network."""
        assert self._loop is not None
        self._loop.call_soon_threadsafe(self._hostapd.announce, normal_mac(self.scenario.device_mac))

    async def _run(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._task = asyncio.current_task()
        robot = self.scenario.robot_at(self.scenario.drive_end_s)
        neato = VirtualNeato(lambda _t_ns: robot, link=self._folder / "neato.tty")
        self._hostapd = HostapdEmulator(self._folder / "hostapd.sock")
        sender = FifoSender(self._folder / "csi.fifo")
        try:
            async with MjpegServer("127.0.0.1", 0) as camera, asyncio.TaskGroup() as group:
                self._write_files(camera.url)
                group.create_task(neato.run())
                group.create_task(self._hostapd.run())
                self._start_ns = time.monotonic_ns()
                group.create_task(run(self, self._start_ns, sender))
                group.create_task(self._film(camera))
                self._ready.set()
        except asyncio.CancelledError:
            return
        finally:
            neato.close()

    def generate(self, t0_s: float, t1_s: float) -> list[tuple[float, bytes]]:
        """The packets of a piece of the player's time (vad.sim.driver.PlayedRadio)."""
        begun_ns = self._walk_from_ns
        if begun_ns is not None:
            shift_s = (begun_ns - self._start_ns) / 1e9 - self._begin_s
            if t0_s - shift_s < self._end_s:
                first, last = (bisect_left(self._times, t - shift_s) for t in (t0_s, t1_s))
                return [(t_s + shift_s, data) for t_s, data in self._packets[first:last]]
        turn_s = t0_s // 20.0 * 20.0
        first, last = (bisect_left(self._background_times, t - turn_s) for t in (t0_s, t1_s))
        return [(t_s + turn_s, data) for t_s, data in self._background[first:last]]

    def log_bytes(self, batch: list[tuple[float, bytes]]) -> list[tuple[float, bytes]]:
        """The batch: it is bytes already."""
        return batch

    async def _film(self, camera: MjpegServer) -> None:
        number = 0
        while True:
            number += 1
            due_ns = self._start_ns + int(number / FPS * 1e9)
            await asyncio.sleep(max(0.0, (due_ns - time.monotonic_ns()) / 1e9))
            picture = self._still[number % STILL_PICTURES]
            if self._walk_from_ns is not None:
                index = int((due_ns - self._walk_from_ns) / 1e9 * FPS)
                if index >= len(self._moving):
                    self._walk_from_ns = None
                    self._over.set()
                elif index >= 0:
                    picture = self._moving[index]
            camera.publish(picture, due_ns)

    def _write_files(self, camera_url: str) -> None:
        scenario = self.scenario
        save_floor_plan(floor_plan(scenario), self._folder / "floor.yaml")
        with Store(self._folder / "state" / "vad.sqlite") as store:
            known = true_calibration(scenario).to_dict()
            store.save_camera(CameraRecord("main", 1, known, "2026-01-01T00:00:00.000Z"))
        offset = np.subtract(scenario.anchor_m, scenario.camera.eye_m)
        settings = {
            "hub": "bench",
            "source": "simulated",
            "state_dir": "state",
            "map": {"file": "floor.yaml", "epoch": 1},
            "robot": {"type": "neato", "port": str(self._folder.resolve() / "neato.tty")},
            "camera": {"source": {"type": "mjpeg", "url": camera_url}},
            "radio": {
                "source": {"type": "follow", "path": "csi.fifo"},
                "carrier_hz": CARRIER_HZ,
                "antenna_offset_m": [round(float(v), 3) for v in offset],
            },
            "devices": {"hostapd": ["hostapd.sock"]},
            "bus": {"listen": [f"tcp/127.0.0.1:{self._bus_port}"]},
        }
        (self._folder / "vad.yaml").write_text(json.dumps(settings, indent=1))


def still_and_moving(scenario: Scenario, most: int | None = None) -> tuple[list[bytes], list[bytes]]:
    """Pictures as JPEG: of the empty room while the robot is home, and of the first walk, at FPS; of each
    at most so many."""
    renderer = Renderer(scenario)
    rest_s = scenario.join_s - 1.0
    walk = scenario.walks[0]
    count = int((walk.end_s + AFTER_S - walk.start_s + BEFORE_S) * FPS)
    still = [_jpeg(renderer, rest_s + k / FPS) for k in range(STILL_PICTURES)[:most]]
    return still, [_jpeg(renderer, walk.start_s - BEFORE_S + k / FPS) for k in range(count)[:most]]


def _jpeg(renderer: Renderer, t_s: float) -> bytes:
    good, encoded = cv2.imencode(".jpg", renderer.frame(t_s), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    assert good
    data: bytes = encoded.tobytes()
    return data
