"""`vad sim`: a simulated home to point a daemon at."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Annotated

import typer

from vad.commands.console import out, reported_errors
from vad.commands.signals import until_ended


def sim(
    folder: Annotated[Path, typer.Option("--dir", help="Where its files go.")] = Path("simulated-home"),
    seed: Annotated[int, typer.Option(help="Which home: rooms, places and walks follow from it.")] = 1,
    start_at_s: Annotated[
        float,
        typer.Option("--start-at", min=0, metavar="SECONDS", help="Begin this late in the home's own time."),
    ] = 0.0,
    bus_port: Annotated[int, typer.Option(help="Where the daemon's zenoh router shall listen.")] = 7447,
    web_port: Annotated[
        int | None, typer.Option(help="Where the daemon's page for browsers shall be.", show_default="none")
    ] = None,
    fifo: Annotated[
        bool, typer.Option("--fifo", help="CSI through a FIFO even where netlink would be allowed.")
    ] = False,
) -> None:
    """Play a simulated home in real time until Ctrl-C: robot, camera, radio, hostapd.

    It writes vad.yaml for `vad run`, the floor plan, and truth.json. The radio speaks real NETLINK_CONNECTOR
    where it may (root), else a FIFO.

    Example:  vad sim --dir home --seed 3 &  vad run --config home/vad.yaml
    """
    with reported_errors():
        asyncio.run(until_ended(_play(folder, seed, start_at_s, bus_port, web_port, fifo)))


async def _play(
    folder: Path, seed: int, start_at_s: float, bus_port: int, web_port: int | None, fifo: bool
) -> None:
    from vad.sim.driver import ConnectorSender
    from vad.sim.home import SimulatedHome
    from vad.sim.scenario import make_home

    connector = not fifo and ConnectorSender.permitted()
    scenario = make_home(seed)
    home = SimulatedHome(
        scenario, folder, bus_port=bus_port, connector=connector, start_at_s=start_at_s, web_port=web_port
    )

    async def announce(ready: asyncio.Event) -> None:
        await ready.wait()
        way = "NETLINK_CONNECTOR" if connector else "a FIFO"
        out.print(f"home {seed} runs; CSI over {way}; settings: {folder / 'vad.yaml'}", soft_wrap=True)
        out.print(
            f"robot drives until {scenario.drive_end_s:.0f} s, the device joins at {scenario.join_s:.0f} s, "
            f"walks from {scenario.walks[0].start_s:.0f} s to {scenario.walks[-1].end_s:.0f} s"
        )

    ready = asyncio.Event()
    announcing = asyncio.create_task(announce(ready))
    try:
        await home.run(ready)
    finally:
        announcing.cancel()
