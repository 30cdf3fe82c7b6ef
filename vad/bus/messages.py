"""What is published: one frozen struct a message, JSON on the wire.

Every message names its schema, its hub, where its content came from, and when it was published. Readers
tolerate fields they do not know; a change that an old reader would misread gets a new schema id. Coordinates
are metres in the map frame of the message's `epoch` (x right, y up on the plan, z up).
"""

from __future__ import annotations

import math
import zlib
from functools import cache
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from vad.errors import ProtocolError

Source = Literal["live", "replay", "simulated"]
DeviceState = Literal["discovered", "waiting", "capturing", "mapped", "stale", "failed"]
CameraState = Literal["uncalibrated", "collecting", "valid", "invalid", "recalibrating"]
CaptureState = Literal["idle", "armed", "recording", "stopping", "solving", "done", "aborted"]
PartState = Literal["starting", "ok", "degraded", "failed"]
EventKind = Literal["joined", "mapped", "moved", "lost"]

MAX_CELLS_A_SIDE = 8192
"""Of a heatmap that is read; a small message must not unpack into the whole memory."""

Point = tuple[float, float]
Vector3 = tuple[float, float, float]
Matrix2 = tuple[Point, Point]
Matrix3 = tuple[Vector3, Vector3, Vector3]


class Message(msgspec.Struct, frozen=True, kw_only=True):
    """What all messages carry. The bus sets `hub` and `published_at` (RFC 3339, UTC) when it publishes."""

    source: Source
    hub: str = ""
    published_at: str = ""


class DeviceMessage(Message, frozen=True, kw_only=True):
    """Where a Wi-Fi device is, how sure that is, and why it is not known where it is not.

    reason: why it waits, failed or is stale; empty otherwise. covariance_m2: 2x2 of (x, y). radius90_m:
    radius of the circle around (x, y) that holds 90 % of the posterior. region90: outline of the 90 % region,
    metres. height90_m: lowest and highest height above the floor that hold 90 %; null where it is not told.
    walks: how many walks went into the estimate. evidence: named counts (packets, seconds ...).

    mac: the address it was first seen with, its name for good; macs: every address it had, the present one
    last; random_mac: whether that one is made up. host_name: what it calls itself. vendor: its maker. agent:
    the id of a remote CSI node. in_network: whether it is in now. first_seen, last_seen: RFC 3339, UTC; the
    latter when it last came or went. moved: new evidence contradicts its place.
    """

    schema: Literal["vad.device.v1"] = "vad.device.v1"
    mac: str
    name: str | None = None
    state: DeviceState
    reason: str = ""
    x_m: float | None = None
    y_m: float | None = None
    covariance_m2: Matrix2 | None = None
    radius90_m: float | None = None
    region90: tuple[Point, ...] | None = None
    room: str | None = None
    epoch: int = 0
    walks: int = 0
    evidence: dict[str, float] = {}
    updated_at: str | None = None
    method: str | None = None
    height90_m: tuple[float, float] | None = None
    macs: tuple[str, ...] = ()
    random_mac: bool = False
    ip: str | None = None
    host_name: str | None = None
    vendor: str | None = None
    agent: str | None = None
    in_network: bool = False
    first_seen: str | None = None
    last_seen: str | None = None
    moved: bool = False

    @property
    def sigma_m(self) -> float | None:
        """Standard deviation along the worst direction (square root of the larger eigenvalue), metres."""
        if self.covariance_m2 is None:
            return None
        (a, b), (_, c) = self.covariance_m2
        return math.sqrt(max(0.0, (a + c) / 2 + math.hypot((a - c) / 2, b)))


class DevicesMessage(Message, frozen=True, kw_only=True):
    """Several devices in one answer, by MAC; each is the message of its own key."""

    schema: Literal["vad.devices.v1"] = "vad.devices.v1"
    devices: tuple[DeviceMessage, ...]


class HistoryEntry(msgspec.Struct, frozen=True, kw_only=True):
    """What was said of a device from `at` (RFC 3339, UTC) to the next entry; coordinates in map `epoch`."""

    at: str
    state: DeviceState
    epoch: int
    x_m: float | None = None
    y_m: float | None = None
    covariance_m2: Matrix2 | None = None
    radius90_m: float | None = None
    room: str | None = None
    name: str | None = None
    walks: int = 0


class HistoryMessage(Message, frozen=True, kw_only=True):
    """How a device came to be where it is: the newest entry first."""

    schema: Literal["vad.history.v1"] = "vad.history.v1"
    mac: str
    entries: tuple[HistoryEntry, ...] = ()


