"""The hub's messages as the page's feed: the same bytes that go out over zenoh, pictures apart."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Literal

import cv2
import msgspec
import numpy as np

from vad.bus import messages as m
from vad.bus.board import Form
from vad.bus.grid import heatmap_to_png, png_to_grid
from vad.bus.keys import HubKeys, parse_key
from vad.web.feed import Feed

Theme = Literal["light", "dark"]

_FREE, _WALL = (
    {"light": (255, 255, 255), "dark": (31, 39, 48)},
    {"light": (57, 66, 78), "dark": (112, 125, 140)},
)
"""Colours (RGB) of floor and walls; what the robot has not seen is clear."""
_SHOWN = {"status", "map", "camera", "device", "capture"}


class Robot(msgspec.Struct, frozen=True, kw_only=True):
    """The robot as the page shows it; without a place where it has none. Angles counter-clockwise from x."""

    status: str
    x_m: float | None = None
    y_m: float | None = None
    yaw_rad: float | None = None
    sigma_m: float | None = None
    quality: str | None = None
    epoch: int | None = None


class _HeatmapHead(msgspec.Struct, frozen=True):
    epoch: int
    bounds_m: tuple[float, float, float, float]


class HomeFeed:
    """Hears a bus and keeps the feed; `feed` is what streams read.

    listen: Bus.listen.
    """

    def __init__(
        self, keys: HubKeys, listen: Callable[[Callable[[str, Form | None], None]], Callable[[], None]]
    ) -> None:
        self.feed = Feed()
        self._keys = keys
        self._listen = listen
        self._prefix = len(keys.status) - len("status")
        self._grid: tuple[int, bytes] | None = None
        self._plans: dict[Theme, tuple[int, bytes]] = {}
        self._heatmaps: dict[str, bytes] = {}
        self._robot: Robot | None = None

    def open(self) -> Callable[[], None]:
        """Begin to hear; what this returns ends it."""
        return self._listen(self._hear)

    def see_robot(self, robot: Robot) -> None:
        """Where the robot is now."""
        if robot != self._robot:
            self._robot = robot
            self.feed.put("robot", msgspec.json.encode(robot))

    def _hear(self, key: str, form: Form | None) -> None:
        parsed = parse_key(key)
        if parsed is None:
            return
        short = key[self._prefix :]
        if form is None:
            self._heatmaps.pop(parsed.name, None)
            self.feed.drop(short)
        elif parsed.kind in _SHOWN:
            self.feed.put(short, form.payload)
        elif parsed.kind == "events":
            self.feed.put(f"events/{self.feed.number + 1}", form.payload)
        elif parsed.kind == "grid":
            self._grid = (self.feed.number + 1, form.payload)
            self.feed.put(short, b'{"version":%d}' % self._grid[0])
        elif parsed.kind == "heatmap":
            self._heatmaps[parsed.name] = form.payload
            head = msgspec.json.decode(form.payload, type=_HeatmapHead)
            told = {"epoch": head.epoch, "bounds_m": head.bounds_m, "version": self.feed.number + 1}
            self.feed.put(short, msgspec.json.encode(told))

    async def plan_png(self, theme: Theme) -> bytes | None:
        """The floor plan in a theme's colours; None before there is one."""
        if self._grid is None:
            return None
        version, grid = self._grid
        made = self._plans.get(theme)
        if made is None or made[0] != version:
            made = self._plans[theme] = (version, await asyncio.to_thread(coloured_plan, grid, theme))
        return made[1]

    async def heatmap_png(self, mac: str) -> bytes | None:
        """A device's posterior, to be laid over the plan; None where there is none."""
        payload = self._heatmaps.get(mac)
        return None if payload is None else await asyncio.to_thread(_heatmap, payload)


def coloured_plan(grid_png: bytes, theme: Theme) -> bytes:
    """The published grid (vad.bus.grid) as a PNG in a theme's colours; unknown cells are clear."""
    cells = png_to_grid(grid_png)[::-1]
    picture = np.zeros((*cells.shape, 4), np.uint8)
    for value, (red, green, blue) in ((0, _FREE[theme]), (100, _WALL[theme])):
        picture[cells == value] = (blue, green, red, 255)
    encoded, data = cv2.imencode(".png", picture)
    if not encoded:
        raise ValueError(f"a plan of {cells.shape} cells cannot become a picture")
    return data.tobytes()


def _heatmap(payload: bytes) -> bytes:
    return heatmap_to_png(m.probabilities(m.decode(payload, m.HeatmapMessage)))
