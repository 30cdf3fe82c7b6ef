"""An agent and its hub over a real router in one process: the stream, the clock, the handshake, breaks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from agent_world import (
    KEYS,
    MAC,
    Card,
    answered,
    good_clock,
    hearing,
    router,
    running_node,
    send,
    there,
)
from bad_network import BadNetwork
from waiting import free_port, running, until

from vad.agent.frames import MAX_FRAME_BYTES
from vad.agent.info import decode_info
from vad.capture.handshake import Abort, Going, Start, Started, Stop, Stopped
from vad.csi.packets import CsiBatch
from vad.daemon.agents import HEARD_OVER_NS
from vad.mac import mac_from_text

SECOND_NS = 1_000_000_000


def numbers_of(batches: list[CsiBatch]) -> list[int]:
    """The numbers of all packets."""
    return np.concatenate([b.packets.bfee_count for b in batches]).tolist() if batches else []


async def test_what_the_card_hears_arrives_at_the_hub_in_its_time(tmp_path: Path) -> None:
    port, card = free_port(), Card(tmp_path / "csi.fifo")
    with router(port) as session:
        async with hearing(session) as agents, running_node(port, tmp_path / "csi.fifo"):
            remote = await there(agents)
            with agents.leading(remote, "s") as line:
                await send(card, 10)
                await until(lambda: agents.health.counters["packets"] == 200, "all packets")
                await until(lambda: remote.clock_error_ns < SECOND_NS / 100, "the clock is known well")
                batches = line.batches()
            assert numbers_of(batches) == list(range(200))
            packets = batches[0].packets
            assert (packets.mac == mac_from_text(MAC)).all()
            assert packets.csi.shape[1:] == (30, 3, 2)
            assert remote.id == "attic"
            last = [int(batch.packets.arrival_ns[-1]) for batch in batches]
            recent = [b for b, t_ns in zip(batches, last, strict=True) if last[-1] - t_ns <= HEARD_OVER_NS]
            assert remote.heard_per_s(last[-1]) == sum(len(batch.packets) for batch in recent) / 2
            assert agents.health.state == "ok"
            (reply,) = session.get(KEYS.agent_alive("attic"), timeout=40.0)
            assert decode_info(reply.ok.payload.to_bytes()).mac == MAC
            tokens = list(session.liveliness().get(KEYS.agent_alive(), timeout=40.0))
            assert [str(t.ok.key_expr) for t in tokens] == [KEYS.agent_alive("attic")]
    card.close()


async def test_a_session_is_acknowledged_with_clock_and_first_packet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port, card = free_port(), Card(tmp_path / "csi.fifo")
    with router(port) as session:
        async with hearing(session) as agents, running_node(port, tmp_path / "csi.fifo") as node:
            remote = await there(agents)
            await good_clock(node)
            # What is known of the clock stays as it is: between a session's start and the sending of its
            # first packets it might become a little better known.
            monkeypatch.setattr("vad.agent.offset.SLEW", 0.0)
            monkeypatch.setattr("vad.agent.offset.STEP_NS", SECOND_NS)
            with agents.leading(remote, "s") as line:
                line.say([Start("s", 0)])
                await until(lambda: node.collector.recording, "the agent is armed")
                async with running(send(card)):
                    (started,) = await answered(line)
                    assert isinstance(started, Started), started
                    times = np.concatenate([b.packets.arrival_ns for b in line.batches()])
                    assert started.first_frame_ns in times.tolist()
                    line.say([Going("s"), Going("s")])
                    for again in await answered(line, 2):
                        assert isinstance(again, Started), again
                        assert again.first_frame_ns == started.first_frame_ns
                    line.say([Stop("s")])
                    (stopped,) = await answered(line)
                assert isinstance(stopped, Stopped), stopped
                assert 0 < stopped.frames <= card.sent
                assert stopped.first_frame_ns == started.first_frame_ns
                assert stopped.last_frame_ns > started.first_frame_ns
                line.say([Start("s", 0), Stop("s")])
                assert await answered(line) == [stopped], "an ended session does not begin again"
                assert line.lost() == 0
    card.close()


async def test_a_recording_that_the_hub_knows_nothing_of_is_ended(tmp_path: Path) -> None:
    port, card = free_port(), Card(tmp_path / "csi.fifo")
    with router(port) as session:
        async with hearing(session) as agents, running_node(port, tmp_path / "csi.fifo") as node:
            await there(agents)
            await good_clock(node)
            agents.command("attic", Start("lost", 0))
            await until(lambda: node.collector.recording, "it has begun")
            async with running(send(card)):
                await until(lambda: not node.collector.recording, "the hub calls it off")
            assert "the hub does not know this session" in node.collector._followers["lost"].reason
    card.close()


async def test_a_card_that_cannot_be_read_is_told_with_its_reason(tmp_path: Path) -> None:
    port = free_port()
    with router(port) as session:
        async with hearing(session) as agents, running_node(port, tmp_path / "none.fifo"):
            remote = await there(agents)
            await until(lambda: "none.fifo" in remote.trouble, "the reason")
            await until(lambda: "attic: Cannot read" in agents.health.detail, "it shows in the status")
            with agents.leading(remote, "s") as line:
                line.say([Start("s", 0)])
                (told,) = await answered(line)
                assert isinstance(told, Abort), told
                assert "Cannot read the CSI log" in told.reason


async def test_nothing_is_lost_through_a_short_break(tmp_path: Path) -> None:
    port, card = free_port(), Card(tmp_path / "csi.fifo")
    network = BadNetwork(port, share=0.0)
    with router(port) as session:
        async with (
            network.running(),
            hearing(session) as agents,
            running_node(network.port, tmp_path / "csi.fifo") as node,
        ):
            remote = await there(agents)
            with agents.leading(remote, "s") as line:
                await send(card, 20)
                network.cut()
                await send(card, 20)
                network.mend()
                await send(card, 20)
                await until(lambda: agents.health.counters["packets"] == card.sent, "all packets")
                assert numbers_of(line.batches()) == list(range(card.sent))
                assert line.lost() == 0
            await until(lambda: node.link.health.counters["met"] >= 2, "it met the hub again")
            assert node.collector.health.counters["dropped_packets"] == 0
    card.close()


@pytest.mark.slow
async def test_what_a_small_buffer_dropped_in_a_break_is_counted_exactly(tmp_path: Path) -> None:
    port, card = free_port(), Card(tmp_path / "csi.fifo")
    network = BadNetwork(port, share=0.0)
    with router(port) as session:
        async with (
            network.running(),
            hearing(session) as agents,
            running_node(network.port, tmp_path / "csi.fifo", buffer_bytes=100_000) as node,
        ):
            remote = await there(agents)
            counters = agents.health.counters
            with agents.leading(remote, "s") as line:
                await send(card, 10)
                network.cut()
                await send(card, 60)
                network.mend()
                await send(card, 10)
                await until(lambda: counters["packets"] + counters["lost"] == card.sent, "an exact count")
                arrived = numbers_of(line.batches())
                assert line.lost() == counters["lost"] > 500
            assert sorted(set(arrived)) == arrived
            assert len(arrived) == counters["packets"]
            assert counters["lost"] <= node.collector.outbox.dropped_packets
    card.close()


async def test_an_agent_starts_before_its_hub_and_outlives_it(tmp_path: Path) -> None:
    port, card = free_port(), Card(tmp_path / "csi.fifo")
    async with running_node(port, tmp_path / "csi.fifo") as node:
        card.send(20)
        await until(lambda: node.link.health.state == "degraded", "it says that there is no hub")
        for _ in range(2):
            with router(port) as session:
                async with hearing(session) as agents:
                    await there(agents)
                    card.send(20)
                    await until(lambda: agents.health.counters["packets"] >= 20, "CSI")
                    assert agents.health.counters["packets"] <= card.sent
                    assert agents.health.counters["lost"] == 0
    card.close()


async def test_an_agent_that_went_away_is_said_to_be_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = free_port()
    with router(port) as session:
        async with hearing(session) as agents:
            assert agents.why_away(MAC) == ""
            async with running_node(port, tmp_path / "none.fifo"):
                await there(agents)
            monkeypatch.setattr("vad.daemon.agents.SILENT_NS", SECOND_NS // 2)
            await until(lambda: agents.card_of(MAC) is None, "it is gone")
            assert agents.why_away(MAC) == "its agent attic is away"
            await until(lambda: agents.health.detail == "attic: away", "the status says so")


async def test_two_agents_cannot_have_one_card(tmp_path: Path) -> None:
    port = free_port()
    with router(port) as session:
        async with hearing(session) as agents, running_node(port, tmp_path / "none.fifo"):
            await there(agents)
            async with running_node(port, tmp_path / "none.fifo", name="thief"):
                await until(lambda: agents.health.counters["strangers"] > 0, "the second one is refused")
                assert (await there(agents)).id == "attic"


async def test_garbage_on_an_agents_key_is_counted_and_harms_nobody(tmp_path: Path) -> None:
    port, card = free_port(), Card(tmp_path / "csi.fifo")
    with router(port) as session:
        async with hearing(session) as agents, running_node(port, tmp_path / "csi.fifo") as node:
            await there(agents)
            for payload in (b"", b"garbage", bytes(MAX_FRAME_BYTES + 1)):
                session.put(KEYS.agent_csi("attic"), payload)
            session.put(KEYS.agent_cmd("attic"), b"garbage")
            counters = agents.health.counters
            await until(lambda: counters["bad_frames"] == 2 and counters["too_big"] == 1, "all are counted")
            await until(lambda: node.link.health.counters["bad_commands"] == 1, "and the agent's")
            await send(card, 2)
            await until(lambda: counters["packets"] == 40, "CSI goes on")
    card.close()
