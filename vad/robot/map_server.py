"""ROS map_server floor plans: YAML + PGM <-> FloorPlan (formats.md, section 6).

The extra key `rooms` is ours: a list of {name, polygon_m: [[x, y], ...]}; other programs ignore it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import yaml
from numpy.typing import NDArray

from vad.errors import ConfigError, SourceError
from vad.robot.floor_plan import FREE, OCCUPIED, UNKNOWN, FloorPlan, Room
from vad.robot.pgm import parse_pgm, pgm_bytes

Mode = Literal["trinary", "scale", "raw"]

OCCUPIED_THRESH = 0.65
FREE_THRESH = 0.196
UNKNOWN_GREY = 205
"""What map_saver writes for unknown: p = 0.19608, which a free_thresh of 0.25 would read as free."""
FREE_GREY = 254
OCCUPIED_GREY = 0
RAW_UNKNOWN = 255


@dataclass(frozen=True, slots=True)
class MapMetadata:
    """The YAML file. origin: x_m, y_m, yaw_rad of the picture's lower-left corner in the map frame."""

    image: str
    resolution_m: float
    origin: tuple[float, float, float]
    negate: bool
    occupied_thresh: float
    free_thresh: float
    mode: Mode
    rooms: tuple[Room, ...]


def parse_metadata(data: bytes, *, where: str) -> MapMetadata:
    """The values of a map's YAML; unknown keys are tolerated. ConfigError with `where` and the key."""
    try:
        tree = yaml.safe_load(data)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        message = " ".join(str(error).split())
        raise ConfigError(f"this is not YAML: {message}", where=where, remedy="Correct the file") from error
    if not isinstance(tree, dict):
        raise ConfigError(
            "this is not a map's YAML", where=where, remedy="It needs image, resolution, origin"
        )
    reader = _Reader(tree, where)
    mode = tree.get("mode", "trinary")
    if mode not in ("trinary", "scale", "raw"):
        raise reader.error("mode", f"{mode!r} is no mode", "Use trinary, scale or raw")
    resolution_m = reader.number("resolution")
    if resolution_m <= 0:
        raise reader.error("resolution", "it must be above 0", "Give the metres per pixel, e.g. 0.05")
    free_thresh, occupied_thresh = reader.number("free_thresh"), reader.number("occupied_thresh")
    if not 0 <= free_thresh < occupied_thresh <= 1:
        raise reader.error(
            "free_thresh", "0 <= free_thresh < occupied_thresh <= 1 does not hold", _THRESHOLDS
        )
    return MapMetadata(
        image=reader.text("image"),
        resolution_m=resolution_m,
        origin=reader.origin(),
        negate=bool(reader.number("negate")),
        occupied_thresh=occupied_thresh,
        free_thresh=free_thresh,
        mode=mode,
        rooms=reader.rooms(),
    )


def cells_from_pixels(pixels: NDArray[np.uint16], maxval: int, metadata: MapMetadata) -> NDArray[np.int8]:
    """Occupancy (rows, cols) int8, row 0 at the bottom, from pixels (rows, cols), row 0 at the top.

    Grey 205 of 255 is unknown whatever free_thresh says, unless the picture is negated.
    """
    if metadata.mode == "raw":
        return np.where(pixels <= OCCUPIED, pixels, UNKNOWN).astype(np.int8)[::-1].copy()
    shade = pixels / maxval
    p = shade if metadata.negate else 1.0 - shade
    free, occupied = metadata.free_thresh, metadata.occupied_thresh
    between = (
        np.rint((p - free) / (occupied - free) * OCCUPIED) if metadata.mode == "scale" else float(UNKNOWN)
    )
    # A millionth of a grey level: 1 - v/255 and a threshold written as v/255 may differ in the last bit.
    tiny = 1e-6 / maxval
    cells = np.where(p >= occupied - tiny, OCCUPIED, np.where(p <= free + tiny, FREE, between))
    if not metadata.negate and maxval == 255:
        cells = np.where(pixels == UNKNOWN_GREY, UNKNOWN, cells)
    return cells.astype(np.int8)[::-1].copy()


def floor_plan_from_bytes(
    yaml_bytes: bytes, pgm: bytes, *, epoch: int, where: str, image_where: str
) -> FloorPlan:
    """The floor plan in a YAML and a PGM. ConfigError or ProtocolError with `where` / `image_where`."""
    metadata = parse_metadata(yaml_bytes, where=where)
    pixels, maxval = parse_pgm(pgm, where=image_where)
    cells = cells_from_pixels(pixels, maxval, metadata)
    return FloorPlan(epoch, metadata.resolution_m, metadata.origin, cells, metadata.rooms)


def floor_plan_to_bytes(plan: FloorPlan, image: str) -> tuple[bytes, bytes]:
    """YAML (naming the picture `image`) and PGM (P5); reading them gives the same cells, origin and rooms.

    Written as trinary, or as raw where there are cells between free and occupied.
    """
    raw = bool(((plan.cells > FREE) & (plan.cells < OCCUPIED)).any())
    top_down = plan.cells[::-1]
    if raw:
        pixels = np.where(top_down == UNKNOWN, RAW_UNKNOWN, top_down)
    else:
        known = np.where(top_down == FREE, FREE_GREY, OCCUPIED_GREY)
        pixels = np.where(top_down == UNKNOWN, UNKNOWN_GREY, known)
    tree: dict[str, object] = {
        "image": image,
        "mode": "raw" if raw else "trinary",
        "resolution": plan.resolution_m,
        "origin": list(plan.origin),
        "negate": 0,
        "occupied_thresh": OCCUPIED_THRESH,
        "free_thresh": FREE_THRESH,
    }
    if plan.rooms:
        tree["rooms"] = [{"name": room.name, "polygon_m": room.polygon.tolist()} for room in plan.rooms]
    # PyYAML writes U+0085 unescaped and reads it as a line break.
    readable = all("\x85" not in room.name for room in plan.rooms)
    text = yaml.safe_dump(tree, sort_keys=False, allow_unicode=readable, default_flow_style=None)
    return text.encode(), pgm_bytes(pixels.astype(np.uint8))


