"""Valetudo's map JSON: bytes -> floor plan, rooms and pose, no I/O (formats.md, section 4).

Its picture has its origin at the top left with y down; here y points up from the picture's lower edge, so
that places stay the same while the robot explores. Only the part that holds pixels becomes cells.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from typing import Any

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from vad.errors import ProtocolError
from vad.limits import UNREADABLE
from vad.robot.floor_plan import FREE, OCCUPIED, UNKNOWN, FloorPlan, Room

MAX_JSON_BYTES = 64_000_000
MAX_SIDE_CM = 40_000.0
MAX_PIXELS = 16_000_000
"""Of all runs together; a home of 400 m2 has 160,000."""
MARGIN_CELLS = 2
MIN_ROOM_M2 = 0.5
"""Parts of a segment smaller than this are specks, unless it has no larger one."""
DOCK_RADIUS_M = 0.3
"""A docked robot's centre is 8 to 25 cm from the charger's point in real maps."""


class _Size(msgspec.Struct):
    x: float
    y: float


class _Layer(msgspec.Struct):
    type: str
    pixels: list[int] = []
    compressedPixels: list[int] = []  # noqa: N815 - the format's name
    metaData: dict[str, Any] = {}  # noqa: N815 - the format's name


class _Entity(msgspec.Struct):
    type: str
    points: list[float] = []
    metaData: dict[str, Any] = {}  # noqa: N815 - the format's name


class _Map(msgspec.Struct):
    size: _Size
    pixelSize: float  # noqa: N815 - the format's name
    layers: list[_Layer]
    entities: list[_Entity]
    metaData: dict[str, Any] = {}  # noqa: N815 - the format's name


@dataclass(frozen=True, slots=True)
class ValetudoPose:
    """Metres, map frame; yaw_rad None where the robot does not tell its heading."""

    x_m: float
    y_m: float
    yaw_rad: float | None


@dataclass(frozen=True, slots=True, eq=False)
class ValetudoMap:
    """One map. pose: None while the robot has no place on it; docked: it stands at its charger."""

    plan: FloorPlan
    pose: ValetudoPose | None
    docked: bool


_decoder = msgspec.json.Decoder(_Map)


def map_from_payload(payload: bytes, epoch: int) -> ValetudoMap:
    """The map in JSON (SSE) or zlib-deflated JSON (MQTT, zenoh); ProtocolError for anything else."""
    try:
        if payload[:1] == b"\x78":
            unpacker = zlib.decompressobj()
            # bounded: a small message must not unpack into the whole memory
            payload = unpacker.decompress(payload, MAX_JSON_BYTES)
            if unpacker.unconsumed_tail or not unpacker.eof:
                raise ProtocolError("the map is cut off, or too large")
        return _read(_decoder.decode(payload), epoch)
    except (*UNREADABLE, zlib.error, ValueError, OverflowError) as error:
        raise ProtocolError(
            f"this is no Valetudo map: {error}", remedy="Is this Valetudo 2021.04 or newer?"
        ) from error


def _read(found: _Map, epoch: int) -> ValetudoMap:
    size = found.pixelSize
    if not (0 < size <= 100 and 0 < found.size.x <= MAX_SIDE_CM and 0 < found.size.y <= MAX_SIDE_CM):
        raise ValueError("a size that no home has")
    width, height = math.ceil(found.size.x / size), math.ceil(found.size.y / size)
    layers = [(layer, _pixels(layer, width, height)) for layer in found.layers]
    drawn = np.concatenate([pixels for _, pixels in layers] or [np.empty((0, 2), np.int64)])
    if not len(drawn):
        raise ValueError("it has no pixels yet")
    left, top = drawn.min(axis=0) - MARGIN_CELLS
    right, bottom = drawn.max(axis=0) + MARGIN_CELLS
    cells = np.full((bottom - top + 1, right - left + 1), UNKNOWN, np.int8)
    # Walls last: where a segment runs under a wall, the wall is what stops.
    for layer, pixels in sorted(layers, key=lambda entry: entry[0].type == "wall"):
        if layer.type in ("floor", "segment", "wall"):
            value = OCCUPIED if layer.type == "wall" else FREE
            cells[bottom - pixels[:, 1], pixels[:, 0] - left] = value
    resolution_m = size / 100
    origin = (float(left) * resolution_m, (found.size.y - (float(bottom) + 1) * size) / 100, 0.0)
    rooms: list[Room] = []
    for layer, pixels in layers:
        if layer.type == "segment" and len(pixels):
            mask = np.zeros(cells.shape, np.uint8)
            mask[bottom - pixels[:, 1], pixels[:, 0] - left] = 1
            rooms += _rooms(_name(layer.metaData), mask, origin, resolution_m)
    pose = _pose(found)
    plan = FloorPlan(epoch, resolution_m, origin, cells, tuple(rooms), _map_id(found.metaData))
    return ValetudoMap(plan, pose, _docked(found, pose))


def _pixels(layer: _Layer, width: int, height: int) -> NDArray[np.int64]:
    """Every pixel of a layer, (N, 2) as x, y."""
    single = np.array(layer.pixels, np.int64)
    runs = np.array(layer.compressedPixels, np.int64)
    if len(single) % 2 or len(runs) % 3:
        raise ValueError("a layer's pixels are not whole")
    x, y, count = runs.reshape(-1, 3).T
    if (count < 1).any() or (count > width).any() or count.sum() + len(single) > MAX_PIXELS:
        raise ValueError("a run of pixels is too long")
    begins = np.cumsum(count) - count
    along = np.arange(count.sum()) - np.repeat(begins, count)
    pixels = np.stack([np.repeat(x, count) + along, np.repeat(y, count)], axis=1)
    pixels = np.concatenate([single.reshape(-1, 2), pixels])
    if len(pixels) and ((pixels < 0).any() or (pixels >= (width, height)).any()):
        raise ValueError("a pixel is outside the map")
    return pixels


def _rooms(
    name: str, mask: NDArray[np.uint8], origin: tuple[float, float, float], resolution_m: float
) -> list[Room]:
    """The parts of a segment as polygons along the cells' edges, the largest first."""
    scale = 2  # contours go through pixel centres: half a cell inside where cells are not split
    large = mask.repeat(scale, axis=0).repeat(scale, axis=1)
    contours, _ = cv2.findContours(large, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    rooms: list[Room] = []
    for contour in sorted(contours, key=cv2.contourArea, reverse=True):
        area_m2 = cv2.contourArea(contour) * (resolution_m / scale) ** 2
        if rooms and area_m2 < MIN_ROOM_M2:
            break
        outline = cv2.approxPolyDP(contour, scale, closed=True)[:, 0, :].astype(np.float64)
        if len(outline) >= 3:
            rooms.append(Room(name, np.array(origin[:2]) + (outline + 0.5) / scale * resolution_m))
    return rooms


def _name(meta: dict[str, Any]) -> str:
    name = meta.get("name")
    return name if isinstance(name, str) and name else f"Room {meta.get('segmentId', '?')}"


def _map_id(meta: dict[str, Any]) -> str:
    """The map's own name: a nonce where there is one, else the vendor's number."""
    return str(meta.get("nonce", meta.get("vendorMapId", "")))


def _point(found: _Map, kind: str) -> tuple[float, float, Any] | None:
    """The first entity of a kind: metres, and its angle as it stands."""
    for entity in found.entities:
        if entity.type == kind and len(entity.points) >= 2:
            x_cm, y_cm = entity.points[:2]
            return x_cm / 100, (found.size.y - y_cm) / 100, entity.metaData.get("angle")
    return None


def _pose(found: _Map) -> ValetudoPose | None:
    place = _point(found, "robot_position")
    if place is None:
        return None
    x_m, y_m, angle = place
    yaw_rad = None
    if isinstance(angle, (int, float)):
        # north is 0 and it turns clockwise
        yaw_rad = math.remainder(math.radians(90.0 - angle), math.tau)
    return ValetudoPose(x_m, y_m, yaw_rad)


def _docked(found: _Map, pose: ValetudoPose | None) -> bool:
    dock = _point(found, "charger_location")
    if pose is None or dock is None:
        return False
    return math.hypot(pose.x_m - dock[0], pose.y_m - dock[1]) <= DOCK_RADIUS_M
