"""What all commands share: consoles, exit codes, errors as one line, JSON, watching."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import msgspec
import typer
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.text import Text

from vad.bus.session import DEFAULT_ENDPOINT
from vad.client import UnreachableError, VadClient
from vad.errors import VadError

EXIT_NOTHING = 1
"""Asked and answered: nothing there, or not well."""
EXIT_BAD_INPUT = 2
"""An option, a file or a value that cannot be used."""
EXIT_UNREACHABLE = 3
"""No daemon answers."""

WATCH_PERIOD_S = 1.0
PIPE_WIDTH = 160
"""Columns of a table that goes into a file or a pipe, where COLUMNS does not say."""

out = Console(width=None if sys.stdout.isatty() or "COLUMNS" in os.environ else PIPE_WIDTH)
err = Console(stderr=True)

EndpointOption = Annotated[str, typer.Option(help="Where the daemon listens.", metavar="tcp/HOST:PORT")]
HubOption = Annotated[str, typer.Option(help="Name of the hub; * is whichever answers.")]
JsonOption = Annotated[bool, typer.Option("--json", help="JSON on standard output instead of a table.")]
WatchOption = Annotated[bool, typer.Option("--watch", help="Show it again every second until Ctrl-C.")]
ENDPOINT = DEFAULT_ENDPOINT
ANY_HUB = "*"


@contextmanager
def reported_errors() -> Iterator[None]:
    """A VadError as one line on standard error and the exit code that fits."""
    try:
        yield
    except VadError as error:
        complain(str(error))
        unreachable = isinstance(error, UnreachableError)
        raise typer.Exit(EXIT_UNREACHABLE if unreachable else EXIT_BAD_INPUT) from error


def complain(sentence: str) -> None:
    """One line for people on standard error."""
    err.print(Text(sentence, style="red"), soft_wrap=True, highlight=False)


def print_json(value: Any) -> None:
    """A value (structs, dicts, lists) as indented JSON on standard output."""
    text = json.dumps(msgspec.to_builtins(value), indent=2, ensure_ascii=False)
    out.print(text, markup=False, highlight=False, soft_wrap=True)


def watch(client: VadClient, render: Callable[[VadClient], RenderableType]) -> None:
    """Render again and again until Ctrl-C; a daemon that goes away is said and waited for."""
    shown: RenderableType = Text("")
    with Live(console=out, auto_refresh=False) as live:
        try:
            while True:
                try:
                    shown = render(client)
                    live.update(shown, refresh=True)
                except UnreachableError as error:
                    note = Text(f"{error.what}: the last that was seen, waiting for it to come back", "red")
                    live.update(Group(shown, note), refresh=True)
                time.sleep(WATCH_PERIOD_S)
        except KeyboardInterrupt:
            return


def watch_json(client: VadClient, ask: Callable[[VadClient], Any]) -> None:
    """A line of JSON whenever the answer changes, until Ctrl-C; a daemon that goes away is an error."""
    last = b""
    try:
        while True:
            line = msgspec.json.encode(ask(client))
            if line != last:
                out.print(line.decode(), markup=False, highlight=False, soft_wrap=True)
                last = line
            time.sleep(WATCH_PERIOD_S)
    except KeyboardInterrupt:
        return
