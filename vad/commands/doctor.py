"""`vad doctor`: what is wrong on this hub, and what to do about it. A check is a function in CHECKS."""

from __future__ import annotations

import asyncio
import grp
import time
from collections.abc import Awaitable, Callable
from dataclasses import asdict, dataclass
from os import R_OK, W_OK, access
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.table import Table
from rich.text import Text

from vad.commands.console import EXIT_NOTHING, JsonOption, out, print_json, reported_errors
from vad.commands.robot import running_robot
from vad.commands.run import DEFAULT_CONFIG, ConfigOption
from vad.config import Ros2Robot, Settings, load_settings, pki_folder, resolve
from vad.errors import VadError
from vad.pki.certificates import days_left, utc_now
from vad.pki.folder import PkiFolder
from vad.report.words import printable
from vad.robot.map_server import load_floor_plan, load_rooms
from vad.robot.pose import MapSource, RobotPose
from vad.streams import DropOldestQueue

Verdict = Literal["ok", "warning", "bad"]
_MARKS: dict[Verdict, tuple[str, str]] = {
    "ok": ("✓", "green"),
    "warning": ("!", "yellow"),
    "bad": ("✗", "red"),
}


@dataclass(frozen=True, slots=True)
class Finding:
    """What one check found; the remedy where something is wrong."""

    check: str
    verdict: Verdict
    text: str
    remedy: str = ""


@dataclass(frozen=True, slots=True)
class Visit:
    """What every check is given. listen_s: how long it may listen to hardware."""

    settings: Settings
    config_file: Path
    listen_s: float


Check = Callable[[Visit], Awaitable[list[Finding]]]


def _port_findings(visit: Visit) -> list[Finding]:
    """Whether the robot's port exists and may be opened."""
    port = getattr(visit.settings.robot, "port", "")
    if not port or "://" in port:
        return []
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
    return [Finding("serial port", "ok", f"{port} may be opened")]


async def check_serial_port(visit: Visit) -> list[Finding]:
    """Whether the robot's port exists and may be opened."""
    return _port_findings(visit)


async def check_floor_plan(visit: Visit) -> list[Finding]:
    """Whether the floor plan's files can be read."""
    settings = visit.settings.map
    findings = []
    try:
        if settings.file is not None:
            plan = load_floor_plan(resolve(settings.file, visit.config_file), epoch=settings.epoch)
            x0, y0, x1, y1 = plan.bounds_m
            told = f"{x1 - x0:.1f} m x {y1 - y0:.1f} m, {len(plan.rooms)} rooms"
            findings.append(Finding("floor plan", "ok", f"{settings.file}: {told}"))
        if settings.rooms is not None:
            count = len(load_rooms(resolve(settings.rooms, visit.config_file)))
            findings.append(Finding("rooms", "ok", f"{settings.rooms}: {count} rooms"))
    except VadError as error:
        findings.append(Finding("floor plan", "bad", f"{error.where}: {error.what}", error.remedy))
    return findings


async def check_router(visit: Visit) -> list[Finding]:
    """Whether a robot's zenoh router answers."""
    robot = visit.settings.robot
    if not isinstance(robot, Ros2Robot) or robot.endpoint is None:
        return []
    host, _, port = robot.endpoint.partition("/")[2].rpartition(":")
    try:
        async with asyncio.timeout(visit.listen_s):
            _, writer = await asyncio.open_connection(host.strip("[]"), int(port))
        writer.close()
    except (OSError, ValueError, TimeoutError) as error:
        why = "does not answer" if isinstance(error, TimeoutError) else str(error)
        remedy = "Is the robot on, and `ros2 run rmw_zenoh_cpp rmw_zenohd` running on it?"
        return [Finding("zenoh router", "bad", f"{robot.endpoint}: {why}", remedy)]
    return [Finding("zenoh router", "ok", f"{robot.endpoint} answers")]


async def check_robot(visit: Visit) -> list[Finding]:
    """Whether poses come, and the map where the robot is to bring it."""
    poses: DropOldestQueue[RobotPose] = DropOldestQueue(256)
    wants_map = visit.settings.map.file is None
    until_s = time.monotonic() + visit.listen_s
    async with running_robot(visit.settings, poses) as robot:
        while time.monotonic() < until_s and not (  # noqa: ASYNC110 - the counters have no event
            poses.accepted and (not wants_map or robot.health.counters["maps"])
        ):
            await asyncio.sleep(0.05)
        health = robot.health
        if poses.accepted:
            found = [Finding("robot", "ok", f"{poses.accepted} poses; {health.detail or robot.status}")]
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


async def check_certificates(visit: Visit) -> list[Finding]:
    """Whether clients on the network can be let in, where the settings listen there."""
    if not any(endpoint.startswith("tls/") for endpoint in visit.settings.bus.listen):
        return []
    now = utc_now()
    try:
        files = PkiFolder(pki_folder(visit.settings, visit.config_file)).hub_files()
    except VadError as error:
        return [Finding("certificates", "bad", f"{error.where}: {error.what}", error.remedy)]
    days = days_left(files.ends_at, now)
    count = len(files.register.in_force(now))
    told = f"{count} in force; the hub's ends in {days:.0f} days"
    if days <= 0:
        return [Finding("certificates", "bad", told, "Is the clock right? If so: `vad pki rotate hub`")]
    if not count:
        return [Finding("certificates", "warning", told, "`vad pki issue viewer NAME` lets somebody in")]
    return [Finding("certificates", "ok", told)]


CHECKS: tuple[Check, ...] = (
    check_floor_plan,
    check_certificates,
    check_serial_port,
    check_router,
    check_robot,
)


def doctor(
    config: ConfigOption = DEFAULT_CONFIG,
    listen_s: Annotated[
        float, typer.Option("--listen", min=0.1, metavar="SECONDS", help="How long to listen to the robot.")
    ] = 5.0,
    as_json: JsonOption = False,
) -> None:
    """Find out what is wrong on this hub, with the daemon stopped.

    Example:  vad doctor --config vad.yaml

    Exit code 0: nothing is; 1: something is; 2: the settings cannot be used.
    """
    with reported_errors():
        settings = load_settings(config)
        findings = asyncio.run(_visit(Visit(settings, config.resolve(), listen_s)))
    if as_json:
        print_json([asdict(finding) for finding in findings])
    else:
        out.print(_table(findings))
    if any(finding.verdict == "bad" for finding in findings):
        raise typer.Exit(EXIT_NOTHING)


async def _visit(visit: Visit) -> list[Finding]:
    findings: list[Finding] = []
    for check in CHECKS:
        findings += await check(visit)
    return findings


def _table(findings: list[Finding]) -> Table:
    table = Table(box=None, show_header=False, pad_edge=False)
    for _ in range(2):
        table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for finding in findings:
        mark, style = _MARKS[finding.verdict]
        text = Text(printable(finding.text))
        if finding.remedy:
            text.append(f"\n→ {printable(finding.remedy)}", style="dim")
        table.add_row(Text(mark, style=style), Text(finding.check, style="bold"), text)
    return table
