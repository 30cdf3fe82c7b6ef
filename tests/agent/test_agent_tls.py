"""An agent from the network: TLS, the gate, a certificate of its own, and no other agent's name."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from agent_world import HUB, KEYS, Card, hearing, router, running_node, there
from waiting import free_port, until

from vad.bus.gate import Gate, GateSettings
from vad.capture.handshake import Start, Started
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
        await until(lambda: way_in.health.counters["opened"] > 0, "the gate is open")
        yield folders
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


@pytest.mark.slow
async def test_an_agent_comes_in_with_its_own_certificate_and_under_no_other_name(tmp_path: Path) -> None:
    port, card = free_port(), Card(tmp_path / "csi.fifo")
    tls = f"tls/127.0.0.1:{free_port()}"
    with router(port) as session:
        async with (
            gate(tmp_path, port, tls, "attic", "cellar") as (attic, cellar),
            hearing(session) as agents,
            running_node(tls, tmp_path / "csi.fifo", credentials=attic) as node,
        ):
            remote = await there(agents)
            for _ in range(10):
                card.send(20)
                await asyncio.sleep(0.02)
            await until(lambda: agents.health.counters["packets"] == card.sent, "all packets")
            with agents.leading(remote, "s") as line:
                line.say([Start("s", 0)])
                await until(lambda: node.collector.recording, "the agent hears commands")
                card.send(20)
                await asyncio.sleep(0.1)
                card.send(20)
                answers: list[object] = []
                await until(lambda: bool(answers.extend(line.heard()) or answers), "and answers")
                assert isinstance(answers[0], Started)
            (token,) = session.liveliness().get(KEYS.agent_alive(), timeout=5.0)
            assert str(token.ok.key_expr) == KEYS.agent_alive("attic")
            async with running_node(
                tls, tmp_path / "x.fifo", mac="00:16:ea:00:00:02", credentials=cellar
            ) as thief:
                await until(lambda: thief.link.health.counters["met"] > 0, "it may see that the hub is there")
                await asyncio.sleep(3.0)  # more than a sign of life
                assert agents.card_of("00:16:ea:00:00:02") is None
                assert not thief.collector.clock.known
    card.close()
