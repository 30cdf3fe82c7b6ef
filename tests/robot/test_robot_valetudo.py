"""Valetudo maps: all recorded ones, made-up ones, damage; the event stream's parsers."""

from __future__ import annotations

import contextlib
import json
import math
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vad.errors import ProtocolError
from vad.robot.floor_plan import FREE, OCCUPIED, UNKNOWN
from vad.robot.sse import ChunkedDecoder, Event, SseParser, parse_head
from vad.robot.valetudo import ValetudoMap, map_from_payload

SMALL: dict[str, Any] = {
    "__class": "ValetudoMap",
    "metaData": {"version": 2, "nonce": "n-1"},
    "size": {"x": 1000, "y": 800},
    "pixelSize": 5,
    "layers": [
        {
            "type": "wall",
            "metaData": {},
            "pixels": [],
            "compressedPixels": [10, 20, 41, 10, 60, 41],
        },
        {
            "type": "segment",
            "metaData": {"segmentId": "3", "name": "Küche"},
            "pixels": [],
            "compressedPixels": [v for y in range(21, 60) for v in (10, y, 40)],
        },
        {"type": "floor", "metaData": {}, "pixels": [50, 40, 51, 40]},
    ],
    "entities": [
        {"type": "robot_position", "points": [150, 200], "metaData": {"angle": 0}},
        {"type": "charger_location", "points": [160, 200], "metaData": {"angle": 0}},
    ],
}


def small(**changes: Any) -> ValetudoMap:
    return map_from_payload(json.dumps(SMALL | changes).encode(), 4)


def test_every_recorded_map_has_pose_and_rooms(shared_data: Path) -> None:
    files = sorted((shared_data / "robots" / "valetudo").glob("*.json"))
    assert len(files) >= 29
    for file in files:
        tree = json.loads(file.read_bytes())
        found = map_from_payload(file.read_bytes(), 1)
        assert found.pose is not None, file.name
        assert found.pose.yaw_rad is not None
        names = {room.name for room in found.plan.rooms}
        segments = [layer for layer in tree["layers"] if layer["type"] == "segment"]
        # Rooms of one home may share a name.
        numbered = {s["metaData"].get("name", s["metaData"]["segmentId"]) for s in segments}
        assert len(names) == len(numbered), file.name
        assert {s["metaData"]["name"] for s in segments if "name" in s["metaData"]} <= names
        counted = sum(_pixel_count(layer) for layer in tree["layers"])
        # Walls may lie on top of a room's pixels, nothing else does.
        known = np.count_nonzero(found.plan.cells != UNKNOWN)
        assert 0.9 * counted < known <= counted
        at = found.plan.occupancy_at(np.array([[found.pose.x_m, found.pose.y_m]]))
        assert at[0] != OCCUPIED or found.docked, file.name
        for segment in segments:
            middle = _a_pixel(segment)
            x_m = (middle[0] + 0.5) * 0.05
            y_m = tree["size"]["y"] / 100 - (middle[1] + 0.5) * 0.05
            expected = segment["metaData"].get("name") or f"Room {segment['metaData']['segmentId']}"
            assert found.plan.room_at(x_m, y_m) == expected, file.name


def _pixel_count(layer: dict[str, Any]) -> int:
    return len(layer.get("pixels", [])) // 2 + sum(layer.get("compressedPixels", [])[2::3])