class CameraMessage(Message, frozen=True, kw_only=True):
    """A camera's place and how good it is.

    percent: 0-100, how much of the calibration's evidence is there. position_m: optical centre in the map.
    map_from_camera: rotation, row-major. map_from_image: homography of undistorted pixels to the floor.
    deviation_m: mean floor error over the pairs. time_offset_ms: camera stamp minus pose stamp of one moment.
    floor_m: outline of the floor in its picture, within the map's bounds; walls are not considered.
    """

    schema: Literal["vad.camera.v1"] = "vad.camera.v1"
    id: str
    state: CameraState
    percent: float = 0.0
    reason: str = ""
    position_m: Vector3 | None = None
    map_from_camera: Matrix3 | None = None
    map_from_image: Matrix3 | None = None
    deviation_m: float | None = None
    time_offset_ms: float | None = None
    epoch: int = 0
    pairs: int = 0
    floor_m: tuple[Point, ...] | None = None


class Room(msgspec.Struct, frozen=True, kw_only=True):
    """A named room; its outline in the map frame."""

    name: str
    polygon_m: tuple[Point, ...]


class MapMessage(Message, frozen=True, kw_only=True):
    """The floor plan's frame; the picture itself is at `map/grid`.

    bounds_m: x0, y0, x1, y1. origin: x_m, y_m, yaw_rad of the lower-left corner of the grid's lower-left
    cell. width, height: cells.
    """

    schema: Literal["vad.map.v1"] = "vad.map.v1"
    epoch: int
    bounds_m: tuple[float, float, float, float]
    resolution_m: float
    origin: Vector3
    width: int
    height: int
    rooms: tuple[Room, ...] = ()


class HeatmapMessage(Message, frozen=True, kw_only=True):
    """A device's posterior over the map.

    bounds_m: x0, y0, x1, y1 of the outer cell edges; step_m: the cells' side. probability: base64 in JSON of
    zlib of little-endian float32, row-major, `height` rows of `width`, row 0 at y0; it sums to 1.
    """

    schema: Literal["vad.heatmap.v1"] = "vad.heatmap.v1"
    mac: str
    epoch: int
    bounds_m: tuple[float, float, float, float]
    step_m: float
    width: int
    height: int
    probability: bytes


class Latency(msgspec.Struct, frozen=True, kw_only=True):
    """How long one kind of work took: `count` times, `total_s` since the start; the rest of late."""

    count: int
    total_s: float
    p50_ms: float
    p99_ms: float
    max_ms: float


class Part(msgspec.Struct, frozen=True, kw_only=True):
    """Health of one part of the daemon.

    last_error: the reason for the last trouble, last_error_at: when that began. counters: since the start;
    rates_per_s: of those counters that moved, over the last seconds.
    """

    part: str
    state: PartState
    detail: str = ""
    last_error: str = ""
    last_error_at: str | None = None
    counters: dict[str, int] = {}
    rates_per_s: dict[str, float] = {}
    latencies: dict[str, Latency] = {}


class StatusMessage(Message, frozen=True, kw_only=True):
    """How the daemon is. step: one sentence for people, what is going on now."""

    schema: Literal["vad.status.v1"] = "vad.status.v1"
    version: str
    uptime_s: float
    step: str = ""
    parts: tuple[Part, ...] = ()


class CaptureResult(msgspec.Struct, frozen=True, kw_only=True):
    """What one capture said about its device."""

    x_m: float
    y_m: float
    radius90_m: float


class CaptureMessage(Message, frozen=True, kw_only=True):
    """Progress (0 to 1) and result of one capture. walk_s: seconds of walking recorded so far."""

    schema: Literal["vad.capture.v1"] = "vad.capture.v1"
    session: str
    mac: str
    state: CaptureState
    reason: str = ""
    packets: int = 0
    walk_s: float = 0.0
    progress: float = 0.0
    result: CaptureResult | None = None


class EventMessage(Message, frozen=True, kw_only=True):
    """Something happened to a device."""

    schema: Literal["vad.event.v1"] = "vad.event.v1"
    kind: EventKind
    mac: str
    text: str


class EventsMessage(Message, frozen=True, kw_only=True):
    """The last events, the newest first; the daemon forgets them when it ends."""

    schema: Literal["vad.events.v1"] = "vad.events.v1"
    events: tuple[EventMessage, ...] = ()


