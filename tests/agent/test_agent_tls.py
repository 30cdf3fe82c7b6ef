"""An agent from the network: TLS, the gate, a certificate of its own, and no other agent's name."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
import zenoh
from agent_world import (
    HUB,
    KEYS,
    Card,
    answered,
    good_clock,
    hearing,
    router,
    running_node,
    send,
    there,
)
from waiting import free_port, running, until

from vad.agent.frames import VERSION, Frame, encode_frame
from vad.bus.gate import Gate, GateSettings
from vad.bus.session import BusSettings, open_session
from vad.capture.handshake import Start, Started
from vad.daemon.agents import Agents
from vad.pki.certificates import CLIENT_DAYS, utc_now
from vad.pki.credentials import write_credentials
from vad.pki.folder import PkiFolder


@contextlib.asynccontextmanager
async def gate(folder: Path, port: int, tls: str, *names: str) -> AsyncIterator[list[Path]]:
    """The way in, and a folder of credentials for each agent."""
    pki = PkiFolder(folder / "pki")
    pki.init(HUB, ["localhost", "127.0.0.1"], utc_now())
    folders = []
    for name in names:
        folders.append(folder / name)
        issued = pki.issue("agent", name, CLIENT_DAYS, utc_now())
        write_credentials(folders[-1], issued, pki.authority_certificate(), tls)
    way_in = Gate(GateSettings(HUB, (tls,), f"tcp/127.0.0.1:{port}"), pki)
    task = asyncio.create_task(way_in.run())
    try:
        await until(lambda: way_in.health.counters["opened"] > 0, "the gate is open", 120.0)
        yield folders
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


def frame(name: str, mac: str) -> bytes:
    """A sign of life of an agent whose card has this address."""
    return encode_frame(
        Frame(
            version=VERSION,
            stream=len(name),
            seq=0,
            oldest=0,
            before=0,
            given_up=0,
            offset_ns=0,
            error_ns=0,
            mac=mac,
            carrier_hz=5.2e9,
            bandwidth_mhz=20,
        )
    )


@contextlib.asynccontextmanager
async def client(tls: str, credentials: Path) -> AsyncIterator[zenoh.Session]:
    """A session of somebody's own."""
    settings = BusSettings(hub=HUB, mode="client", connect=(tls,), credentials=credentials)
    session = await asyncio.to_thread(open_session, settings)
    try:
        yield session
    finally:
        await asyncio.to_thread(session.close)


@pytest.mark.slow
async def test_an_agent_comes_in_with_its_own_certificate_and_under_no_other_name(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    port, card = free_port(), Card(tmp_path / "csi.fifo")
    tls = f"tls/127.0.0.1:{free_port()}"
    with router(port) as session:
        async with (
            gate(tmp_path, port, tls, "attic", "cellar") as (attic, cellar),
            hearing(session) as agents,
            running_node(tls, tmp_path / "csi.fifo", credentials=attic) as node,
        ):
            remote = await there(agents)
            await good_clock(node)
            await send(card, 10)
            await until(lambda: agents.health.counters["packets"] == card.sent, "all packets")
            with agents.leading(remote, "s") as line:
                line.say([Start("s", 0)])
                await until(lambda: node.collector.recording, "the agent hears commands")
                async with running(send(card)):
                    (started,) = await answered(line)
                assert isinstance(started, Started), started
            (token,) = session.liveliness().get(KEYS.agent_alive(), timeout=40.0)
            assert str(token.ok.key_expr) == KEYS.agent_alive("attic")
            await no_other_name(agents, tls, cellar, tmp_path, caplog)
    card.close()


async def no_other_name(
    agents: Agents, tls: str, cellar: Path, folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """With the cellar's certificate nobody is the attic."""
    thief_mac, own_mac = "00:16:ea:00:00:02", "00:16:ea:00:00:03"
    async with running_node(tls, folder / "x.fifo", mac=thief_mac, credentials=cellar) as thief:
        await until(lambda: thief.link.health.counters["met"] > 0, "it may see that the hub is there")
        stopped = f"may not Query on '{KEYS.agent_clock('attic')}'"
        await until(lambda: stopped in caplog.text, "the gate stops its question for the hub's time")
        assert not thief.collector.clock.known
    async with client(tls, cellar) as own:

        def own_arrives() -> bool:
            own.put(KEYS.agent_csi("attic"), frame("attic", thief_mac))
            own.put(KEYS.agent_csi("cellar"), frame("cellar", own_mac))
            return agents.card_of(own_mac) is not None

        await until(own_arrives, "what it says for itself arrives")
        assert agents.card_of(thief_mac) is None, "what it said for the attic before did not"
        stopped = f"may not Put on '{KEYS.agent_csi('attic')}'"
        await until(lambda: stopped in caplog.text, "the gate stopped it")
