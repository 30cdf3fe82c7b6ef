"""Runs a simulated home: every part speaks its real interface, and a settings file says where they are.

The daemon that reads the settings uses its ordinary adapters; only `source: simulated` tells it apart.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from vad.mac import normal_mac
from vad.robot.floor_plan import FREE, OCCUPIED, UNKNOWN, FloorPlan, Room
from vad.robot.map_server import save_floor_plan
from vad.sim.driver import ConnectorSender, FifoSender, run
from vad.sim.hostapd import HostapdEmulator
from vad.sim.mjpeg import MjpegServer
from vad.sim.neato import VirtualNeato
from vad.sim.radio import Radio
from vad.sim.render import Renderer
from vad.sim.scenario import CARRIER_HZ, Scenario

_log = logging.getLogger(__name__)

FPS = 10.0
JPEG_QUALITY = 90
PLAN_STEP_M = 0.05
EXPOSURE_LATENCY_S = 0.05
"""Between a frame's exposure and its arrival, as with a USB camera; the stamp is the exposure's."""


def floor_plan(scenario: Scenario) -> FloorPlan:
    """What the robot's SLAM would have drawn: walls and furniture occupied, the rest of the plan free."""
    x0, y0, x1, y1 = scenario.plan_m
    columns, rows = (int(np.ceil((b - a) / PLAN_STEP_M)) for a, b in ((x0, x1), (y0, y1)))
    cells = np.full((rows, columns), FREE, dtype=np.int8)

    def fill(bx0: float, by0: float, bx1: float, by1: float, value: int) -> None:
        c0, c1 = (int(np.clip(round((v - x0) / PLAN_STEP_M), 0, columns)) for v in (bx0, bx1))
        r0, r1 = (int(np.clip(round((v - y0) / PLAN_STEP_M), 0, rows)) for v in (by0, by1))
        cells[r0:r1, c0:c1] = value

    for box in scenario.boxes:
        fill(box.x0_m, box.y0_m, box.x1_m, box.y1_m, UNKNOWN)
        for edge in (
            (box.x0_m, box.y0_m, box.x1_m, box.y0_m + PLAN_STEP_M),
            (box.x0_m, box.y1_m - PLAN_STEP_M, box.x1_m, box.y1_m),
            (box.x0_m, box.y0_m, box.x0_m + PLAN_STEP_M, box.y1_m),
            (box.x1_m - PLAN_STEP_M, box.y0_m, box.x1_m, box.y1_m),
        ):
            fill(*edge, OCCUPIED)
    wall = 2 * PLAN_STEP_M
    split = scenario.room_m[2]
    for edge in (
        (x0, y0, x1, y0 + wall),
        (x0, y1 - wall, x1, y1),
        (x0, y0, x0 + wall, y1),
        (x1 - wall, y0, x1, y1),
        (split - wall / 2, y0, split + wall / 2, y1),
    ):
        fill(*edge, OCCUPIED)
    rooms = (
        Room("Living room", np.array([[x0, y0], [split, y0], [split, y1], [x0, y1]])),
        Room("Study", np.array([[split, y0], [x1, y0], [x1, y1], [split, y1]])),
    )
    return FloorPlan(1, PLAN_STEP_M, (x0, y0, 0.0), cells, rooms)


