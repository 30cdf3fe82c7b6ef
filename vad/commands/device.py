"""`vad device`: what people want of one device: left alone, renamed, forgotten."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table
from rich.text import Text

from vad.bus.messages import DeviceWish, WishReply
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
from vad.report.words import printable

device_app = typer.Typer(
    help="Leave a device alone, rename it, forget it. `vad devices` lists them.", no_args_is_help=True
)

MacArgument = Annotated[str, typer.Argument(help="Any address the device ever had.", metavar="MAC")]


@device_app.command()
def ignore(mac: MacArgument, endpoint: EndpointOption = ENDPOINT, hub: HubOption = ANY_HUB) -> None:
    """Leave a device alone: it is not measured and not shown, until `vad device show`.

    What is known of it is kept. The list `devices: ignore:` of the settings does the same.

    Example:  vad device ignore f4:f5:d8:00:00:01

    Exit code 0: done; 2: no such device; 3: no daemon answers.
    """
    _wish(endpoint, hub, DeviceWish(mac=mac, ignore=True))


@device_app.command()
def show(mac: MacArgument, endpoint: EndpointOption = ENDPOINT, hub: HubOption = ANY_HUB) -> None:
    """Take a device back that was ignored, with all that is known of it.

    Example:  vad device show f4:f5:d8:00:00:01

    Exit code 0: done; 2: no such device, or the settings ignore it; 3: no daemon answers.
    """
    _wish(endpoint, hub, DeviceWish(mac=mac, ignore=False))


@device_app.command()
def rename(
    mac: MacArgument,
    name: Annotated[str, typer.Argument(help="What to call it; empty: what it calls itself.")],
    endpoint: EndpointOption = ENDPOINT,
    hub: HubOption = ANY_HUB,
) -> None:
    """Give a device a name.

    Example:  vad device rename f4:f5:d8:00:00:01 "Lamp by the window"

    Exit code 0: done; 2: no such device, or the settings name it; 3: no daemon answers.
    """
    _wish(endpoint, hub, DeviceWish(mac=mac, name=name))


@device_app.command()
def forget(mac: MacArgument, endpoint: EndpointOption = ENDPOINT, hub: HubOption = ANY_HUB) -> None:
    """Drop a device and all its walks; when it joins again it is new.

    Example:  vad device forget f4:f5:d8:00:00:01

    Exit code 0: done; 2: no such device; 3: no daemon answers.
    """
    _wish(endpoint, hub, DeviceWish(mac=mac, forget=True))


@device_app.command()
def ignored(
    as_json: JsonOption = False, endpoint: EndpointOption = ENDPOINT, hub: HubOption = ANY_HUB
) -> None:
    """List the devices that are left alone.

    Exit code 0: there are some; 1: there is none; 3: no daemon answers.
    """
    reply = _ask(endpoint, hub, DeviceWish())
    if as_json:
        print_json(reply.ignored)
    elif reply.ignored:
        table = Table(header_style="bold", box=None, pad_edge=False)
        for column in ("MAC", "Name", "Last seen", "By"):
            table.add_column(column, no_wrap=column == "MAC")
        for device in reply.ignored:
            who = "the settings" if device.by_settings else "vad device ignore"
            table.add_row(device.mac, Text(printable(device.name or "–")), device.last_seen or "–", who)
        out.print(table)
    else:
        complain("no device is ignored")
    if not reply.ignored:
        raise typer.Exit(EXIT_NOTHING)


def _ask(endpoint: str, hub: str, wish: DeviceWish) -> WishReply:
    with reported_errors(), VadClient(endpoint, hub) as client:
        return client.wish(wish)


def _wish(endpoint: str, hub: str, wish: DeviceWish) -> None:
    out.print(Text(printable(_ask(endpoint, hub, wish).text)), soft_wrap=True)