class DeviceWish(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a person wants of a device, as the payload of a query on `vad/<hub>/wishes`.

    mac: any address the device ever had. ignore: leave it alone from now on, or no more. name: what to call
    it, empty: what it calls itself. forget: drop it and all its walks. What is left out stays as it is;
    without any, the answer only lists.
    """

    schema: Literal["vad.wish.v1"] = "vad.wish.v1"
    mac: str | None = None
    ignore: bool | None = None
    name: Annotated[str, msgspec.Meta(max_length=64)] | None = None
    forget: bool = False


class IgnoredDevice(msgspec.Struct, frozen=True, kw_only=True):
    """A device that is left alone. by_settings: the settings say so, and only they can say otherwise."""

    mac: str
    name: str | None = None
    last_seen: str | None = None
    by_settings: bool = False


class WishReply(Message, frozen=True, kw_only=True):
    """What became of a wish (empty where none was made), and who is ignored now."""

    schema: Literal["vad.wishes.v1"] = "vad.wishes.v1"
    text: str = ""
    ignored: tuple[IgnoredDevice, ...] = ()


class ErrorMessage(msgspec.Struct, frozen=True, kw_only=True):
    """Why a query is refused: a code for programs, a sentence for people.

    Codes now: bad_selector; bad_wish; out_of_history (asked for a time before what is kept); not_available
    (this daemon keeps no history); busy (ask again later); waiting (it is done once it can be); internal. A
    reader takes one it does not know for a refusal.
    """

    schema: Literal["vad.error.v1"] = "vad.error.v1"
    code: str
    text: str


ALL: tuple[type[msgspec.Struct], ...] = (
    DeviceMessage,
    DevicesMessage,
    HistoryMessage,
    EventsMessage,
    CameraMessage,
    MapMessage,
    HeatmapMessage,
    StatusMessage,
    CaptureMessage,
    EventMessage,
    DeviceWish,
    WishReply,
    ErrorMessage,
)
"""Every message type that has a schema of its own."""

M = TypeVar("M", bound=msgspec.Struct)


@cache
def schema_id(kind: type[msgspec.Struct]) -> str:
    """The schema id of a message type, e.g. `vad.device.v1`."""
    for field in msgspec.structs.fields(kind):
        if field.name == "schema":
            return str(field.default)
    raise TypeError(f"{kind.__name__} has no schema field")


def encoding_of(kind: type[msgspec.Struct]) -> str:
    """The zenoh encoding of a message type: `application/json;<schema id>`."""
    return f"application/json;{schema_id(kind)}"


def encode(message: msgspec.Struct) -> bytes:
    """A message as JSON bytes."""
    return msgspec.json.encode(message)


def decode(payload: bytes, kind: type[M]) -> M:
    """JSON bytes as a message; msgspec.DecodeError (ValidationError among them) for anything else."""
    try:
        return msgspec.json.decode(payload, type=kind)
    except (UnicodeDecodeError, RecursionError) as error:  # as msgspec raises them; its own pass
        raise msgspec.DecodeError(str(error)) from error


def heatmap_message(
    probability: NDArray[np.floating[Any]],
    *,
    source: Source,
    mac: str,
    epoch: int,
    bounds_m: tuple[float, float, float, float],
    step_m: float,
) -> HeatmapMessage:
    """The message of a posterior. probability: (height, width), row 0 at y0, any positive scale."""
    height, width = probability.shape
    normal = (probability / probability.sum()).astype("<f4")
    return HeatmapMessage(
        source=source,
        mac=mac,
        epoch=epoch,
        bounds_m=bounds_m,
        step_m=step_m,
        width=width,
        height=height,
        probability=zlib.compress(normal.tobytes()),
    )


def probabilities(heatmap: HeatmapMessage) -> NDArray[np.float32]:
    """The posterior as (height, width) float32, row 0 at y0; ProtocolError where the sizes disagree."""
    if not (1 <= heatmap.width <= MAX_CELLS_A_SIDE and 1 <= heatmap.height <= MAX_CELLS_A_SIDE):
        raise ProtocolError("the heatmap's size is not that of a home", where=heatmap.mac)
    cells = heatmap.width * heatmap.height
    try:
        # bounded: a small message must not unpack into the whole memory
        raw = zlib.decompressobj().decompress(heatmap.probability, 4 * cells + 1)
    except zlib.error as error:
        raise ProtocolError(f"the heatmap is damaged: {error}", where=heatmap.mac) from error
    if len(raw) != 4 * cells:
        raise ProtocolError("the heatmap's size is not the one it states", where=heatmap.mac)
    return np.frombuffer(raw, "<f4").astype(np.float32).reshape(heatmap.height, heatmap.width)