class SimulatedHome:
    """One home in `folder`: writes vad.yaml, floor.yaml, floor.pgm, truth.json; then plays it in real time.

    bus_port: where the daemon's zenoh router shall listen. connector: real NETLINK_CONNECTOR (needs the
    right to send to it) instead of a FIFO. start_at_s: the home's own time when `run` begins; what happened
    before is past (a device that joined is listed). web_port: of the daemon's page for browsers, if it shall
    have one.
    """

    def __init__(
        self,
        scenario: Scenario,
        folder: Path,
        *,
        bus_port: int,
        connector: bool,
        start_at_s: float = 0.0,
        web_port: int | None = None,
    ) -> None:
        self._scenario = scenario
        self._folder = folder
        self._bus_port = bus_port
        self._web_port = web_port
        self._connector = connector
        self._start_at_ns = int(start_at_s * 1e9)
        self._start_ns = 0

    async def run(self, ready: asyncio.Event | None = None) -> None:
        """Play until cancelled; `ready` is set when every interface is open and the settings are written."""
        self._folder.mkdir(parents=True, exist_ok=True)
        renderer = await asyncio.to_thread(Renderer, self._scenario)
        radio = await asyncio.to_thread(Radio, self._scenario, seed=self._scenario.seed)
        self._start_ns = time.monotonic_ns() - self._start_at_ns
        neato = VirtualNeato(self._robot_pose, link=self._folder / "neato.tty")
        hostapd = HostapdEmulator(self._folder / "hostapd.sock")
        sender = ConnectorSender() if self._connector else FifoSender(self._folder / "csi.fifo")
        try:
            async with MjpegServer("127.0.0.1", 0) as camera, asyncio.TaskGroup() as group:
                await asyncio.to_thread(self._write_files, camera.url)
                group.create_task(neato.run(), name="robot")
                group.create_task(hostapd.run(), name="hostapd")
                group.create_task(run(radio, self._start_ns, sender), name="radio")
                group.create_task(self._film(renderer, camera), name="camera")
                group.create_task(self._join(hostapd), name="join")
                if ready is not None:
                    ready.set()
        finally:
            neato.close()
            sender.close()

    def _seconds(self, t_ns: int) -> float:
        return (t_ns - self._start_ns) / 1e9

    def _robot_pose(self, t_ns: int) -> tuple[float, float, float] | None:
        """The SLAM pose: the truth with 1.5 cm of noise; the robot is localised once it has left its dock."""
        t_s = self._seconds(t_ns)
        if t_s < self._scenario.drive_start_s:
            return None
        x, y, yaw = self._scenario.robot_at(t_s)
        rng = np.random.default_rng([self._scenario.seed, t_ns // 1_000_000])
        dx, dy, turn = rng.normal(0.0, [0.015, 0.015, 0.01])
        return x + dx, y + dy, yaw + turn

    async def _film(self, renderer: Renderer, camera: MjpegServer) -> None:
        """Publish a frame every 1 / FPS; one that is late is left out."""
        number = 0
        while True:
            number = max(number + 1, int(self._seconds(time.monotonic_ns()) * FPS))
            exposed_ns = self._start_ns + int(number / FPS * 1e9)
            jpeg = await asyncio.to_thread(_jpeg, renderer, number / FPS)
            arrives_ns = exposed_ns + int(EXPOSURE_LATENCY_S * 1e9)
            await asyncio.sleep(max(0.0, (arrives_ns - time.monotonic_ns()) / 1e9))
            camera.publish(jpeg, exposed_ns)

    async def _join(self, hostapd: HostapdEmulator) -> None:
        await asyncio.sleep(max(0.0, self._scenario.join_s - self._seconds(time.monotonic_ns())))
        hostapd.announce(normal_mac(self._scenario.device_mac))

    def _write_files(self, camera_url: str) -> None:
        scenario = self._scenario
        save_floor_plan(floor_plan(scenario), self._folder / "floor.yaml")
        truth = {
            scenario.device_mac: {
                "x_m": scenario.device_m[0],
                "y_m": scenario.device_m[1],
                "z_m": scenario.device_m[2],
            }
        }
        (self._folder / "truth.json").write_text(json.dumps(truth, indent=1))
        csi: dict[str, object] = {"type": "connector", "allow_user_space": True}
        if not self._connector:
            csi = {"type": "follow", "path": "csi.fifo"}
        offset = np.subtract(scenario.anchor_m, scenario.camera.eye_m)
        settings = {
            "hub": "demo",
            "source": "simulated",
            "state_dir": "state",
            "map": {"file": "floor.yaml", "epoch": 1},
            "robot": {"type": "neato", "port": str(self._folder.resolve() / "neato.tty")},
            "camera": {"id": "main", "source": {"type": "mjpeg", "url": camera_url}},
            "radio": {
                "source": csi,
                "carrier_hz": CARRIER_HZ,
                "antenna_offset_m": [round(float(v), 3) for v in offset],
            },
            "devices": {"hostapd": ["hostapd.sock"]},
            "bus": {"listen": [f"tcp/127.0.0.1:{self._bus_port}"]},
            "web": {"port": self._web_port},
        }
        draft = self._folder / "vad.yaml.new"
        draft.write_text(yaml.safe_dump(settings, sort_keys=False))
        draft.replace(self._folder / "vad.yaml")  # who waits for it finds it whole, and all else in place


def _jpeg(renderer: Renderer, t_s: float) -> bytes:
    ok, encoded = cv2.imencode(".jpg", renderer.frame(t_s), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    assert ok
    data: NDArray[np.uint8] = encoded
    return data.tobytes()
