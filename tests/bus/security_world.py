"""What the tests of the way in share: a hub whose router is behind a gate, and clients with certificates."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import zenoh
from bus_world import PATIENCE_S, STARTED_S
from waiting import free_port, until

from vad.bus.gate import Gate, GateSettings
from vad.bus.session import BusSettings, open_session
from vad.errors import VadError
from vad.pki.certificates import CLIENT_DAYS, Role, utc_now
from vad.pki.credentials import write_credentials
from vad.pki.folder import PkiFolder

HUB = "home"

T = TypeVar("T")


@dataclass
class Network:
    """A hub's router, its gate, and the folder of its certificates."""

    folder: Path
    pki: PkiFolder
    gate: Gate
    daemon: str
    tls: str
    router: zenoh.Session
    sessions: list[zenoh.Session] = field(default_factory=list)

    def issue(self, role: Role, name: str, days: float = CLIENT_DAYS) -> Path:
        """A client's folder; the gate lets it in once it has come up anew."""
        issued = self.pki.issue(role, name, days, utc_now())
        target = self.folder / f"{name}-{issued.common_name.rpartition('.')[2]}"
        write_credentials(target, issued, self.pki.authority_certificate(), self.tls)
        return target

    def connect(self, credentials: Path, endpoint: str | None = None) -> zenoh.Session:
        """A client's session; closed with the network."""
        settings = BusSettings(
            hub=HUB, mode="client", connect=(endpoint or self.tls,), credentials=credentials
        )
        session = open_session(settings)
        self.sessions.append(session)
        return session

    async def lets_in(self, credentials: Path) -> bool:
        try:
            session = await asyncio.to_thread(self.connect, credentials)
        except VadError:
            return False
        await asyncio.to_thread(session.close)
        self.sessions.remove(session)
        return True

    async def opened(self, times: int) -> None:
        """Wait until the gate has come up so often."""
        await until(
            lambda: self.gate.health.counters["opened"] >= times,
            f"the gate opened {times} times: {self.gate.health}",
            STARTED_S,
        )


@asynccontextmanager
async def network(folder: Path, *issue: tuple[Role, str]) -> AsyncIterator[tuple[Network, list[Path]]]:
    """A hub, its gate open, and a folder of credentials for each that is issued."""
    daemon, tls = f"tcp/127.0.0.1:{free_port()}", f"tls/127.0.0.1:{free_port()}"
    pki = PkiFolder(folder / "pki")
    pki.init(HUB, ["localhost", "127.0.0.1"], utc_now())
    router = await asyncio.to_thread(open_session, BusSettings(hub=HUB, listen=(daemon,)))
    gate = Gate(GateSettings(HUB, (tls,), daemon), pki)
    world = Network(folder, pki, gate, daemon, tls, router)
    credentials = [world.issue(role, name) for role, name in issue]
    running = asyncio.create_task(gate.run())
    try:
        if issue:
            await world.opened(1)
        yield world, credentials
    finally:
        running.cancel()
        with suppress(asyncio.CancelledError):
            await running
        for session in (*world.sessions, router):
            await asyncio.to_thread(session.close)


def gate_pid() -> int:
    """The gate's process below this one."""
    for thread in Path("/proc/self/task").iterdir():
        with suppress(OSError):  # threads and other children come and go meanwhile
            for child in (thread / "children").read_text().split():
                if b"gate_process" in Path(f"/proc/{child}/cmdline").read_bytes():
                    return int(child)
    raise AssertionError("there is no gate")


def memory_kib(pid: int) -> int:
    """Memory in use by a process."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 1024


def linked(session: zenoh.Session) -> bool:
    """Whether the client's link to the gate stands."""
    return bool(list(session.info.links()))


def on(session: zenoh.Session, key: str, take: Callable[[zenoh.Sample], None]) -> None:
    """Subscribe until the session closes."""
    session.declare_subscriber(key, zenoh.handlers.Callback(take, None, indirect=False))


def answer(session: zenoh.Session, key: str, payload: bytes) -> None:
    """Answer every question on `key` until the session closes."""

    def reply(query: zenoh.Query) -> None:
        with query, suppress(zenoh.ZError):
            query.reply(query.key_expr, payload)

    session.declare_queryable(key, zenoh.handlers.Callback(reply, None, indirect=False))


def ask(session: zenoh.Session, key: str, timeout_s: float = PATIENCE_S) -> list[bytes]:
    """The payloads of all answers."""
    replies = session.get(
        key,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=timeout_s,
    )
    return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]
