"""`vad map import|export|show`: floor plans as files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.table import Table
from rich.text import Text

from vad.bus.grid import png_to_grid
from vad.bus.plan import map_message
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
from vad.errors import SourceError, VadError
from vad.report.words import printable
from vad.robot.floor_plan import FREE, OCCUPIED, UNKNOWN, FloorPlan
from vad.robot.floor_plan import Room as PlanRoom
from vad.robot.map_server import load_floor_plan, load_rooms, save_floor_plan
from vad.robot.ros2 import Frames, Ros2Reader
from vad.robot.valetudo import map_from_payload

ToArgument = Annotated[Path, typer.Argument(metavar="PLAN.yaml", help="Where it goes; a .pgm beside it.")]


def import_(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="A map_server .yaml, a Valetudo map (JSON, or deflated as on MQTT), or a ROS 2 "
            "OccupancyGrid as CDR.",
        ),
    ],
    to: ToArgument,
    rooms: Annotated[
        Path | None, typer.Option(help="A YAML with rooms, for maps that have none.", metavar="FILE")
    ] = None,
) -> None:
    """Make a floor plan of another program's map.

    Example:  vad map import robot.json /etc/vad/floor.yaml

    Exit code 0: written; 2: a file cannot be used.
    """
    with reported_errors():
        plan = read_plan(source)
        if rooms is not None:
            plan = FloorPlan(plan.epoch, plan.resolution_m, plan.origin, plan.cells, load_rooms(rooms))
        _write(plan, to)


def export(to: ToArgument, endpoint: EndpointOption = ENDPOINT, hub: HubOption = ANY_HUB) -> None:
    """Write the floor plan that the daemon uses, as map_server YAML and PGM with the rooms.

    Example:  vad map export floor.yaml

    Exit code 0: written; 1: the daemon has no map yet; 2: the file cannot be written; 3: no daemon answers.
    """
    with reported_errors():
        with VadClient(endpoint, hub) as client:
            found, picture = client.map(), client.grid_png()
        if found is None or picture is None:
            complain("the daemon has no map yet")
            raise typer.Exit(EXIT_NOTHING)
        rooms = tuple(PlanRoom(room.name, np.array(room.polygon_m)) for room in found.rooms)
        _write(FloorPlan(found.epoch, found.resolution_m, found.origin, png_to_grid(picture), rooms), to)


def show(
    source: Annotated[Path, typer.Argument(metavar="FILE", help="Any map that `vad map import` reads.")],
    png: Annotated[Path | None, typer.Option(help="Draw it as PNG here.", metavar="FILE")] = None,
) -> None:
    """Tell what is in a map file.

    Example:  vad map show floor.yaml --png floor.png

    Exit code 0: done; 2: a file cannot be used.
    """
    with reported_errors():
        if png is not None and png.suffix != ".png":
            raise VadError("the name does not end in .png", where=str(png))
        plan = read_plan(source)
        _describe(plan, source)
        if png is not None:
            from vad.report.floor import Floor, save_floor  # matplotlib: the daemon must not load it

            try:
                save_floor(Floor(map_message(plan, "replay"), plan.cells, [], [], {}), png)
            except OSError as error:
                raise SourceError(f"cannot be written: {error.strerror}", where=str(png)) from error
            out.print(Text(f"wrote {png}"), soft_wrap=True)


def read_plan(path: Path) -> FloorPlan:
    """The floor plan in a file of any known kind, told by its beginning. VadError for anything else."""
    if path.suffix in (".yaml", ".yml"):
        return load_floor_plan(path, epoch=1)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SourceError(f"cannot be read: {error.strerror}", where=str(path)) from error
    try:
        if data[:2] == b"\x00\x01":
            return Ros2Reader(Frames(), 1).floor_plan(data)
        return map_from_payload(data, 1).plan
    except VadError as error:
        raise VadError(error.what, where=str(path), remedy=error.remedy) from error


def _write(plan: FloorPlan, to: Path) -> None:
    if to.suffix != ".yaml":
        raise VadError("the name does not end in .yaml", where=str(to))
    save_floor_plan(plan, to)
    out.print(Text(f"wrote {to} and {to.with_suffix('.pgm').name}"), soft_wrap=True)


def _describe(plan: FloorPlan, source: Path) -> None:
    x0, y0, x1, y1 = plan.bounds_m
    cell_m2 = plan.resolution_m**2
    free, walls, unknown = (np.count_nonzero(plan.cells == v) * cell_m2 for v in (FREE, OCCUPIED, UNKNOWN))
    out.print(
        Text.assemble(
            (printable(source.name), "bold"),
            f": {x1 - x0:.1f} m x {y1 - y0:.1f} m, x {x0:.2f} to {x1:.2f}, y {y0:.2f} to {y1:.2f}, "
            f"{plan.resolution_m:g} m a cell; {free:.1f} m² free, {walls:.1f} m² occupied, "
            f"{unknown:.1f} m² unknown",
        ),
        soft_wrap=True,
    )
    table = Table("Room", "Corners", header_style="bold", box=None, pad_edge=False)
    for room in plan.rooms:
        table.add_row(Text(printable(room.name)), str(len(room.polygon)))
    if plan.rooms:
        out.print(table)
