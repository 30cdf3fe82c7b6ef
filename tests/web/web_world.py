"""What the tests of the page share: a bus with a simulated home on it, the page, a reader of its stream."""

from __future__ import annotations

import json
import math
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np

from vad.bus import messages as m
from vad.bus.grid import grid_to_png
from vad.bus.node import Bus
from vad.bus.plan import map_message
from vad.bus.session import BusSettings
from vad.config import Settings, parse_settings
from vad.daemon.registry import Registry
from vad.daemon.wishes import Wishes
from vad.sim.home import floor_plan
from vad.sim.scenario import make_home
from vad.store.worker import StoreWorker
from vad.web.access import Access, TokenFile, write_token
from vad.web.home import HomeFeed, Robot
from vad.web.server import PageServer

Serving = Callable[..., Any]
"""`async with serving(...) as world`, see conftest.py."""
PLAN = floor_plan(make_home(1, walks=1))
STATES: tuple[m.DeviceState, ...] = ("mapped", "mapped", "mapped", "waiting", "failed", "stale", "discovered")


def mac(i: int) -> str:
    return f"f4:f5:d8:00:{i >> 8:02x}:{i & 255:02x}"


def settings(folder: Path) -> Settings:
    plain = {
        "source": "simulated",
        "state_dir": str(folder),
        "map": {"file": "floor.yaml"},
        "robot": {"type": "neato", "port": "none"},
        "camera": {"source": {"type": "mjpeg", "url": "http://127.0.0.1:9/"}},
        "radio": {},
        "devices": {},
    }
    return parse_settings(json.dumps(plain), where="test")


def device(i: int, turn: float = 0.0, **changes: Any) -> m.DeviceMessage:
    """Device i of a home with many, its region as long as they are in practice."""
    x0, y0, x1, y1 = PLAN.bounds_m
    rng = np.random.default_rng(i)
    x = float(x0 + (x1 - x0) * rng.uniform(0.08, 0.92) + 0.05 * math.cos(turn))
    y = float(y0 + (y1 - y0) * rng.uniform(0.08, 0.92) + 0.05 * math.sin(turn))
    state = STATES[i % len(STATES)]
    radius = float(rng.uniform(0.2, 0.8))
    around = [2 * math.pi * k / 40 for k in range(40)]
    fields: dict[str, Any] = {
        "source": "simulated",
        "mac": mac(i),
        "name": f"Device {i}",
        "state": state,
        "reason": "" if state == "mapped" else "waiting for somebody to walk through the picture",
        "epoch": PLAN.epoch,
        "in_network": True,
    }
    if state != "discovered":
        fields |= {
            "x_m": x,
            "y_m": y,
            "covariance_m2": ((0.04, 0.01), (0.01, 0.09)),
            "radius90_m": radius,
            "region90": tuple((x + radius * math.cos(a), y + 0.6 * radius * math.sin(a)) for a in around),
            "room": PLAN.room_at(x, y),
            "walks": 3,
            "evidence": {"packets": 12000.0, "walk_s": 31.5},
        }
    return m.DeviceMessage(**(fields | changes))


def heatmap(i: int) -> m.HeatmapMessage:
    x0, y0, x1, y1 = PLAN.bounds_m
    shape = round((y1 - y0) / 0.1), round((x1 - x0) / 0.1)
    p = np.random.default_rng(i).random(shape) ** 8
    return m.heatmap_message(
        p, source="simulated", mac=mac(i), epoch=PLAN.epoch, bounds_m=PLAN.bounds_m, step_m=0.1
    )


def furnish(bus: Bus, devices: int) -> None:
    """Publish a home: its plan, a camera, devices in all states, a heatmap."""
    bus.publish_map(map_message(PLAN, "simulated"))
    bus.publish_grid(grid_to_png(PLAN.cells))
    x0, y0, x1, y1 = PLAN.bounds_m
    bus.publish_camera(
        m.CameraMessage(
            source="simulated",
            id="main",
            state="valid",
            percent=100,
            position_m=(x0 + 0.1, y0 + 0.1, 2.2),
            map_from_camera=((0.0, 0.0, 0.7), (0.0, 0.0, 0.7), (0.0, 0.0, -0.2)),
            deviation_m=0.02,
            epoch=PLAN.epoch,
            floor_m=((x0 + 0.5, y0 + 0.3), (x1 - 0.1, y0 + 0.6), (x1 - 0.1, y1 - 0.1), (x0 + 0.4, y1 - 0.1)),
        )
    )
    for i in range(devices):
        bus.publish_device(device(i))
    bus.publish_heatmap(heatmap(0))
    bus.publish_status(status("waiting for somebody to walk through the picture"))


def status(step: str, **changes: Any) -> m.StatusMessage:
    parts = (
        m.Part(part="robot", state="ok", detail="/dev/ttyACM0"),
        m.Part(part="csi", state="degraded", detail="no packet for 40 s", last_error="no packet for 40 s"),
    )
    fields: dict[str, Any] = {
        "source": "simulated",
        "version": "0.1.0",
        "uptime_s": 5.0,
        "step": step,
        "parts": parts,
    }
    return m.StatusMessage(**(fields | changes))


@dataclass
class World:
    """A page that runs. robot: what it is told when it asks; asked: how often it did."""

    bus: Bus
    registry: Registry
    page: PageServer
    token: str
    http: aiohttp.ClientSession
    robot: Robot | None = None
    asked: int = 0
    folder: Path = field(default_factory=Path)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.page.port}"

    def see_robot(self) -> Robot | None:
        self.asked += 1
        return self.robot


@asynccontextmanager
async def world(
    folder: Path, *, devices: int = 3, may_change: bool = True, port: int = 0, names: tuple[str, ...] = ()
) -> AsyncIterator[World]:
    """A bus without a network, a real registry behind it, and the page, not yet run."""
    bus = Bus(BusSettings(), source="simulated")
    furnish(bus, devices)
    token = write_token(folder / "token") if may_change else ""
    access = Access(port, names=names, token=TokenFile(folder / "token") if may_change else None)
    async with StoreWorker(folder / "vad.sqlite") as store:
        registry = Registry(settings(folder), PLAN, bus, store)
        await registry.load()
        wishes = Wishes(bus.keys, registry, "simulated")
        home = HomeFeed(bus.keys, bus.listen)

        def robot() -> Robot | None:
            return made.see_robot()

        page = PageServer(access, "home", home, wishes.answer, robot)
        async with aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as http:
            made = World(bus, registry, page, token, http, folder=folder)
            yield made


@dataclass(frozen=True)
class Event:
    """One server-sent event."""

    kind: str
    id: str
    data: Any

    @property
    def key(self) -> str:
        return str(self.data["key"])

    @property
    def value(self) -> Any:
        return self.data["value"]


async def events(response: aiohttp.ClientResponse) -> AsyncIterator[Event]:
    """The events of a stream as a browser reads them."""
    kind, event_id, data = "message", "", ""
    async for raw in response.content:
        line = raw.decode().rstrip("\n")
        name, _, value = line.partition(": ")
        if line == "" and data:
            yield Event(kind, event_id, json.loads(data))
            kind, data = "message", ""
        elif name == "event":
            kind = value
        elif name == "id":
            event_id = value
        elif name == "data":
            data = value
