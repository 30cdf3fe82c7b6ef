"""`vad web`: where the page for browsers is, and the token for who may change something there."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

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
from vad.report.words import printable

web_app = typer.Typer(invoke_without_command=True, subcommand_metavar="[token FILE]")


@web_app.callback()
def web(
    context: typer.Context,
    open_it: Annotated[bool, typer.Option("--open", help="Open it in this computer's browser.")] = False,
    endpoint: EndpointOption = ENDPOINT,
    hub: HubOption = ANY_HUB,
) -> None:
    """Tell where the page for browsers is: floor plan, devices, heatmaps, health.

    It is served to the hub itself only. From another computer:  ssh -L 9748:127.0.0.1:9748 HUB, then open
    http://localhost:9748/ there. For phones let a reverse proxy with TLS and a log-in pass it on, and name
    its host in web.names.

    Example:  vad web --open

    Exit code 0: it is there; 1: it is not, and why; 2: an option cannot be used; 3: no daemon answers.
    """
    if context.invoked_subcommand is not None:
        return
    with reported_errors(), VadClient(endpoint, hub) as client:
        status = client.status()
    page = next((part for part in status.parts if part.part == "web"), None) if status else None
    if page is None:
        complain("there is no page: set web: {port: 9748} in vad.yaml")
        raise typer.Exit(EXIT_NOTHING)
    if page.state != "ok":
        complain(f"the page is not there: {printable(page.detail)}")
        raise typer.Exit(EXIT_NOTHING)
    out.print(Text(printable(page.detail)), soft_wrap=True)
    if open_it and not webbrowser.open(page.detail):
        complain("no browser could be started here")
        raise typer.Exit(EXIT_NOTHING)


@web_app.command()
def token(
    file: Annotated[Path, typer.Argument(help="Where it goes, in place of what is there.", metavar="FILE")],
) -> None:
    """Write a fresh token: who gives it on the page may rename, ignore and forget devices.

    Only the file's owner can read it; in a folder that hands its group on (/etc/vad), the group can, too.
    A new token ends every log-in with the old one.

    Example:  sudo vad web token /etc/vad/web.token, and in vad.yaml  web: {token_file: web.token}

    Exit code 0: written; 2: it cannot be.
    """
    with reported_errors():
        from vad.web.access import write_token

        secret = write_token(file)
    out.print(
        Text(f"wrote {file}; name it in vad.yaml, at web.token_file. To log in on the page, give:\n{secret}")
    )
