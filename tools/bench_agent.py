#!/usr/bin/env python3
"""Agents into a hub: what the hub's side costs, as a share of one core, and whether every packet arrives.

The hub's side (router, decoding, a session's line to each, as in the daemon) is a process of its own and
measures itself; the agents are real ones, reading real FIFOs, in this process.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import logging
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from vad.agent.info import AgentInfo
from vad.agent.node import Node
from vad.bus.keys import HubKeys
from vad.bus.session import BusSettings, open_session
from vad.capture.session import SCHEMA, SessionAnchor, SessionDevice, SessionHeader
from vad.capture.walk_writer import WalkWriter
from vad.csi.bfee import encode_bodies
from vad.csi.follow import FollowLog
from vad.csi.logfile import record
from vad.daemon.agents import Agents, Line
from vad.mac import mac_to_text
from vad.sim.driver import FifoSender

KEYS = HubKeys("bench")
TICK_S = 0.01
SETTLE_S = 2.0
DRAIN_S = 0.1
NIC_US_AT, COUNT_AT = 3, 7
"""Where a record holds its counters: after its length and code, little-endian."""


@dataclass(frozen=True, slots=True)
class Case:
    """agents times packets/s of n_tx streams; batch_ms: one message holds so much; to_disk: recorded, too."""

    agents: int
    packets_per_s: int
    n_tx: int
    batch_ms: float
    to_disk: bool = False

    @property
    def name(self) -> str:
        disk = ", recorded to disk" if self.to_disk else ""
        return f"{self.agents} x {self.packets_per_s}/s 3x{self.n_tx}, {self.batch_ms:.0f} ms{disk}"


CASES = (
    Case(1, 1000, 2, 50),
    Case(4, 1000, 1, 50),
    Case(4, 1000, 2, 20),
    Case(4, 1000, 2, 50),
    Case(4, 1000, 2, 100),
    Case(4, 1000, 3, 50),
    Case(4, 1000, 2, 50, to_disk=True),
)


def mac_of(agent: int) -> str:
    return mac_to_text(0x0016EA000000 + agent)


async def hub(port: int, agents: int, folder: Path | None) -> None:
    """Take in everything until a line comes on standard input; print what it was and what it cost."""
    logging.disable(logging.WARNING)
    loop = asyncio.get_running_loop()
    with open_session(BusSettings(hub=KEYS.hub, listen=(f"tcp/127.0.0.1:{port}",))) as session:
        token = session.liveliness().declare_token(KEYS.alive)
        side = Agents(KEYS)
        running = asyncio.create_task(side.run(session))
        print("listening", flush=True)
        while sum(side.card_of(mac_of(k)) is not None for k in range(agents)) < agents:  # noqa: ASYNC110
            await asyncio.sleep(0.02)
        with contextlib.ExitStack() as stack:
            lines: list[Line] = []
            for k in range(agents):
                card = side.card_of(mac_of(k))
                assert card is not None
                lines.append(stack.enter_context(side.leading(card, "s")))
            writer = None if folder is None else WalkWriter(folder, [(x.card.id, header(x)) for x in lines])
            print("ready", flush=True)
            over = loop.run_in_executor(None, sys.stdin.readline)
            await asyncio.sleep(SETTLE_S)
            before, cpu_s, wall_s = side.health.counters["packets"], time.process_time(), time.monotonic()
            received = await drain(lines, writer, over)
            cpu = (time.process_time() - cpu_s) / (time.monotonic() - wall_s)
            rate = (side.health.counters["packets"] - before) / (time.monotonic() - wall_s)
            received += await drain(lines, writer, asyncio.ensure_future(asyncio.sleep(SETTLE_S)))
            if writer is not None:
                writer.abort("the benchmark is over")
        counters = side.health.counters
        told = {"cpu": cpu, "per_s": rate, "received": received, "lost": counters["lost"]}
        told |= {
            name: sum(getattr(line.card.inbox, name) for line in lines) for name in ("repeated", "early")
        }
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        del token
    print(json.dumps(told), flush=True)


def header(line: Line) -> SessionHeader:
    return SessionHeader(
        schema=SCHEMA,
        id=line.card.id,
        source="simulated",
        device=SessionDevice(line.card.mac),
        anchor=SessionAnchor(0.0, 0.0),
    )


async def drain(lines: list[Line], writer: WalkWriter | None, until: asyncio.Future[object]) -> int:
    """Take what comes as a recording walk does; the number of packets."""
    received = 0
    while not until.done():
        await asyncio.sleep(DRAIN_S)
        for line in lines:
            for batch in line.batches():
                received += len(batch.packets)
                if writer is not None:
                    writer.append(batch, line.card.id)
    return received


class Card:
    """One agent's card: a FIFO, and records whose counters are set as they go out."""

    def __init__(self, path: Path, case: Case) -> None:
        self.sent = 0
        self.sender = FifoSender(path)
        csi = np.random.default_rng(0).integers(-60, 61, (1024, 30, 3, case.n_tx, 2)).astype(np.int8)
        bodies = encode_bodies(csi, nic_us=0, bfee_count=0, rssi=(30, 31, 32))
        self._records = [bytearray(record(0xBB, body)) for body in bodies]

    def send(self, n: int) -> None:
        """The next n packets, which came over the last milliseconds."""
        now_us = time.monotonic_ns() // 1000
        group = []
        for k in range(n):
            data = self._records[self.sent % len(self._records)]
            data[NIC_US_AT : NIC_US_AT + 4] = (now_us - n + k & 0xFFFF_FFFF).to_bytes(4, "little")
            data[COUNT_AT : COUNT_AT + 2] = (self.sent & 0xFFFF).to_bytes(2, "little")
            group.append(bytes(data))
            self.sent += 1
        self.sender.send(group)


