#!/usr/bin/env python3
"""Feeds mutated messages to everything that reads the bus; any exception but the reader's own is a bug.

First each reader by itself, then a live hub: its robots' keys and its queryables, over zenoh, as fast as it
goes. Prints what was taken and refused, and by how much memory grew. Exit code 1: something failed.

Usage: tools/fuzz_bus.py [INPUTS] [SEED] [--live INPUTS]
"""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import random
import resource
import socket
import sys
import time
import zlib
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "robot"))
import ros2_messages as ros  # the tests write ROS messages field by field

from vad.agent import frames
from vad.agent.info import AgentInfo, decode_info, encode_info
from vad.bus import messages as m
from vad.bus import selectors as s
from vad.bus.audit import AuditReader
from vad.bus.grid import grid_to_png, heatmap_to_npy, npy_to_heatmap, png_to_grid
from vad.bus.node import Bus
from vad.bus.session import BusSettings, open_session
from vad.client.questions import decoded
from vad.errors import VadError
from vad.robot.json_source import pose_from_json, report_from_json
from vad.robot.ros2 import Frames, Ros2Reader
from vad.robot.ros2_source import Ros2Source, Ros2Topics
from vad.robot.valetudo import map_from_payload
from vad.robot.valetudo_source import ValetudoSource
from vad.robot.zenoh_source import ZenohPoseSource
from vad.streams import DropOldestQueue

MAC = "aa:bb:cc:dd:ee:01"
BYTES = (0, 1, 0x22, 0x2C, 0x3B, 0x5B, 0x5D, 0x7B, 0x7D, 0x7F, 0x80, 0xC3, 0xFF)
PIECES = (
    b"[" * 3000,
    b'{"a":' * 700,
    b"1e999",
    b"-1e-999",
    b"NaN",
    b"9" * 400,
    b"\\ud800",
    b"\xff\xfe",
    b'"' * 3,
    b"null",
    b"\0" * 16,
    b"%" * 50,
    b"%ff%00",
    b"|" * 300,
    b"x" * 5000,
)


@dataclass(frozen=True, slots=True)
class Target:
    """A reader: what it is given, and sound inputs to begin with. Its own refusals are VadErrors."""

    name: str
    read: Callable[[bytes], object]
    seeds: tuple[bytes, ...]


def targets() -> list[Target]:
    """Everything that reads bytes or text off the bus."""
    reader = Ros2Reader(Frames("map", ("base_footprint", "base_link")), 1)
    audit = AuditReader()
    heat = m.heatmap_message(
        np.ones((3, 4)), source="live", mac=MAC, epoch=1, bounds_m=(0, 0, 4, 3), step_m=1.0
    )

    def heatmap(data: bytes) -> object:
        return m.probabilities(decoded(data, m.HeatmapMessage, "fuzz"))

    def text(read: Callable[[str], object]) -> Callable[[bytes], object]:
        return lambda data: read(data.decode("utf-8", "replace"))

    found = [
        Target("robot JSON status", lambda d: report_from_json(d, 10**10, 1), JSON_POSES),
        Target("robot JSON pose", lambda d: pose_from_json(d, 10**10, 1), JSON_POSES),
        Target("Valetudo map", lambda d: map_from_payload(d, 1), VALETUDO),
        Target("Valetudo map, deflated", lambda d: map_from_payload(zlib.compress(d, 1), 1), VALETUDO[:1]),
        Target("ROS tf", lambda d: reader.pose("tf", d, 10**10), (ros_tf(),)),
        Target("ROS tf_static", lambda d: reader.pose("tf_static", d, 10**10), (ros_tf(),)),
        Target("ROS odometry", lambda d: reader.pose("odometry", d, 10**10), ROS_ANY),
        Target("ROS pose", lambda d: reader.pose("pose", d, 10**10), ROS_ANY),
        Target("ROS AMCL pose", lambda d: reader.pose("pose_covariance", d, 10**10), ROS_ANY),
        Target("ROS map", reader.floor_plan, ROS_ANY),
        Target("selector of devices", text(s.parse_device_question), SELECTORS),
        Target("selector of heatmaps", text(s.parse_heatmap_format), SELECTORS),
        Target("selector of events", text(s.parse_event_question), SELECTORS),
        Target("selector of the past", text(s.parse_history_question), SELECTORS),
        Target("no selector", text(s.require_no_selector), SELECTORS),
        Target("agent's description", decode_info, (AGENT_INFO,)),
        Target("agent's frame", frames.decode_frame, (AGENT_FRAME,)),
        Target("agent's command", frames.decode_command, (b'{"type":"Ack","stream":1,"next_seq":2}',)),
        Target("agent's time", frames.decode_time, (b'{"monotonic_ns":1,"boot":"x"}',)),
        Target("wish", lambda d: decoded(d, m.DeviceWish, "fuzz"), WISHES),
        Target("client: heatmap", heatmap, (m.encode(heat),)),
        Target("client: grid", png_to_grid, (grid_to_png(np.zeros((5, 6), np.int8)),)),
        Target("client: array", npy_to_heatmap, (heatmap_to_npy(np.ones((3, 4), np.float32)),)),
        Target("gate's log", text(audit.read), LOG_LINES),
    ]
    for kind, example in CLIENT_MESSAGES:
        read = _client_reader(kind)
        found.append(Target(f"client: {m.schema_id(kind)}", read, (m.encode(example),)))
    return found


