"""The hub's router restarted, the gate killed, the network gone: clients and agents are back without help."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import pytest
import zenoh
from bus_world import PATIENCE_S, ROOT, STARTED_S
from security_world import Network, answer, ask, gate_pid, linked, network, on
from waiting import POLL_S, free_port, running, until

from vad.bus.session import LEASE_MS, OPEN_TIMEOUT_MS, BusSettings, open_session
from vad.errors import VadError
from vad.pki.certificates import Role, utc_now
from vad.pki.credentials import write_credentials
from vad.pki.folder import PkiFolder

DAEMON = """
import asyncio, sys
from pathlib import Path
from vad.bus import messages as m
from vad.bus.gate import Gate, GateSettings
from vad.bus.node import Bus
from vad.bus.session import BusSettings
from vad.pki.folder import PkiFolder

async def main():
    daemon, tls, pki = sys.argv[1:]
    async with Bus(BusSettings(listen=(daemon,))) as bus:
        heard = 0
        def count(sample):
            nonlocal heard
            heard += 1
        bus.session.declare_subscriber("vad/home/agents/*/csi", count)
        gate = Gate(GateSettings("home", (tls,), daemon), PkiFolder(Path(pki)))
        running = asyncio.create_task(gate.run())
        while True:
            bus.publish_status(m.StatusMessage(source="live", version="1", uptime_s=0.0, step=str(heard)))
            await asyncio.sleep(0.02)

asyncio.run(main())
"""
"""A daemon's bus with its gate; its status tells how many messages agents sent to this run of it."""


class Away:
    """A viewer and an agent, which were set up once, and what they see now."""

    def __init__(self, viewer: zenoh.Session, agent: zenoh.Session) -> None:
        self.viewer, self.agent = viewer, agent
        self.steps: list[str] = []
        on(viewer, "vad/home/status", lambda sample: self.steps.append(sample.payload.to_bytes().decode()))
        answer(agent, "vad/home/agents/node/alive", b"node")
        self._token = agent.liveliness().declare_token("vad/home/agents/node/alive")

    def asks(self) -> bool:
        """Whether the viewer is answered."""
        return bool(ask(self.viewer, "vad/home/status", timeout_s=5.0))

    async def all_well(self) -> None:
        """Wait until the viewer asks and hears, and the agent is heard: its messages change the status."""
        while not await asyncio.to_thread(self.asks):  # noqa: ASYNC110 - the hub's return has no event
            await asyncio.sleep(POLL_S)
        self.steps.clear()

        def heard() -> bool:
            self.agent.put("vad/home/agents/node/csi", b"packets")
            return len(set(self.steps)) > 1

        await until(heard, "the agent is heard, and the viewer hears of it", STARTED_S)


