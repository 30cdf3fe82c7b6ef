"""`vad status`: how each part of the daemon is."""

from __future__ import annotations

from typing import Any

import msgspec
import typer
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from vad.bus.messages import Part, StatusMessage
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
from vad.report.words import duration, printable

STATE_STYLES = {"ok": "bold green", "starting": "yellow", "degraded": "bold yellow", "failed": "bold red"}
LOSSES = ("dropped", "lost", "refused", "failed", "broken", "died")
"""A counter with one of these words in its name counts what should not be."""
_JUST_STARTED = "the daemon has just started and says nothing of itself yet"


def status(
    as_json: JsonOption = False,
    keep_watching: WatchOption = False,
    endpoint: EndpointOption = ENDPOINT,
    hub: HubOption = ANY_HUB,
) -> None:
    """Show what the daemon is doing and how each of its parts is.

    Example:  vad status --watch

    Exit code 0: all is well; 1: a part is degraded or failed; 2: an option cannot be used; 3: no daemon
    answers.
    """
    with reported_errors(), VadClient(endpoint, hub) as client:
        if keep_watching and as_json:
            watch_json(client, _plain)
            return
        if keep_watching:
            watch(client, _table_of)
            return
        found = client.status()
    if found is None:
        complain(_JUST_STARTED)
        raise typer.Exit(EXIT_NOTHING)
    if as_json:
        print_json(found)
    else:
        out.print(status_table(found))
    if any(part.state in ("degraded", "failed") for part in found.parts):
        raise typer.Exit(EXIT_NOTHING)


def status_table(found: StatusMessage) -> RenderableType:
    """The status as a heading and a table of parts."""
    heading = Text.assemble(
        (f"vad {printable(found.version)}", "bold"),
        f" on {printable(found.hub)}, up {duration(found.uptime_s)}",
        ("" if found.source == "live" else f", {found.source}", "magenta"),
    )
    table = Table(header_style="bold", box=None, pad_edge=False)
    for name in ("Part", "State"):
        table.add_column(name, no_wrap=True)
    for name in ("Detail", "Last error", "Counters (a second)", "Took ms, median / p99"):
        table.add_column(name, overflow="fold")
    for part in found.parts:
        took = ", ".join(f"{work} {t.p50_ms:g} / {t.p99_ms:g}" for work, t in sorted(part.latencies.items()))
        table.add_row(
            Text(printable(part.part)),
            Text(part.state, style=STATE_STYLES[part.state]),
            Text(printable(part.detail)),
            Text(printable(_last_error(part)), style="dim"),
            _counters(part),
            Text(printable(took), style="dim"),
        )
    lines: list[RenderableType] = [heading]
    if found.step:
        lines.append(Text(f"now: {printable(found.step)}"))
    return Group(*lines, Text(""), table)


def _last_error(part: Part) -> str:
    """The reason for the last trouble, where the detail does not tell it now, and since when."""
    if not part.last_error:
        return ""
    since = f"{part.last_error_at}: " if part.last_error_at else ""
    return since.rstrip(": ") if part.last_error == part.detail else since + part.last_error


def _counters(part: Part) -> Text:
    """Every counter with its rate; what counts losses stands out where there are any."""
    told = Text(style="dim")
    for name, count in sorted(part.counters.items()):
        rate = f" ({part.rates_per_s[name]:g}/s)" if name in part.rates_per_s else ""
        loss = count > 0 and any(word in name for word in LOSSES)
        told.append(", " if told.plain else "")
        told.append(printable(f"{name} {count}{rate}"), style="yellow" if loss else "")
    return told


def _plain(client: VadClient) -> Any:
    return msgspec.to_builtins(client.status())


def _table_of(client: VadClient) -> RenderableType:
    found = client.status()
    return Text(_JUST_STARTED) if found is None else status_table(found)