def _client_reader(kind: type[m.Message]) -> Callable[[bytes], object]:
    return lambda data: decoded(data, kind, "fuzz")


JSON_POSES = (
    b'{"x_m": 1.2, "y_m": -0.4, "yaw_rad": 1.57}',
    b'{"x_m":1,"y_m":2,"yaw_rad":0,"sigma_m":0.1,"sigma_yaw_rad":0.1,"t_ns":9999999999,"status":"docked"}',
    b'{"status": "lost", "more": [1, {"a": "b"}]}',
)
_MAP: dict[str, Any] = {
    "__class": "ValetudoMap",
    "size": {"x": 300, "y": 200},
    "pixelSize": 5,
    "metaData": {"nonce": "n"},
    "layers": [
        {"type": "floor", "compressedPixels": [10, 10, 20, 10, 11, 20, 10, 12, 20]},
        {"type": "segment", "pixels": [30, 20, 31, 20], "metaData": {"name": "Hall", "segmentId": 1}},
        {"type": "wall", "compressedPixels": [9, 9, 22]},
    ],
    "entities": [
        {"type": "robot_position", "points": [80, 60], "metaData": {"angle": 90}},
        {"type": "charger_location", "points": [80, 60]},
    ],
}
VALETUDO = (json.dumps(_MAP).encode(), zlib.compress(json.dumps(_MAP).encode()))
SELECTORS = (
    b"room=Kitchen|Living%20room;state=mapped|stale;max_sigma_m=0.5",
    b"mac=aa:bb:cc:dd:ee:01;bbox=0,0,3.5,4;format=geojson;since=2026-01-01T00:00:00Z",
    b"at=2026-01-01T00:00:00.000Z;_anyke",
    b"since=2026-01-01;until=2026-02-01;limit=100",
    b"",
)
WISHES = (m.encode(m.DeviceWish(mac=MAC, name="lamp")), m.encode(m.DeviceWish(mac=MAC, forget=True)))
AGENT_INFO = encode_info(AgentInfo(id="node", mac=MAC))
AGENT_FRAME = frames.encode_frame(
    frames.Frame(
        version=frames.VERSION,
        stream=1,
        seq=2,
        oldest=1,
        before=3,
        given_up=0,
        offset_ns=-5,
        error_ns=20,
        mac=MAC,
        carrier_hz=5.2e9,
        bandwidth_mhz=20,
        arrival_ns=bytes(16),
        raw=bytes(100),
    )
)
LOG_LINES = (
    b"2026-11-22T03:39:07.139651Z TRACE  rx-1 ThreadId(09) demux{zid=a}: zenoh::net::routing::interceptor::"
    b"access_control: a99760b on Interface(lo)+CertCommonName(viewer.t.1)+Transport(Tls)+a99760b is "
    b"unauthorized to Put (ingress) on vad/home/x",
    b"2026-11-22T03:39:10.962758Z  WARN acc-0 ThreadId(05) zenoh_link_tls::unicast: invalid peer "
    b"certificate: UnknownIssuer. Hint: increase the system open file limit.",
    b"T TRACE ThreadId(09) zenoh::access_control: ACL (ingress): caching permissions for `vad/home` ...",
)
CLIENT_MESSAGES: tuple[tuple[type[m.Message], m.Message], ...] = (
    (m.DeviceMessage, m.DeviceMessage(source="live", mac=MAC, state="mapped", x_m=1.0, y_m=2.0)),
    (m.CameraMessage, m.CameraMessage(source="live", id="main", state="valid")),
    (m.StatusMessage, m.StatusMessage(source="live", version="1", uptime_s=1.0)),
    (m.EventMessage, m.EventMessage(source="live", kind="joined", mac=MAC, text="joined")),
    (m.CaptureMessage, m.CaptureMessage(source="live", session="s", mac=MAC, state="done")),
)


def ros_tf() -> bytes:
    """The robot at (1, 2)."""
    return ros.tf(("map", "odom", 1.0, 2.0, 0.0), ("odom", "base_link", 0.0, 0.0, 0.1), stamp_ns=10**9)


ROS_ANY = (
    ros.pose_stamped(1.0, 2.0, 0.3, stamp_ns=10**9),
    ros.with_covariance(1.0, 2.0, 0.3, stamp_ns=10**9),
    ros.odometry(1.0, 2.0, 0.3, stamp_ns=10**9),
    ros.grid(np.zeros((3, 4), np.int8)),
)


def mutate(seed: bytes, rng: random.Random) -> bytes:
    """A few bytes changed; a piece cut out, doubled, put in or cut off."""
    mutated = bytearray(seed)
    for _ in range(rng.randrange(0, 6)):
        if mutated:
            mutated[rng.randrange(len(mutated))] = rng.choice((*BYTES, rng.randrange(256)))
    start = rng.randrange(len(mutated) + 1)
    end = start + rng.randrange(40)
    kind = rng.randrange(8)
    if kind == 0:
        del mutated[start:end]
    elif kind == 1:
        mutated[start:start] = mutated[start:end] * rng.randrange(1, 30)
    elif kind == 2:
        mutated[start:start] = rng.choice(PIECES)
    elif kind == 3:
        del mutated[start:]
    return bytes(mutated)


