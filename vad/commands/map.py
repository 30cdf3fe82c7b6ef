"""`vad map`: the floor plan with rooms, cameras and devices, as a picture or in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.table import Table
from rich.text import Text

from vad.bus.grid import png_to_grid
from vad.bus.messages import CameraMessage, DeviceMessage, MapMessage, Point
from vad.client import VadClient
from vad.commands.console import (
    ANY_HUB,
    ENDPOINT,
    EXIT_NOTHING,
    EndpointOption,
    HubOption,
    complain,
    out,
    reported_errors,
)
from vad.commands.devices import read_truth
from vad.commands.map_files import export, import_, show
from vad.errors import VadError
from vad.report.words import metres, printable

map_app = typer.Typer(invoke_without_command=True, subcommand_metavar="[import|export|show ...]")
map_app.command("import")(import_)
map_app.command()(export)
map_app.command()(show)


@map_app.callback()
def map_(
    context: typer.Context,
    png: Annotated[Path | None, typer.Option(help="Write the map as PNG here.", metavar="FILE")] = None,
    svg: Annotated[Path | None, typer.Option(help="Write the map as SVG here.", metavar="FILE")] = None,
    truth: Annotated[
        Path | None,
        typer.Option(help="Test data only: true places, as for `vad devices`.", metavar="FILE"),
    ] = None,
    endpoint: EndpointOption = ENDPOINT,
    hub: HubOption = ANY_HUB,
) -> None:
    """Show the map: rooms, cameras, devices with the regions that hold them in 90 % of cases.

    Without --png or --svg a summary in words is printed.

    Example:  vad map --png home.png

    Exit code 0: done; 1: the daemon has no map yet; 2: a file cannot be used; 3: no daemon answers.
    """
    if context.invoked_subcommand is not None:
        return
    with reported_errors():
        for path, suffix in ((png, ".png"), (svg, ".svg")):
            if path is not None and path.suffix != suffix:
                raise VadError(f"the name does not end in {suffix}", where=str(path))
        places = {} if truth is None else read_truth(truth)
        with VadClient(endpoint, hub) as client:
            plan = client.map()
            if plan is None:
                complain("the daemon has no map yet")
                raise typer.Exit(EXIT_NOTHING)
            picture = client.grid_png()
            found, cameras = client.devices(), client.cameras()
        if png is None and svg is None:
            _print_summary(plan, found, cameras)
            return
        from vad.report.floor import Floor, save_floor  # matplotlib: the daemon must not load it

        floor = Floor(plan, None if picture is None else png_to_grid(picture), found, cameras, places)
        for path in (png, svg):
            if path is not None:
                _save(partial(save_floor, floor), path)


def _save(draw: Callable[[Path], None], path: Path) -> None:
    try:
        draw(path)
    except OSError as error:
        raise VadError(f"cannot be written: {error.strerror}", where=str(path)) from error
    out.print(Text(f"wrote {path}"), soft_wrap=True)


def _print_summary(
    plan: MapMessage, found: Sequence[DeviceMessage], cameras: Sequence[CameraMessage]
) -> None:
    x0, y0, x1, y1 = plan.bounds_m
    out.print(
        Text.assemble(
            (f"map of {printable(plan.hub)}", "bold"),
            f", epoch {plan.epoch}: {x1 - x0:.1f} m x {y1 - y0:.1f} m, "
            f"x {x0:.2f} to {x1:.2f}, y {y0:.2f} to {y1:.2f}, {plan.resolution_m:g} m a cell",
            ("" if plan.source == "live" else f" ({plan.source})", "magenta"),
        )
    )
    rooms = Table(header_style="bold", box=None, pad_edge=False)
    rooms.add_column("Room", overflow="fold")
    rooms.add_column("m²", justify="right")
    rooms.add_column("Devices", overflow="fold")
    for room in plan.rooms:
        inside = ", ".join(
            f"{printable(d.name or d.mac)} {metres(d.radius90_m, '±')}" for d in found if d.room == room.name
        )
        rooms.add_row(Text(printable(room.name)), f"{_area_m2(room.polygon_m):.1f}", Text(inside or "–"))
    if plan.rooms:
        out.print(rooms)
    for camera in cameras:
        where = "place unknown"
        if camera.position_m is not None:
            where = "at {:.2f}, {:.2f}, height {:.2f} m".format(*camera.position_m)
        if camera.deviation_m is not None:
            where += f", floor error {camera.deviation_m:.2f} m"
        why = f": {printable(camera.reason)}" if camera.reason else ""
        out.print(Text(f"camera {printable(camera.id)}: {where} ({camera.state}{why})"))
    states = Counter(device.state for device in found)
    told = ", ".join(f"{count} {state}" for state, count in sorted(states.items()))
    out.print(Text(f"devices: {told or 'none yet'}"))


def _area_m2(polygon_m: Sequence[Point]) -> float:
    """The polygon's area (shoelace formula)."""
    x, y = np.array(polygon_m).reshape(-1, 2).T
    return float(abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2)
