"""Robots on the network: Valetudo by multicast DNS, zenoh routers by scouting; and whether one answers."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
import time

import zenoh

from vad.errors import VadError
from vad.robot.pose import RobotPose
from vad.robot.valetudo_source import ValetudoSource
from vad.streams import DropOldestQueue

MDNS = ("224.0.0.251", 5353)
SERVICE = ("_valetudo", "_tcp", "local")
_IS_RESPONSE = 0x8000
_PTR, _IN, _UNICAST = 12, 1, 0x8000
_POLL_S = 0.05


def mdns_question(service: tuple[str, ...] = SERVICE) -> bytes:
    """A question for who offers the service, to be answered to whom asked (RFC 6762, 5.4)."""
    return struct.pack(">6H", 0, 0, 1, 0, 0, 0) + _name(service) + struct.pack(">HH", _PTR, _IN | _UNICAST)


def is_mdns_answer(data: bytes, service: tuple[str, ...] = SERVICE) -> bool:
    """Whether a datagram is a response that has something to say of the service."""
    if len(data) < 12:
        return False
    _, flags, _, answers, _, _ = struct.unpack_from(">6H", data)
    # The first mention of a name is never compressed.
    return bool(flags & _IS_RESPONSE and answers and _name(service)[:-1].lower() in data.lower())


def _name(labels: tuple[str, ...]) -> bytes:
    return b"".join(bytes([len(label)]) + label.encode() for label in labels) + b"\0"


def find_valetudo(seconds: float, *, to: tuple[str, int] = MDNS) -> list[str]:
    """Addresses of robots with Valetudo that answer within `seconds`."""
    found: set[str] = set()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        for index, _ in socket.if_nameindex():
            # Every network of the hub: its own access point's, too. Some take no multicast.
            with contextlib.suppress(OSError):
                sock.setsockopt(
                    socket.IPPROTO_IP, socket.IP_MULTICAST_IF, struct.pack("=4s4si", b"", b"", index)
                )
                sock.sendto(mdns_question(), to)
        until_s = time.monotonic() + seconds
        while (left_s := until_s - time.monotonic()) > 0:
            sock.settimeout(left_s)
            try:
                data, (address, _) = sock.recvfrom(9000)
            except TimeoutError:
                break
            if is_mdns_answer(data):
                found.add(address)
    return sorted(found)


def find_routers(seconds: float) -> list[str]:
    """Endpoints of zenoh routers that answer within `seconds`, one for each."""
    try:
        scout = zenoh.scout(what="router")
    except zenoh.ZError:
        return []
    try:
        time.sleep(seconds)
        found = {}
        while (hello := scout.try_recv()) is not None:
            endpoints = sorted(str(locator) for locator in hello.locators)
            tcp = [one for one in endpoints if one.startswith("tcp/") and "[" not in one]
            if tcp:
                found[str(hello.zid)] = tcp[0]
        return sorted(found.values())
    finally:
        scout.stop()  # type: ignore[no-untyped-call]


async def hear_valetudo(url: str, seconds: float) -> tuple[bool, str]:
    """Whether a robot's map comes from there, and in words what came or what is wrong."""
    poses: DropOldestQueue[RobotPose] = DropOldestQueue(4)
    try:
        robot = ValetudoSource(url, epoch=1)
    except VadError as error:
        return False, str(error)
    async with asyncio.TaskGroup() as group:
        task = group.create_task(robot.run(poses))
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s and not robot.health.counters["maps"] and not robot.health.detail:  # noqa: ASYNC110 - the counters have no event
            await asyncio.sleep(_POLL_S)
        task.cancel()
    if robot.health.counters["maps"]:
        return True, robot.health.detail or "its map comes"
    return False, robot.health.detail or f"no map in {seconds:g} s"


async def hear_router(endpoint: str, seconds: float) -> tuple[bool, str]:
    """Whether something listens at a tcp/host:port, and in words what is wrong."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    try:
        async with asyncio.timeout(seconds):
            _, writer = await asyncio.open_connection(host.strip("[]"), int(port))
    except TimeoutError:
        return False, f"{endpoint} is silent"
    except (OSError, ValueError) as error:
        return False, f"{endpoint}: {error}"
    writer.close()
    with contextlib.suppress(OSError):
        await writer.wait_closed()
    return True, "it answers"
