"""`vad agent`: a remote Wi-Fi node with a CSI card, whose own place is wanted."""

from __future__ import annotations

import asyncio
import faulthandler
import logging
import os
import socket
from pathlib import Path
from typing import Annotated, Any

import typer

from vad import __version__
from vad.agent.card import own_mac
from vad.agent.info import AgentInfo
from vad.agent.node import Node
from vad.bus.session import BusSettings, check_endpoint, is_tls
from vad.commands.console import out, reported_errors
from vad.commands.signals import until_ended
from vad.config import AgentSettings, agent_settings, parse_yaml, read_text, resolve
from vad.csi.open_source import open_source
from vad.daemon.notify import notify
from vad.daemon.watchdog import Watchdog, feed, feed_every_s
from vad.errors import ConfigError
from vad.mac import mac_from_text, normal_mac
from vad.pki.credentials import ENVIRONMENT, load_credentials

DEFAULT_CONFIG = Path("/etc/vad/agent.yaml")

HubOption = Annotated[
    str | None, typer.Option("--hub", help="The hub: tls/<address>:7448.", metavar="tls/HOST:PORT")
]
IdOption = Annotated[
    str | None, typer.Option("--id", help="This agent's name in the keys; else the host's.", metavar="NAME")
]


def agent(
    hub: HubOption = None,
    agent_id: IdOption = None,
    credentials: Annotated[
        Path | None, typer.Option(help="The folder that `vad pki issue agent NAME` made.", metavar="DIR")
    ] = None,
    interface: Annotated[
        str | None, typer.Option(help="The CSI card; else the only wireless one.", metavar="wlan0")
    ] = None,
    mac: Annotated[str | None, typer.Option(help="The CSI card's address instead.", metavar="MAC")] = None,
    fifo: Annotated[
        Path | None,
        typer.Option(help="CSI from a FIFO or growing log that another program writes.", metavar="FILE"),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option("--config", "-c", help=f"Settings; {DEFAULT_CONFIG} if it is there.", metavar="FILE"),
    ] = None,
    check: Annotated[bool, typer.Option("--check", help="Check the settings and end.")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log details.")] = False,
) -> None:
    """Run on a device with an Intel 5300 whose place is wanted; send its CSI to the hub until Ctrl-C.

    The hub finds the agent by itself, treats it as a device of its card's address, and places it like any
    other. Through a break of the network the agent goes on recording (buffer_mb) and catches up.

    On the hub:   vad pki issue agent attic --out attic     (copy the folder here)
    Here:         vad agent --hub tls/192.168.1.10:7448 --id attic --credentials attic

    Exit code 0: stopped as asked; 2: the settings cannot be used (one line says which).
    """
    logging.basicConfig(
        level=logging.DEBUG if verbose else logging.INFO,
        format="%(asctime)s %(levelname)s %(name)s: %(message)s",
    )
    with reported_errors():
        if config is None and DEFAULT_CONFIG.is_file():
            config = DEFAULT_CONFIG
        given: dict[str, Any] = {
            "hub": hub,
            "id": agent_id,
            "credentials": credentials and str(credentials.absolute()),
            "interface": interface,
            "mac": mac,
            "source": fifo and {"type": "follow", "path": str(fifo.absolute())},
        }
        settings = _settings(config, {key: value for key, value in given.items() if value is not None})
        node = _node(settings, (config or Path("agent.yaml")).absolute())
        if check:
            out.print(f"the settings are usable (agent {settings.id!r} of {settings.hub})", markup=False)
            return
        faulthandler.enable()
        asyncio.run(until_ended(_run(node)))


def _settings(config: Path | None, given: dict[str, Any]) -> AgentSettings:
    """The file's settings with the options on top of them."""
    plain = {} if config is None else parse_yaml(read_text(config), where=str(config))
    plain |= given
    where = str(config) if config is not None else "options"
    if not plain.get("hub"):
        raise ConfigError("the hub is not named", where=where, remedy="Give --hub tls/<its address>:7448")
    plain.setdefault("id", socket.gethostname().partition(".")[0])
    if "mac" in given:
        plain.pop("interface", None)
    return agent_settings(plain, where=where)


def _node(settings: AgentSettings, config_file: Path) -> Node:
    """The settings' agent; VadError for the first setting that cannot be used."""
    check_endpoint(settings.hub)
    credentials = settings.credentials and resolve(settings.credentials, config_file)
    folder = credentials or os.environ.get(ENVIRONMENT)
    if is_tls(settings.hub):
        if not folder:
            raise ConfigError(
                "this endpoint asks for a certificate",
                where=settings.hub,
                remedy=f"On the hub, `vad pki issue agent {settings.id}` makes a folder: carry it here and "
                "name it with --credentials",
            )
        load_credentials(Path(folder))
    info = AgentInfo(
        id=settings.id,
        mac=normal_mac(settings.mac) if settings.mac else own_mac(settings.interface),
        name=settings.name,
        carrier_hz=settings.carrier_hz,
        bandwidth_mhz=settings.bandwidth_mhz,
        version=__version__,
    )
    return Node(
        BusSettings(
            hub=settings.hub_name,
            mode="client",
            listen=(),
            connect=(settings.hub,),
            credentials=Path(folder) if folder else None,
        ),
        info,
        open_source(settings.source, config_file.parent),
        batch_s=settings.batch_ms / 1e3,
        buffer_bytes=int(settings.buffer_mb * 1e6),
        transmitter=None if settings.transmitter is None else mac_from_text(settings.transmitter),
    )


async def _run(node: Node) -> None:
    watchdog = Watchdog(feed, every_s=feed_every_s())
    watchdog.add_queue("the card's packets wait and are not collected", node.batches)
    feeding = asyncio.create_task(watchdog.run(), name="watchdog")
    notify("READY=1")
    try:
        await node.run()
    finally:
        notify("STOPPING=1")
        feeding.cancel()
        await asyncio.wait({feeding})
