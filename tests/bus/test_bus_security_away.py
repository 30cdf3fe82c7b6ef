"""The hub's router restarted, the gate killed, the network gone: clients and agents are back without help."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import pytest
import zenoh
from bus_world import ROOT
from security_world import Network, answer, ask, gate_pid, network, on
from waiting import free_port, until

from vad.bus.session import LEASE_MS, BusSettings, open_session
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
        self.commands = 0
        self.steps: list[str] = []
        on(viewer, "vad/home/status", lambda sample: self.steps.append(sample.payload.to_bytes().decode()))
        on(agent, "vad/home/agents/node/cmd", self._command)
        answer(agent, "vad/home/agents/node/alive", b"node")
        self._token = agent.liveliness().declare_token("vad/home/agents/node/alive")

    def _command(self, _: zenoh.Sample) -> None:
        self.commands += 1

    def all_well(self) -> bool:
        """The viewer asks and hears; the agent is heard."""
        self.agent.put("vad/home/agents/node/csi", b"packets")
        heard = len(self.steps)
        if not ask(self.viewer, "vad/home/status"):
            return False
        until_s = time.monotonic() + 0.3
        while time.monotonic() < until_s:
            self.agent.put("vad/home/agents/node/csi", b"packets")
            if len(self.steps) > heard and '"step":"0"' not in self.steps[-1]:
                return True
            time.sleep(0.01)
        return False


async def all_well(away: Away, within_s: float) -> float:
    """Wait until everything works; the seconds it took."""
    begun = time.monotonic()
    async with asyncio.timeout(within_s):
        while not await asyncio.to_thread(away.all_well):
            pass
    return time.monotonic() - begun


@pytest.mark.slow
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
        await all_well(away, 10)
        for pause_s in (0.0, 3.0):
            process.kill()
            await process.wait()
            await asyncio.sleep(pause_s)
            assert not await asyncio.to_thread(away.all_well)
            process = await asyncio.create_subprocess_exec(*command, cwd=ROOT)
            assert await all_well(away, 20) < 10
    finally:
        process.kill()
        await process.wait()
        for session in sessions:
            await asyncio.to_thread(session.close)


async def opened(settings: BusSettings) -> zenoh.Session:
    """A session to a hub that is coming up."""
    async with asyncio.timeout(15):
        while True:
            with suppress(VadError):
                return await asyncio.to_thread(open_session, settings)
            await asyncio.sleep(0.05)


async def test_a_killed_gate_comes_back_by_itself(tmp_path: Path) -> None:
    async with network(tmp_path, ("viewer", "tablet")) as (world, (tablet,)):
        session = await asyncio.to_thread(world.connect, tablet)
        answer(world.router, "vad/home/status", b"fine")
        await until(lambda: ask(session, "vad/home/status") == [b"fine"], "the way is open")
        await asyncio.to_thread(kill_gate)
        await world.opened(2)
        await until(lambda: ask(session, "vad/home/status") == [b"fine"], "the way is open again")
        assert "ended" in world.gate.health.last_error


def kill_gate() -> None:
    """As if it had run out of memory."""
    os.kill(gate_pid(), signal.SIGKILL)


class Wire:
    """A TCP relay whose wire can be cut: bytes stop, connections stay, as when Wi-Fi is gone."""

    def __init__(self, port: int, to: tuple[str, int]) -> None:
        self.port = port
        self.whole = asyncio.Event()
        self.whole.set()
        self._to = to
        self._tasks: set[asyncio.Task[None]] = set()

    async def _accepted(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await self.whole.wait()
        with suppress(OSError):
            far_reader, far_writer = await asyncio.open_connection(*self._to)
            both = (self._carry(reader, far_writer), self._carry(far_reader, writer))
            self._tasks |= {asyncio.create_task(one) for one in both}

    async def _carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while data := await reader.read(65536):
                await self.whole.wait()
                writer.write(data)
                await writer.drain()
        except OSError:
            pass
        finally:
            writer.close()

    @asynccontextmanager
    async def open(self) -> AsyncIterator[None]:
        server = await asyncio.start_server(self._accepted, "127.0.0.1", self.port)
        try:
            yield
        finally:
            server.close()
            self.whole.set()
            for task in self._tasks:
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)


@pytest.mark.slow
@pytest.mark.timeout(180)
@pytest.mark.parametrize("gone_s", [2.0, 60.0])
async def test_the_network_is_gone_for_a_while(tmp_path: Path, gone_s: float) -> None:
    async with network(tmp_path, ("viewer", "tablet"), ("agent", "node")) as (world, folders):
        host, _, port = world.tls.partition("/")[2].rpartition(":")
        wire = Wire(free_port(), (host, int(port)))
        async with wire.open():
            hub = HubSide(world)
            sessions = [
                await asyncio.to_thread(world.connect, folder, f"tls/127.0.0.1:{wire.port}")
                for folder in folders
            ]
            away = Away(*sessions)
            telling = asyncio.create_task(hub.tell())
            try:
                await all_well(away, 10)
                wire.whole.clear()
                await asyncio.sleep(gone_s)
                heard = hub.heard
                await asyncio.sleep(0.1)
                assert hub.heard == heard, "nothing comes through"
                wire.whole.set()
                took_s = await all_well(away, 20)
            finally:
                telling.cancel()
                for session in sessions:  # while the wire is whole: a goodbye waits
                    await asyncio.to_thread(session.close)
                world.sessions.clear()
        assert took_s < 2 * LEASE_MS / 1000


class HubSide:
    """What the daemon does in the other test, on a session of this process."""

    def __init__(self, world: Network) -> None:
        self.heard = 0
        self._router = world.router
        on(world.router, "vad/home/agents/*/csi", self._hear)
        answer(world.router, "vad/home/status", b"fine")

    def _hear(self, _: zenoh.Sample) -> None:
        self.heard += 1

    async def tell(self) -> None:
        """The status, whenever it changed."""
        while True:
            self._router.put("vad/home/status", f'"step":"{self.heard}"'.encode())
            await asyncio.sleep(0.02)
