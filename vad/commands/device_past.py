"""`vad device history`, `vad device heatmap`: how a device came to be where it is, and how sure that is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table
from rich.text import Text

from vad.bus.messages import HistoryMessage
from vad.bus.selectors import MAX_HISTORY
from vad.client import VadClient
from vad.commands.console import (
    ANY_HUB,
    ENDPOINT,
    EXIT_NOTHING,
    EndpointOption,
    HubOption,
    JsonOption,
    complain,
    out,
    print_json,
    reported_errors,
)
from vad.commands.devices import STATE_STYLES
from vad.errors import VadError
from vad.report.words import metres, printable

MacArgument = Annotated[str, typer.Argument(help="The device's address.", metavar="MAC")]


def history(
    mac: MacArgument,
    since: Annotated[
        str | None, typer.Option(help="Only after this time (RFC 3339).", metavar="TIME")
    ] = None,
    until: Annotated[str | None, typer.Option(help="Only up to this time.", metavar="TIME")] = None,
    limit: Annotated[int, typer.Option(min=1, max=MAX_HISTORY, help="The newest so many.")] = 20,
    as_json: JsonOption = False,
    endpoint: EndpointOption = ENDPOINT,
    hub: HubOption = ANY_HUB,
) -> None:
    """Show what was said of a device when, the newest first.

    Example:  vad device history f4:f5:d8:00:00:01 --since 2026-01-31T00:00:00Z

    Exit code 0: there is something; 1: no such device, or nothing in that time; 2: an option cannot be used;
    3: no daemon answers.
    """
    with reported_errors(), VadClient(endpoint, hub) as client:
        found = client.history(mac, since=since, until=until, limit=limit)
    if as_json:
        print_json(found)
    elif found is None:
        complain(f"the daemon does not know {mac}")
    elif found.entries:
        out.print(history_table(found))
    else:
        complain("nothing is kept of that time")
    if found is None or not found.entries:
        raise typer.Exit(EXIT_NOTHING)


def history_table(found: HistoryMessage) -> Table:
    """Entries as a table."""
    table = Table(header_style="bold", box=None, pad_edge=False)
    for name in ("From", "State"):
        table.add_column(name, no_wrap=True)
    table.add_column("Room", overflow="fold")
    for name in ("x m", "y m", "±90 % m", "Walks", "Map"):
        table.add_column(name, justify="right", no_wrap=True)
    for entry in found.entries:
        table.add_row(
            printable(entry.at),
            Text(entry.state, style=STATE_STYLES[entry.state]),
            Text(printable(entry.room or "–")),
            metres(entry.x_m),
            metres(entry.y_m),
            metres(entry.radius90_m, "±"),
            str(entry.walks),
            str(entry.epoch),
        )
    return table


def heatmap(
    mac: MacArgument,
    file: Annotated[
        Path, typer.Argument(help="Ends in .png (to lay over `map/grid`), .npy or .json.", metavar="FILE")
    ],
    endpoint: EndpointOption = ENDPOINT,
    hub: HubOption = ANY_HUB,
) -> None:
    """Write where a device may be, cell by cell: a picture, a NumPy array, or the message with its bounds.

    Example:  vad device heatmap f4:f5:d8:00:00:01 lamp.png

    Exit code 0: written; 1: its place is not known at all yet; 2: the file cannot be used; 3: no daemon
    answers.
    """
    with reported_errors():
        if file.suffix not in (".png", ".npy", ".json"):
            raise VadError("the name does not end in .png, .npy or .json", where=str(file))
        with VadClient(endpoint, hub) as client:
            payload = client.heatmap_bytes(mac, file.suffix[1:])
        if payload is None:
            complain(f"nothing is known of the place of {mac} yet")
            raise typer.Exit(EXIT_NOTHING)
        try:
            file.write_bytes(payload)
        except OSError as error:
            raise VadError(f"cannot be written: {error.strerror}", where=str(file)) from error
    out.print(Text(f"wrote {file}"), soft_wrap=True)
