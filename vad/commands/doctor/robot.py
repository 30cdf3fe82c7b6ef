"""The robot: its port, its floor plan, its router, its poses."""

from __future__ import annotations

import asyncio
import grp
import time
from os import R_OK, W_OK, access
from pathlib import Path

from vad.commands.doctor.visit import Finding, Visit
from vad.commands.robot import Watched, running_robot
from vad.config import NeatoRobot, Ros2Robot
from vad.errors import VadError
from vad.robot.map_server import load_floor_plan, load_rooms
from vad.robot.pose import MapSource, RobotPose
from vad.streams import DropOldestQueue

RATE_S = 2.0
"""How long poses are counted after the first one."""


async def check_serial_port(visit: Visit) -> list[Finding]:
    """Whether the robot's port exists and may be opened."""
    port = getattr(visit.settings.robot, "port", "")
    if not port or "://" in port or visit.part("robot") is not None:
        return []
    return _port(visit, port)


def _port(visit: Visit, port: str) -> list[Finding]:
    path = Path(port)
    if not path.exists():
        return [Finding("serial port", "bad", f"{port} does not exist", "Plug it in; see /dev/serial/by-id")]
    if not access(path, R_OK | W_OK):
        try:
            group = grp.getgrgid(path.stat().st_gid).gr_name
        except KeyError:
            group = "dialout"
        remedy = f"sudo usermod -aG {group} $USER, then log in again"
        return [Finding("serial port", "bad", f"{port} may not be read and written", remedy)]
    refused = visit.refused("serial port", path, "rw")
    return refused or [Finding("serial port", "ok", f"{port} may be opened")]


async def check_floor_plan(visit: Visit) -> list[Finding]:
    """Whether the floor plan's files can be read."""
    settings = visit.settings.map
    findings = []
    try:
        if settings.file is not None:
            plan = load_floor_plan(visit.resolve(settings.file), epoch=settings.epoch)
            x0, y0, x1, y1 = plan.bounds_m
            told = f"{x1 - x0:.1f} m x {y1 - y0:.1f} m, {len(plan.rooms)} rooms"
            findings.append(Finding("floor plan", "ok", f"{settings.file}: {told}"))
        if settings.rooms is not None:
            count = len(load_rooms(visit.resolve(settings.rooms)))
            findings.append(Finding("rooms", "ok", f"{settings.rooms}: {count} rooms"))
    except VadError as error:
        findings.append(Finding.of_error("floor plan", error))
    return findings


async def check_router(visit: Visit) -> list[Finding]:
    """Whether a robot's zenoh router, and those that the bus is to connect to, answer."""
    robot = visit.settings.robot
    findings = []
    if isinstance(robot, Ros2Robot) and robot.endpoint is not None:
        remedy = "Is the robot on, and `ros2 run rmw_zenoh_cpp rmw_zenohd` running on it?"
        findings.append(await _router(robot.endpoint, visit.listen_s, remedy))
    for endpoint in visit.settings.bus.connect:
        remedy = "Does that router run? Else take it out of bus: connect:"
        findings.append(await _router(endpoint, visit.listen_s, remedy))
    return findings


async def _router(endpoint: str, patience_s: float, remedy: str) -> Finding:
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    try:
        async with asyncio.timeout(patience_s):
            _, writer = await asyncio.open_connection(host.strip("[]"), int(port))
        writer.close()
    except (OSError, ValueError, TimeoutError) as error:
        why = "does not answer" if isinstance(error, TimeoutError) else str(error)
        return Finding("zenoh router", "bad", f"{endpoint}: {why}", remedy)
    return Finding("zenoh router", "ok", f"{endpoint} answers")


async def check_robot(visit: Visit) -> list[Finding]:
    """Whether poses come and how often, and the map where the robot is to bring it."""
    if (part := visit.part("robot")) is not None:
        if part.state != "ok":
            return [Finding.of_health("robot", part)]
        daemon = visit.part("daemon")
        rate = 0.0 if daemon is None else daemon.rates_per_s.get("poses", 0.0)
        return [Finding("robot", "ok", f"{rate:g} poses a second; {part.detail}")]
    if any(finding.verdict == "bad" for finding in await check_serial_port(visit)):
        return []  # what is wrong is said, and the same once more would not help
    poses: DropOldestQueue[RobotPose] = DropOldestQueue(256)
    wants_map = visit.settings.map.file is None
    watched = Watched()
    first_s = 0.0
    async with running_robot(visit.settings, poses) as robot:
        health = robot.health
        until_s = time.monotonic() + visit.listen_s
        while (now_s := time.monotonic()) < until_s:
            for pose in poses.drain():
                watched.take(pose, time.monotonic_ns())
                first_s = first_s or now_s
            counted = watched.count and now_s - first_s >= min(RATE_S, visit.listen_s / 2)
            if counted and (not wants_map or health.counters["maps"]):
                break
            await asyncio.sleep(0.05)
        if watched.count:
            found = [_poses(visit, watched, health.detail or robot.status)]
        else:
            said = health.detail or f"no pose in {visit.listen_s:g} s"
            what, _, remedy = said.partition(". ")
            found = [Finding("robot", "bad", what, remedy or "See `vad robot watch`")]
        if wants_map and isinstance(robot, MapSource):
            if health.counters["maps"]:
                found.append(Finding("robot's map", "ok", "it comes"))
            else:
                remedy = "Does the robot have a map yet? Let it clean once, or name a file in map: file:"
                found.append(Finding("robot's map", "bad", f"none came in {visit.listen_s:g} s", remedy))
        return found


def _poses(visit: Visit, watched: Watched, detail: str) -> Finding:
    rate = watched.rate_hz(time.monotonic())
    told = f"{rate:.1f} poses a second; {detail}" if watched.count > 1 else f"a pose came; {detail}"
    robot = visit.settings.robot
    if isinstance(robot, NeatoRobot) and rate < 0.5 * robot.rate_hz:
        what = f"{told}; {robot.rate_hz:g} were asked for"
        return Finding(
            "robot", "warning", what, "A serial bridge over Wi-Fi may be slow: set robot: rate_hz: lower"
        )
    return Finding("robot", "ok", told)
