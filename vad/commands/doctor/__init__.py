"""`vad doctor`: what is wrong on this hub, and what to do about it. A check is a function in CHECKS."""

from __future__ import annotations

import asyncio
from contextlib import nullcontext
from dataclasses import asdict, replace
from typing import Annotated

import typer
from rich.table import Table
from rich.text import Text

from vad.bus.session import local_endpoints
from vad.client import VadClient
from vad.commands.console import EXIT_NOTHING, JsonOption, err, out, print_json, reported_errors
from vad.commands.doctor.hub import (
    check_certificates,
    check_clock,
    check_daemon,
    check_settings,
    check_state_dir,
)
from vad.commands.doctor.identity import service_identity
from vad.commands.doctor.network import check_access_point, check_leases, check_mqtt
from vad.commands.doctor.network_model import check_model, check_processor
from vad.commands.doctor.radio import check_card, check_connector, check_csi, check_rights
from vad.commands.doctor.robot import check_floor_plan, check_robot, check_router, check_serial_port
from vad.commands.doctor.sight import check_camera
from vad.commands.doctor.visit import Check, Finding, Verdict, Visit
from vad.commands.run import DEFAULT_CONFIG, ConfigOption
from vad.config import load_settings
from vad.errors import ConfigError, VadError
from vad.report.words import printable

_MARKS: dict[Verdict, tuple[str, str]] = {
    "ok": ("✓", "green"),
    "warning": ("!", "yellow"),
    "bad": ("✗", "red"),
}

CHECKS: dict[str, tuple[Check, ...]] = {
    "settings": (check_settings,),
    "daemon": (check_daemon,),
    "disk": (check_state_dir,),
    "clock": (check_clock,),
    "certificates": (check_certificates,),
    "processor": (check_model, check_processor),
    "map": (check_floor_plan,),
    "robot": (check_serial_port, check_router, check_robot),
    "camera": (check_camera,),
    "radio": (check_rights, check_connector, check_card, check_csi),
    "devices": (check_access_point, check_leases),
    "mqtt": (check_mqtt,),
}
"""By the names that --only takes, in the order of the table."""
ALONE = "processor"
"""Measured while nothing else is going on."""


def doctor(
    config: ConfigOption = DEFAULT_CONFIG,
    listen_s: Annotated[
        float,
        typer.Option(
            "--listen", min=0.1, metavar="SECONDS", help="How long to listen to robot, camera, card."
        ),
    ] = 5.0,
    only: Annotated[
        list[str] | None,
        typer.Option(
            "--only", metavar="NAME", help=f"Check this only (may be repeated): {', '.join(CHECKS)}."
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Find out what is wrong on this hub, and what mends it.

    Robot, camera and card are opened where no daemon runs; where one does, it is asked about them. As root it
    also tells whether the service's user may use what it needs.

    Example:  sudo vad doctor
              vad doctor --only camera --only robot

    Exit code 0: nothing is wrong (there may be advice); 1: something is; 2: the settings cannot be used.
    """
    with reported_errors():
        wanted = _wanted(only)
        visit = Visit(load_settings(config), config.resolve(), listen_s)
        visit = replace(visit, service=service_identity(visit.root))
        waiting = nullcontext() if as_json or not err.is_terminal else err.status("looking and listening ...")
        with waiting:
            findings = asyncio.run(examine(visit, wanted))
    if as_json:
        print_json([asdict(finding) for finding in findings])
    else:
        out.print(_table(findings))
        out.print(_summary(findings))
    if any(finding.verdict == "bad" for finding in findings):
        raise typer.Exit(EXIT_NOTHING)


def _wanted(only: list[str] | None) -> list[str]:
    if unknown := set(only or ()) - set(CHECKS):
        raise ConfigError(
            f"there is no check called {sorted(unknown)[0]}",
            where="--only",
            remedy=f"There are {', '.join(CHECKS)}",
        )
    return [name for name in CHECKS if not only or name in only]


async def examine(visit: Visit, wanted: list[str]) -> list[Finding]:
    """The findings of these checks, in the table's order; those that listen do so at the same time."""
    if visit.status is None:
        visit = await asyncio.to_thread(_ask_daemon, visit)
    found: dict[str, list[Finding]] = {}

    async def look(name: str) -> None:
        findings = found[name] = []
        for check in CHECKS[name]:
            try:
                findings += await check(visit)
            except PermissionError as error:
                what = f"{error.filename} may not be looked at by you"
                findings.append(Finding(name, "warning", what, "sudo vad doctor"))

    if ALONE in wanted:
        await look(ALONE)
    async with asyncio.TaskGroup() as group:
        for name in wanted:
            if name != ALONE:
                group.create_task(look(name))
    return [finding for name in wanted for finding in found[name]]


def _ask_daemon(visit: Visit) -> Visit:
    """With the status of the daemon that runs, if one does."""
    for endpoint in local_endpoints(visit.settings.bus.listen):
        try:
            with VadClient(endpoint, visit.settings.hub) as client:
                return replace(visit, status=client.status())
        except VadError:
            continue
    return visit


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


def _summary(findings: list[Finding]) -> Text:
    bad = sum(finding.verdict == "bad" for finding in findings)
    advice = sum(finding.verdict == "warning" for finding in findings)
    said = "nothing is wrong" if not bad else "one thing is wrong" if bad == 1 else f"{bad} things are wrong"
    return Text(f"{said}{f', {advice} to think about' if advice else ''}", style="red" if bad else "green")