def _a_pixel(layer: dict[str, Any]) -> tuple[int, int]:
    """The middle of the longest run; of old maps without runs, the middle pixel."""
    runs = np.array(layer.get("compressedPixels", [])).reshape(-1, 3)
    if not len(runs):
        pixels = np.array(layer["pixels"]).reshape(-1, 2)
        x, y = pixels[len(pixels) // 2].tolist()
        return x, y
    x, y, count = runs[runs[:, 2].argmax()].tolist()
    return x + count // 2, y


def test_the_deflated_map_is_the_same(shared_data: Path) -> None:
    folder = shared_data / "robots" / "valetudo"
    packed = map_from_payload((folder / "map-data_mqtt_payload.zlib").read_bytes(), 1)
    plain = map_from_payload((folder / "roborock__S8_FW1286_with_obstacles.json").read_bytes(), 1)
    np.testing.assert_array_equal(packed.plan.cells, plain.plan.cells)
    assert packed.pose == plain.pose


def test_places_are_metres_with_y_up() -> None:
    found = small()
    assert found.pose is not None
    assert (found.pose.x_m, found.pose.y_m) == (1.5, 6.0)
    assert found.pose.yaw_rad == pytest.approx(math.pi / 2)
    assert found.docked
    assert found.plan.map_id == "n-1"
    assert found.plan.epoch == 4
    here = found.plan.occupancy_at(np.array([[1.5, 6.0], [1.5, 8 - 20.5 * 0.05], [1.5, 0.5]]))
    assert here.tolist() == [FREE, OCCUPIED, UNKNOWN]
    (room,) = found.plan.rooms
    assert room.name == "Küche"
    assert room.polygon.min(axis=0) == pytest.approx((0.5, 5.0), abs=0.03)
    assert room.polygon.max(axis=0) == pytest.approx((2.5, 6.95), abs=0.03)


@pytest.mark.parametrize(("angle", "yaw_deg"), [(0, 90), (90, 0), (180, -90), (270, 180), (-9, 99)])
def test_headings_turn_clockwise_from_north(angle: float, yaw_deg: float) -> None:
    entity = {"type": "robot_position", "points": [1, 1], "metaData": {"angle": angle}}
    pose = small(entities=[entity]).pose
    assert pose is not None
    assert pose.yaw_rad is not None
    assert math.remainder(pose.yaw_rad - math.radians(yaw_deg), math.tau) == pytest.approx(0, abs=1e-9)


def test_places_stay_when_the_map_grows() -> None:
    more = [*SMALL["layers"], {"type": "floor", "metaData": {}, "pixels": [2, 2, 150, 150]}]
    before, after = small().plan, small(layers=more).plan
    assert before.cells.shape != after.cells.shape
    points = np.array([[1.5, 6.0], [0.6, 8 - 20.5 * 0.05]])
    assert before.occupancy_at(points).tolist() == after.occupancy_at(points).tolist()


def test_no_robot_on_the_map_is_no_pose() -> None:
    found = small(entities=[])
    assert found.pose is None
    assert not found.docked


@pytest.mark.parametrize(
    "changes",
    [
        {"pixelSize": 0},
        {"size": {"x": 1e9, "y": 800}},
        {"layers": []},
        {"layers": [{"type": "floor", "compressedPixels": [1, 2]}]},
        {"layers": [{"type": "floor", "compressedPixels": [1, 2, 0]}]},
        {"layers": [{"type": "floor", "compressedPixels": [1, 2, 10**9]}]},
        {"layers": [{"type": "floor", "compressedPixels": [10**30, 2, 1]}]},
        {"layers": [{"type": "floor", "pixels": [200, 1]}]},
        {"layers": [{"type": "floor", "pixels": [-1, 1]}]},
    ],
)
def test_maps_that_are_none_are_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ProtocolError):
        small(**changes)


def test_a_bomb_is_not_unpacked() -> None:
    with pytest.raises(ProtocolError):
        map_from_payload(zlib.compress(b" " * 100_000_000), 0)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=200), st.booleans())
def test_any_bytes_are_read_or_refused(data: bytes, packed: bool) -> None:
    with contextlib.suppress(ProtocolError):
        map_from_payload(zlib.compress(data) if packed else data, 0)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.binary(max_size=40), max_size=8), st.data())
def test_events_come_out_whole_however_they_are_cut(datas: list[bytes], data: st.DataObject) -> None:
    lines = [piece.replace(b"\n", b"").replace(b"\r", b"") for piece in datas]
    stream = b": keep-alive\n\n" + b"".join(
        b"event: MapUpdated\r\ndata: " + line + b"\r\n\r\n: x\n\n" for line in lines
    )
    chunked = b"".join(
        b"%x;a=b\r\n" % len(stream[k : k + 7]) + stream[k : k + 7] + b"\r\n" for k in range(0, len(stream), 7)
    )
    chunked += b"0\r\n\r\n"
    decoder, parser, events = ChunkedDecoder(), SseParser(), []
    at = 0
    while at < len(chunked):
        step = data.draw(st.integers(1, 50))
        events += parser.feed(decoder.feed(chunked[at : at + step]))
        at += step
    assert decoder.ended
    assert events == [Event("MapUpdated", line) for line in lines]


def test_chunks_without_a_size_are_refused() -> None:
    for bad in (b"zz\r\n", b"-5\r\n", b"1" * 300):
        with pytest.raises(ProtocolError):
            ChunkedDecoder().feed(bad)


def test_heads() -> None:
    head = parse_head(b"HTTP/1.1 200 OK\r\nContent-Type: text/event-stream\r\nX: a:b")
    assert head.status == 200
    assert head.fields == {"content-type": "text/event-stream", "x": "a:b"}
    with pytest.raises(ProtocolError):
        parse_head(b"SSH-2.0-dropbear")