def load_floor_plan(path: Path, *, epoch: int) -> FloorPlan:
    """Read a map's YAML and the picture it names, relative to it. SourceError, ConfigError, ProtocolError."""
    yaml_bytes = _read(path, "Give the path of the map's .yaml file")
    image = path.parent / parse_metadata(yaml_bytes, where=str(path)).image
    pgm = _read(image, f"Correct `image:` in {path}")
    return floor_plan_from_bytes(yaml_bytes, pgm, epoch=epoch, where=str(path), image_where=str(image))


def load_rooms(path: Path) -> tuple[Room, ...]:
    """The rooms of a YAML that has the key `rooms` as described above. SourceError, ConfigError."""
    data = _read(path, "Give the path of a YAML with rooms")
    try:
        tree = yaml.safe_load(data)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError("this is not YAML", where=str(path), remedy="Correct the file") from error
    rooms = _Reader(tree if isinstance(tree, dict) else {}, str(path)).rooms()
    if not rooms:
        raise ConfigError("no rooms here", where=str(path), remedy=_REMEDIES["rooms"])
    return rooms


def save_floor_plan(plan: FloorPlan, path: Path) -> None:
    """Write `path` (.yaml) and the picture beside it (.pgm); SourceError where that cannot be done."""
    image = path.with_suffix(".pgm")
    yaml_bytes, pgm = floor_plan_to_bytes(plan, image.name)
    try:
        # The picture first: a YAML never names one that is not there yet.
        image.write_bytes(pgm)
        path.write_bytes(yaml_bytes)
    except OSError as error:
        remedy = "Choose a folder that exists and may be written"
        raise SourceError(f"cannot write the floor plan: {error}", where=str(path), remedy=remedy) from error


_THRESHOLDS = f"Use occupied_thresh: {OCCUPIED_THRESH} and free_thresh: {FREE_THRESH}"
_REMEDIES = {
    "image": "Name the .pgm file",
    "resolution": "Give the metres per pixel, e.g. 0.05",
    "origin": "Give [x, y, yaw] of the lower-left corner in metres and radians",
    "negate": "Use 0",
    "occupied_thresh": _THRESHOLDS,
    "free_thresh": _THRESHOLDS,
    "rooms": "Write a list of {name: Kitchen, polygon_m: [[x, y], [x, y], [x, y]]}",
}


class _Reader:
    """Typed values out of the YAML's tree, with errors that name the key."""

    def __init__(self, tree: Mapping[object, object], where: str) -> None:
        self._tree = tree
        self._where = where

    def error(self, key: str, what: str, remedy: str) -> ConfigError:
        return ConfigError(what, where=f"{self._where}: $.{key}", remedy=remedy)

    def _wrong(self, key: str, what: str, at: str = "") -> ConfigError:
        return self.error(key + at, what, _REMEDIES[key])

    def _value(self, key: str) -> object:
        if key not in self._tree:
            raise self._wrong(key, "this key is missing")
        return self._tree[key]

    def text(self, key: str) -> str:
        value = self._value(key)
        if not isinstance(value, str) or not value:
            raise self._wrong(key, "a text is needed here")
        return value

    def number(self, key: str) -> float:
        value = _finite(self._value(key))
        if value is None:
            raise self._wrong(key, "a number is needed here")
        return value

    def origin(self) -> tuple[float, float, float]:
        value = self._value("origin")
        numbers = [_finite(item) for item in value] if isinstance(value, list) else []
        if len(numbers) != 3 or (x := numbers[0]) is None or (y := numbers[1]) is None:
            raise self._wrong("origin", "three numbers are needed here")
        if (yaw := numbers[2]) is None:
            raise self._wrong("origin", "three numbers are needed here")
        return x, y, yaw

    def rooms(self) -> tuple[Room, ...]:
        value = self._tree.get("rooms")
        if value is None:
            return ()
        if not isinstance(value, list):
            raise self._wrong("rooms", "a list is needed here")
        return tuple(self._room(item, f"[{index}]") for index, item in enumerate(value))

    def _room(self, item: object, at: str) -> Room:
        name = item.get("name") if isinstance(item, dict) else None
        points = item.get("polygon_m") if isinstance(item, dict) else None
        if not isinstance(name, str) or not name or not isinstance(points, list) or len(points) < 3:
            raise self._wrong("rooms", "a room needs a name and at least three points", at)
        corners = [[_finite(number) for number in point] for point in points if isinstance(point, list)]
        if len(corners) < len(points) or any(len(point) != 2 or None in point for point in corners):
            raise self._wrong("rooms", "a point needs two numbers", f"{at}.polygon_m")
        return Room(name, np.array(corners, np.float64))


def _finite(value: object) -> float | None:
    # YAML 1.1 reads 5e-2 as a text.
    if not isinstance(value, (int, float, str)):
        return None
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _read(path: Path, remedy: str) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        reason = error.strerror or str(error)
        raise SourceError(f"cannot read this file: {reason}", where=str(path), remedy=remedy) from error
