"""`vad devices`: every device the daemon knows, where it is and how sure that is."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypedDict

import msgspec
import typer
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from vad.bus.messages import DeviceMessage, Point
from vad.bus.selectors import STATES, Bbox
from vad.client import VadClient
from vad.commands.console import (
    ANY_HUB,
    ENDPOINT,
    EXIT_NOTHING,
    EndpointOption,
    HubOption,
    JsonOption,
    WatchOption,
    complain,
    out,
    print_json,
    reported_errors,
    watch,
    watch_json,
)
from vad.errors import VadError
from vad.mac import normal_mac
from vad.report.words import metres, printable

STATE_STYLES = {
    "mapped": "bold green",
    "capturing": "bold cyan",
    "waiting": "yellow",
    "discovered": "yellow",
    "stale": "dim",
    "failed": "bold red",
}


class _Wanted(TypedDict):
    room: Sequence[str]
    state: Sequence[str]
    mac: Sequence[str]
    max_sigma_m: float | None
    since: str | None
    bbox: Bbox | None
    at: str | None


class _TruePlace(msgspec.Struct, frozen=True):
    x_m: float
    y_m: float


def devices(
    as_json: JsonOption = False,
    keep_watching: WatchOption = False,
    room: Annotated[list[str] | None, typer.Option(help="Only devices in this room (may repeat).")] = None,
    state: Annotated[
        list[str] | None, typer.Option(help=f"Only devices in this state (may repeat): {', '.join(STATES)}.")
    ] = None,
    max_sigma: Annotated[
        float | None, typer.Option(help="Only devices known at least this well: standard deviation, metres.")
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(
            help='Test data only: a JSON file {"aa:bb:..": {"x_m": 1.0, "y_m": 2.0}}; adds the true places '
            "and the errors.",
            metavar="FILE",
        ),
    ] = None,
    mac: Annotated[list[str] | None, typer.Option(help="Only this device (may repeat).")] = None,
    bbox: Annotated[
        str | None,
        typer.Option(help="Only devices placed in this box: metres of the map.", metavar="X0,Y0,X1,Y1"),
    ] = None,
    since: Annotated[
        str | None, typer.Option(help="Only devices that changed after this time (RFC 3339).", metavar="TIME")
    ] = None,
    at: Annotated[
        str | None, typer.Option(help="As they were at this time (RFC 3339).", metavar="TIME")
    ] = None,
    geojson: Annotated[
        bool,
        typer.Option("--geojson", help="A GeoJSON FeatureCollection; coordinates are metres of the map."),
    ] = False,
    endpoint: EndpointOption = ENDPOINT,
    hub: HubOption = ANY_HUB,
) -> None:
    """List the Wi-Fi devices of the home: place, 90 % radius, state, and why one waits.

    Example:  vad devices --room Kitchen --state mapped

    Example:  vad devices --at 2026-01-31T20:00:00+01:00

    Example:  vad devices --geojson > home.geojson

    Exit code 0: devices were found; 1: none; 2: an option cannot be used; 3: no daemon answers.
    """
    with reported_errors():
        places = {} if truth is None else read_truth(truth)
        wanted: _Wanted = {
            "room": room or (),
            "state": state or (),
            "mac": mac or (),
            "max_sigma_m": max_sigma,
            "since": since,
            "bbox": None if bbox is None else read_bbox(bbox),
            "at": at,
        }
        narrowed = any(value is not None and value != () for value in wanted.values())

        def ask(asked: VadClient) -> list[DeviceMessage]:
            return asked.devices(**wanted)

        if geojson and (keep_watching or truth is not None):
            raise VadError("--geojson goes neither with --watch nor with --truth")
        with VadClient(endpoint, hub) as client:
            if geojson:
                features = client.devices_geojson(**wanted)
                print_json(features)
                if not features["features"]:
                    raise typer.Exit(EXIT_NOTHING)
                return
            if keep_watching and as_json:
                watch_json(client, lambda c: [_as_json(device, places) for device in ask(c)])
                return
            if keep_watching:
                watch(client, lambda c: device_table(ask(c), places))
                return
            found = ask(client)
    if as_json:
        print_json([_as_json(device, places) for device in found])
    elif found:
        out.print(device_table(found, places))
    else:
        complain("no device fits" if narrowed else "no device is known yet")
    if not found:
        raise typer.Exit(EXIT_NOTHING)


def read_bbox(text: str) -> Bbox:
    """`x0,y0,x1,y1` as numbers; VadError for anything else."""
    try:
        x0, y0, x1, y1 = map(float, text.split(","))
    except ValueError:
        raise VadError("not a box", where=f"--bbox {text}", remedy="Write x0,y0,x1,y1 in metres") from None
    return x0, y0, x1, y1


def read_truth(path: Path) -> dict[str, Point]:
    """MAC -> true place from a JSON file; VadError where it cannot be read."""
    try:
        given = msgspec.json.decode(path.read_bytes(), type=dict[str, _TruePlace])
    except OSError as error:
        raise VadError(f"cannot be read: {error.strerror}", where=str(path)) from error
    except msgspec.DecodeError as error:
        raise VadError(
            str(error), where=str(path), remedy='Write {"aa:bb:..": {"x_m": 1, "y_m": 2}}'
        ) from error
    return {normal_mac(mac): (place.x_m, place.y_m) for mac, place in given.items()}


def device_table(found: Sequence[DeviceMessage], truth: Mapping[str, Point]) -> RenderableType:
    """The devices as a table; with true places their errors beside and the median below."""
    table = Table(header_style="bold", box=None, pad_edge=False)
    table.add_column("MAC", no_wrap=True)
    table.add_column("Name", overflow="fold")
    table.add_column("Room", overflow="fold")
    for name in ("x m", "y m", "±90 % m"):
        table.add_column(name, justify="right", no_wrap=True)
    if truth:
        for name in ("true x", "true y", "error m"):
            table.add_column(name, justify="right", no_wrap=True)
    table.add_column("State", no_wrap=True)
    table.add_column("Reason", overflow="fold", ratio=1)
    table.add_column("Source", no_wrap=True)
    errors = []
    for device in found:
        cells: list[str | Text] = [
            device.mac,
            Text(printable(device.name or "–")),
            Text(printable(device.room or "–")),
            metres(device.x_m),
            metres(device.y_m),
            metres(device.radius90_m, "±"),
        ]
        if truth:
            x_m, y_m = truth.get(device.mac, (None, None))
            error_m = _error_m(device, truth)
            cells += [metres(x_m), metres(y_m), metres(error_m)]
            errors += [] if error_m is None else [error_m]
        cells += [
            Text(device.state, style=STATE_STYLES[device.state]),
            Text(printable(device.reason), style="dim"),
            Text(device.source, style="" if device.source == "live" else "magenta"),
        ]
        table.add_row(*cells)
    if not errors:
        return table
    inside = sum(
        error_m <= device.radius90_m
        for device in found
        if device.radius90_m is not None and (error_m := _error_m(device, truth)) is not None
    )
    summary = (
        f"error: median {statistics.median(errors):.2f} m, worst {max(errors):.2f} m; "
        f"{inside} of {len(errors)} inside their 90 % radius"
    )
    return Group(table, Text(summary, style="bold"))


def _error_m(device: DeviceMessage, truth: Mapping[str, Point]) -> float | None:
    true = truth.get(device.mac)
    if true is None or device.x_m is None or device.y_m is None:
        return None
    return math.hypot(device.x_m - true[0], device.y_m - true[1])


def _as_json(device: DeviceMessage, truth: Mapping[str, Point]) -> dict[str, Any]:
    plain: dict[str, Any] = msgspec.to_builtins(device)
    if truth:
        true = truth.get(device.mac)
        plain["truth"] = None if true is None else {"x_m": true[0], "y_m": true[1]}
        plain["error_m"] = _error_m(device, truth)
    return plain