def rss_kib() -> int:
    """Memory in use now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() // 1024


def fuzz_readers(inputs: int, rng: random.Random) -> bool:
    """Each reader with `inputs` mutations; whether all held."""
    fine = True
    print(f"{'reader':28} {'taken':>8} {'refused':>8} {'slowest ms':>10} {'memory KiB':>10}")
    for target in targets():
        taken = refused = 0
        slowest_s, warm_kib = 0.0, 0
        for i in range(inputs):
            data = mutate(rng.choice(target.seeds), rng)
            began = time.perf_counter()
            try:
                target.read(data)
                taken += 1
            except VadError:
                refused += 1
            except Exception as error:  # noqa: BLE001 - any other is what is looked for
                fine = False
                print(f"{target.name}: {type(error).__name__}: {str(error)[:200]}\n  {data[:300]!r}")
                break
            slowest_s = max(slowest_s, time.perf_counter() - began)
            if i == inputs // 10:
                warm_kib = rss_kib()
        grown = rss_kib() - warm_kib
        print(f"{target.name:28} {taken:8} {refused:8} {slowest_s * 1e3:10.1f} {grown:10}")
    return fine


async def fuzz_live(inputs: int, rng: random.Random) -> bool:
    """`inputs` messages on each key a hub subscribes to, and as many questions; whether it held."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    fine = True
    async with Bus(BusSettings(listen=(endpoint,))) as bus:
        bus.publish_device(m.DeviceMessage(source="live", mac=MAC, state="mapped", x_m=1.0, y_m=2.0))
        robots = (
            ZenohPoseSource(bus.session, "robot/pose", epoch=1),
            ValetudoSource(bus.session, "robot/map", epoch=1),
            Ros2Source(bus.session, Ros2Topics(styles=("bridge",)), epoch=1),
        )
        sinks: list[DropOldestQueue[Any]] = [DropOldestQueue(8) for _ in robots]
        tasks = [asyncio.create_task(r.run(q)) for r, q in zip(robots, sinks, strict=True)]
        client = await asyncio.to_thread(open_session, BusSettings(mode="client", connect=(endpoint,)))
        seeds = {"robot/pose": JSON_POSES, "robot/map": VALETUDO, "tf": (ros_tf(),), "map": ROS_ANY}
        warm_kib = 0
        for part in range(10):
            await asyncio.to_thread(_put, client, seeds, inputs // 10, rng)
            await asyncio.to_thread(_ask, client, inputs // 10, rng)
            if part == 2:
                warm_kib = rss_kib()
        await asyncio.sleep(1.0)
        grown = rss_kib() - warm_kib
        for name, task in zip(("JSON robot", "Valetudo", "ROS 2"), tasks, strict=True):
            if task.done():
                fine = False
                print(f"{name} ended: {task.exception()!r}")
            task.cancel()
        for robot in robots:
            print(f"live {robot.health.part:23} {_told(robot.health.counters)}")
        print(f"live {'questions':23} {_told(bus.health.counters)}")
        print(f"live {'memory':23} {grown} KiB more after the first three tenths")
        fine = fine and not bus.health.counters["failed"] and grown < 40_000
        await asyncio.gather(*tasks, return_exceptions=True)
        await asyncio.to_thread(client.close)
    return fine


def _put(client: zenoh.Session, seeds: dict[str, tuple[bytes, ...]], count: int, rng: random.Random) -> None:
    for _ in range(count):
        for key, sound in seeds.items():
            client.put(key, mutate(rng.choice(sound), rng), congestion_control=zenoh.CongestionControl.BLOCK)


def _ask(client: zenoh.Session, count: int, rng: random.Random) -> None:
    keys = ("devices/*", "devices", f"devices/{MAC}/heatmap", "events", "status", f"devices/{MAC}/history")
    for _ in range(count):
        text = mutate(rng.choice(SELECTORS), rng).decode("utf-8", "replace")
        with suppress(zenoh.ZError):  # refused by our own side of zenoh: no such selector exists
            list(client.get(f"vad/home/{rng.choice(keys)}?{text.replace('#', '')}", timeout=5.0))


def _told(counters: Counter[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in sorted(counters.items()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("inputs", nargs="?", type=int, default=100_000, help="for each reader")
    parser.add_argument("seed", nargs="?", type=int, default=0)
    parser.add_argument("--live", type=int, default=100_000, metavar="INPUTS", help="for each key")
    given = parser.parse_args()
    logging.basicConfig(level=logging.ERROR)
    rng = random.Random(given.seed)
    held = fuzz_readers(given.inputs, rng)
    if given.live:
        held = asyncio.run(fuzz_live(given.live, rng)) and held
    sys.exit(0 if held else 1)


if __name__ == "__main__":
    main()
