"""What the tests of the agent share: a hub's router with its agents' side, an agent on a FIFO, a card."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import numpy as np
import zenoh
from waiting import until

from vad.agent.collector import CLOCK_ERROR_NS
from vad.agent.info import AgentInfo
from vad.agent.node import Node
from vad.bus.keys import HubKeys
from vad.bus.session import BusSettings, open_session
from vad.capture.handshake import Answer
from vad.csi.bfee import encode_bodies
from vad.csi.follow import FollowLog
from vad.csi.logfile import record
from vad.daemon.agents import Agents, Line, RemoteCard
from vad.sim.driver import FifoSender

HUB = "home"
MAC = "00:16:ea:00:00:01"
KEYS = HubKeys(HUB)
BFEE = 0xBB
PACKETS_EVERY_S = 0.02


class Card:
    """A 5300's driver that writes a log: 3x2 packets, numbered by their bfee_count.

    Into a FIFO, as the CSI Tool would; or into a file that grows and has patience with a busy machine.
    """

    def __init__(self, path: Path, *, patient: bool = False) -> None:
        self.sent = 0
        self._sender = None if patient else FifoSender(path)
        self._file = path.open("wb", buffering=0) if patient else None

    def send(self, n: int) -> None:
        """The next n packets, which came in the last n times 0.2 ms."""
        count = np.arange(self.sent, self.sent + n)
        csi = np.ones((n, 30, 3, 2, 2), np.int8)
        nic_us = time.monotonic_ns() // 1000 - 200 * np.arange(n)[::-1]
        bodies = encode_bodies(csi, nic_us=nic_us, bfee_count=count, rssi=(30, 31, 32))
        records = [record(BFEE, body) for body in bodies]
        if self._file is not None:
            self._file.write(b"".join(records))
        if self._sender is not None:
            before = self._sender.health.counters["records"]
            self._sender.send(records)
            assert self._sender.health.counters["records"] - before == n, "the FIFO's reader keeps up"
        self.sent += n

    def close(self) -> None:
        """Take the FIFO away; the file stays."""
        if self._sender is not None:
            self._sender.close()
        if self._file is not None:
            self._file.close()


@contextlib.contextmanager
def router(port: int) -> Iterator[zenoh.Session]:
    """The hub's router with its token."""
    settings = BusSettings(hub=HUB, listen=(f"tcp/127.0.0.1:{port}",))
    with open_session(settings) as session:
        token = session.liveliness().declare_token(KEYS.alive)
        yield session
        del token


@contextlib.asynccontextmanager
async def hearing(session: zenoh.Session) -> AsyncIterator[Agents]:
    """The hub's side while it runs."""
    agents = Agents(KEYS)
    task = asyncio.create_task(agents.run(session))
    try:
        yield agents
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def there(agents: Agents, mac: str = MAC, timeout_s: float = 40.0) -> RemoteCard:
    """The agent's card, once the hub has heard of it."""
    found: list[RemoteCard] = []

    def come() -> bool:
        card = agents.card_of(mac)
        found.extend([card] if card is not None else [])
        return bool(found)

    await until(come, f"an agent with the card {mac}", timeout_s)
    return found[0]


async def good_clock(node: Node) -> None:
    """Until the agent knows the hub's time well enough for a session; that takes a busy machine a while."""
    clock = node.collector.clock
    await until(
        lambda: clock.known and clock.error_ns(time.monotonic_ns()) < CLOCK_ERROR_NS / 2,
        "the agent knows the hub's time",
    )


async def send(card: Card, times: int = 1_000_000, n: int = 20) -> None:
    """n packets every 20 ms."""
    for _ in range(times):
        card.send(n)
        await asyncio.sleep(PACKETS_EVERY_S)


async def answered(line: Line, count: int = 1) -> list[Answer]:
    """The next answers."""
    answers: list[Answer] = []

    def come() -> bool:
        answers.extend(line.heard())
        return len(answers) >= count

    await until(come, f"{count} answers of the agent")
    return answers


@contextlib.asynccontextmanager
async def running_node(
    hub: int | str,
    fifo: Path,
    *,
    name: str = "attic",
    mac: str = MAC,
    buffer_bytes: int = 32_000_000,
    credentials: Path | None = None,
) -> AsyncIterator[Node]:
    """An agent in this process. hub: a port of the loopback interface, or an endpoint."""
    endpoint = hub if isinstance(hub, str) else f"tcp/127.0.0.1:{hub}"
    node = Node(
        BusSettings(hub=HUB, mode="client", listen=(), connect=(endpoint,), credentials=credentials),
        AgentInfo(id=name, mac=mac),
        FollowLog(fifo),
        batch_s=0.03,
        buffer_bytes=buffer_bytes,
    )
    task = asyncio.create_task(node.run())
    try:
        if fifo.exists():  # noqa: ASYNC240 - of this machine
            await until(lambda: node.collector.source.state == "ok", "the agent reads")
        yield node
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