async def measure(case: Case, seconds: float, folder: Path) -> dict[str, object]:
    """One row."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    archive = [str(folder / "sessions")] if case.to_disk else []
    command = [sys.executable, __file__, "--as-hub", str(port), str(case.agents), *archive]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, text=True, **pipes) as process:  # noqa: ASYNC220 - nothing else runs yet
        assert process.stdin is not None
        assert process.stdout is not None
        await asyncio.to_thread(process.stdout.readline)
        cards = [Card(folder / f"csi{k}.fifo", case) for k in range(case.agents)]
        nodes = [
            Node(
                BusSettings(hub=KEYS.hub, mode="client", listen=(), connect=(f"tcp/127.0.0.1:{port}",)),
                AgentInfo(id=f"agent{k}", mac=mac_of(k)),
                FollowLog(folder / f"csi{k}.fifo"),
                batch_s=case.batch_ms / 1e3,
                buffer_bytes=32_000_000,
            )
            for k in range(case.agents)
        ]
        tasks = [asyncio.create_task(node.run()) for node in nodes]
        await asyncio.to_thread(process.stdout.readline)
        begun_s = time.monotonic()
        while (elapsed_s := time.monotonic() - begun_s) < seconds + SETTLE_S:
            for card in cards:
                card.send(int(elapsed_s * case.packets_per_s) - card.sent)
            await asyncio.sleep(TICK_S)
        process.stdin.write("\n")
        process.stdin.flush()
        answer = await asyncio.to_thread(process.stdout.readline)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        told = json.loads(answer)
        not_sent = sum(card.sender.health.counters["dropped_records"] for card in cards)
        for card in cards:
            card.sender.close()
    sent = sum(card.sent for card in cards) - not_sent
    return {"case": case.name} | asdict(case) | {"sent": sent} | told


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="for each case")
    parser.add_argument("--json", action="store_true", help="a line of JSON for each case")
    parser.add_argument("--as-hub", nargs="+", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.as_hub:
        port, agents, *archive = options.as_hub
        asyncio.run(hub(int(port), int(agents), Path(archive[0]) if archive else None))
        return
    logging.disable(logging.WARNING)
    table = Table(title="Agents into the hub: the hub's side of it", title_justify="left", box=None)
    table.add_column("case", no_wrap=True)
    for column in ("packets/s", "sent", "received", "counted lost", "sent again", "hub's CPU"):
        table.add_column(column, justify="right")
    for case in CASES:
        with tempfile.TemporaryDirectory() as folder:
            row = asyncio.run(measure(case, options.seconds, Path(folder)))
        if options.json:
            print(json.dumps(row), flush=True)
        table.add_row(
            case.name,
            f"{row['per_s']:,.0f}",
            f"{row['sent']:,}",
            f"{row['received']:,}",
            f"{row['lost']:,}",
            f"{row['repeated']:,}",
            f"{row['cpu']:.1%}",
        )
    if not options.json:
        Console(width=120).print(table)


if __name__ == "__main__":
    main()