async def knocks(tls: str, times: int) -> None:
    """Stand where the gate was, until clients have knocked so often in vain."""
    host, _, port = tls.partition("/")[2].rpartition(":")
    heard = 0

    def turn_away(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal heard
        heard += 1
        writer.transport.abort()

    server: asyncio.Server | None = None
    async with asyncio.timeout(PATIENCE_S):
        while server is None:
            try:
                server = await asyncio.start_server(turn_away, host, int(port))
            except OSError:  # the killed hub's gate has not ended yet
                await asyncio.sleep(POLL_S)
    async with server:
        await until(lambda: heard >= times, f"{times} knocks in vain")


@pytest.mark.slow
@pytest.mark.timeout(600)
async def test_the_hub_is_killed_and_started_again(tmp_path: Path) -> None:
    daemon, tls = f"tcp/127.0.0.1:{free_port()}", f"tls/127.0.0.1:{free_port()}"
    pki = PkiFolder(tmp_path / "pki")
    pki.init("home", ["localhost"], utc_now())
    folders = []
    roles: tuple[tuple[Role, str], ...] = (("viewer", "tablet"), ("agent", "node"))
    for role, name in roles:
        folders.append(tmp_path / name)
        issued = pki.issue(role, name, 1, utc_now())
        write_credentials(folders[-1], issued, pki.authority_certificate(), tls)
    command = [sys.executable, "-c", DAEMON, daemon, tls, str(pki.path)]
    sessions = []
    process = await asyncio.create_subprocess_exec(*command, cwd=ROOT)
    try:
        for folder in folders:
            settings = BusSettings(mode="client", connect=(tls,), credentials=folder)
            sessions.append(await opened(settings))
        away = Away(*sessions)
        async with asyncio.timeout(STARTED_S):
            await away.all_well()
        for in_vain in (0, 8):
            process.kill()
            await process.wait()
            assert not await asyncio.to_thread(away.asks)
            if in_vain:
                await knocks(tls, in_vain)
            process = await asyncio.create_subprocess_exec(*command, cwd=ROOT)
            async with asyncio.timeout(STARTED_S):
                await away.all_well()
    finally:
        for session in sessions:  # while the hub is there: a goodbye waits
            await asyncio.to_thread(session.close)
        process.kill()
        await process.wait()


async def opened(settings: BusSettings) -> zenoh.Session:
    """A session to a hub that is coming up."""
    async with asyncio.timeout(STARTED_S):
        while True:
            with suppress(VadError):
                return await asyncio.to_thread(open_session, settings)
            await asyncio.sleep(0.05)


async def test_a_killed_gate_comes_back_by_itself(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    async with network(tmp_path, ("viewer", "tablet")) as (world, (tablet,)):
        session = await asyncio.to_thread(world.connect, tablet)
        answer(world.router, "vad/home/status", b"fine")
        await until(lambda: ask(session, "vad/home/status") == [b"fine"], "the way is open")
        await asyncio.to_thread(kill_gate)
        await world.opened(2)
        await until(lambda: ask(session, "vad/home/status") == [b"fine"], "the way is open again")
    assert "the gate's process ended" in caplog.text


def kill_gate() -> None:
    """As if it had run out of memory."""
    os.kill(gate_pid(), signal.SIGKILL)


class Wire:
    """A TCP relay whose wire can be cut: bytes stop, connections stay, as when Wi-Fi is gone.

    Attributes:
        held: bytes that are kept back while it is cut.
        connections: how many there have been.
    """

    def __init__(self, port: int, to: tuple[str, int]) -> None:
        self.port = port
        self.whole = asyncio.Event()
        self.whole.set()
        self.held = self.connections = 0
        self._to = to
        self._links: set[asyncio.Task[None]] = set()

    def cut(self) -> None:
        self.held = 0
        self.whole.clear()

    def _accepted(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        self._links.add(asyncio.create_task(self._link(reader, writer)))

    async def _link(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            await self.whole.wait()
            far_reader, far_writer = await asyncio.open_connection(*self._to)
            try:
                async with asyncio.TaskGroup() as group:
                    group.create_task(self._carry(reader, far_writer))
                    group.create_task(self._carry(far_reader, writer))
            finally:
                far_writer.close()
        except (OSError, ExceptionGroup):
            pass  # one end has gone
        finally:
            writer.close()

    async def _carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while data := await reader.read(65536):
                if not self.whole.is_set():
                    self.held += len(data)
                    await self.whole.wait()
                writer.write(data)
                await writer.drain()
        finally:
            writer.close()

    @asynccontextmanager
    async def open(self) -> AsyncIterator[None]:
        server = await asyncio.start_server(self._accepted, "127.0.0.1", self.port)
        try:
            yield
        finally:
            server.close()
            for link in self._links:
                link.cancel()
            await asyncio.gather(*self._links, return_exceptions=True)


@pytest.mark.slow
@pytest.mark.parametrize("lost", [False, True])
async def test_the_network_is_gone_for_a_while(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lost: bool
) -> None:
    """For a moment: what was sent meanwhile arrives. Until every link is given up: they come back."""
    if lost:
        monkeypatch.setattr("vad.bus.session.LEASE_MS", LEASE_MS)
        monkeypatch.setattr("vad.bus.session.OPEN_TIMEOUT_MS", OPEN_TIMEOUT_MS)
    async with network(tmp_path, ("viewer", "tablet"), ("agent", "node")) as (world, folders):
        host, _, port = world.tls.partition("/")[2].rpartition(":")
        wire = Wire(free_port(), (host, int(port)))
        hub = HubSide(world)
        async with wire.open(), running(hub.tell()):
            sessions = [
                await asyncio.to_thread(world.connect, folder, f"tls/127.0.0.1:{wire.port}")
                for folder in folders
            ]
            away = Away(*sessions)
            try:
                async with asyncio.timeout(PATIENCE_S):
                    await away.all_well()
                away.agent.put("vad/home/agents/node/csi", b"before")
                await until(lambda: hub.heard[-1] == b"before", "nothing is under way any more")
                wire.cut()
                away.agent.put("vad/home/agents/node/csi", b"meanwhile")
                await until(lambda: wire.held > 0, "the wire keeps back what is sent")
                if lost:
                    before = wire.connections
                    await until(lambda: not any(map(linked, sessions)), "the clients gave up their links")
                    await until(lambda: wire.connections >= before + 4, "they knock in vain")
                    await until(lambda: "connected" not in world.gate.health.detail, "so did the gate")
                assert hub.heard[-1] == b"before", "nothing comes through"
                wire.whole.set()
                if not lost:
                    await until(lambda: b"meanwhile" in hub.heard, "what was kept back arrives")
                async with asyncio.timeout(PATIENCE_S):
                    await away.all_well()
                async with asyncio.timeout(PATIENCE_S):
                    while not await asyncio.to_thread(hub.answered):  # noqa: ASYNC110 - has no event
                        await asyncio.sleep(POLL_S)
            finally:
                wire.whole.set()
                for session in sessions:  # while the wire is whole: a goodbye waits
                    await asyncio.to_thread(session.close)
                world.sessions.clear()


class HubSide:
    """What the daemon does in the other test, on a session of this process."""

    def __init__(self, world: Network) -> None:
        self.heard: list[bytes] = []
        self._router = world.router
        on(world.router, "vad/home/agents/*/csi", lambda sample: self.heard.append(sample.payload.to_bytes()))
        answer(world.router, "vad/home/status", b"fine")

    def answered(self) -> bool:
        """Whether the agent answers the hub."""
        return ask(self._router, "vad/home/agents/node/alive", timeout_s=5.0) == [b"node"]

    async def tell(self) -> None:
        """The status, again and again."""
        while True:
            self._router.put("vad/home/status", f'"step":"{len(self.heard)}"'.encode())
            await asyncio.sleep(0.02)
