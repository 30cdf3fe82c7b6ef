"""`vad agent` as a process with a clock of its own; a network that delays and breaks; the hub here."""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import zenoh
from agent_world import KEYS, MAC, Card, hearing, router, there
from waiting import free_port, until

from vad.agent.frames import Frame, decode_frame
from vad.capture.handshake import CameraSide, Message, WifiSide
from vad.csi.packets import CsiBatch
from vad.daemon.agents import Agents, Line

ROOT = Path(__file__).parents[2]
CLOCK_AHEAD_S = 86_413
"""How much the agent's clock is ahead of the hub's."""
STARTED_S = 90.0
"""A busy machine takes its time to load a program."""
GOOD_CLOCK_NS, SETTLED_S = 1_000_000, 90.0
"""An agent is there for a while before somebody walks; how long it needs, the machine and the delays say."""
BAD_NETWORK = (sys.executable, str(Path(__file__).parent / "bad_network.py"))


def other_clock() -> list[str]:
    """What goes before a command to give it another CLOCK_MONOTONIC; empty where that is not allowed."""
    command = ["unshare", "--time", "--monotonic", str(CLOCK_AHEAD_S)]
    if shutil.which("unshare") is None or subprocess.run([*command, "true"], check=False).returncode:
        return []
    return command


@dataclass
class Walk:
    """A session led by the hub, and what came of it."""

    wifi: WifiSide
    camera: CameraSide
    batches: list[CsiBatch] = field(default_factory=list)
    lost: int = 0
    to_wifi: list[Message] = field(default_factory=list)

    def say(self, line: Line, messages: list[Message]) -> None:
        """To the camera and to the agent."""
        for message in messages:
            self.to_wifi += self.camera.receive(message, time.monotonic_ns())
        line.say(messages)

    async def record(self, line: Line, finish: asyncio.Event) -> None:
        """Until it is over, as the daemon does it."""
        self.say(line, self.wifi.arm(time.monotonic_ns()))
        while self.wifi.state in ("armed", "recording", "stopping"):
            await asyncio.sleep(0.1)
            now_ns = time.monotonic_ns()
            self.to_wifi += self.camera.frame(now_ns, now_ns)
            arrived, self.to_wifi = self.to_wifi, []
            for message in arrived:
                self.say(line, self.wifi.receive(message, now_ns))
            for answer in line.heard():
                self.say(line, self.wifi.receive(answer, now_ns, line.card.id))
            self.say(line, self.wifi.tick(now_ns))
            if finish.is_set():
                self.say(line, self.wifi.finish(now_ns))
            self.batches += line.batches()
            self.lost += line.lost()


@contextlib.contextmanager
def process(*command: str | Path) -> Iterator[subprocess.Popen[str]]:
    """Ended by SIGTERM, which must do."""
    with subprocess.Popen(
        [str(c) for c in command], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT
    ) as running:
        try:
            yield running
        finally:
            running.send_signal(signal.SIGTERM)
            try:
                running.wait(30.0)  # on a busy machine
            except subprocess.TimeoutExpired:
                running.kill()
                raise


@contextlib.contextmanager
def wire_tap(session: zenoh.Session) -> Iterator[list[Frame]]:
    """Every frame that comes to the router, also those that the hub refuses."""
    frames: list[Frame] = []

    def on_frame(sample: zenoh.Sample) -> None:
        frames.append(decode_frame(sample.payload.to_bytes()))

    tap = session.declare_subscriber(KEYS.agent_csi(), zenoh.handlers.Callback(on_frame, indirect=False))
    yield frames
    tap.undeclare()


@contextlib.asynccontextmanager
async def radio(card: Card, packets_per_s: int) -> AsyncIterator[None]:
    """The card hears so much meanwhile."""

    async def play() -> None:
        begun_s, first = time.monotonic(), card.sent
        while True:
            await asyncio.sleep(0.02)
            due = int((time.monotonic() - begun_s) * packets_per_s) + first - card.sent
            if due:
                card.send(due)

    task = asyncio.create_task(play())
    try:
        yield
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def told(program: subprocess.Popen[str]) -> str:
    """The next line that it prints."""
    assert program.stdout is not None
    return (await asyncio.to_thread(program.stdout.readline)).strip()


def agent(endpoint: str, log: Path, *options: str) -> tuple[str | Path, ...]:
    """The command of an agent whose clock is another, where that is allowed."""
    program = (sys.executable, "-m", "vad", "agent")
    return (
        *other_clock(),
        *program,
        "--hub",
        endpoint,
        "--id",
        "attic",
        "--mac",
        MAC,
        "--fifo",
        log,
        *options,
    )


async def a_walk(agents: Agents, network: subprocess.Popen[str], card: Card) -> Walk:
    """A session of 12 s with a break of the network of 3 s in its middle."""
    remote, finish = await there(agents), asyncio.Event()
    walk = Walk(WifiSide("s", ("attic",)), CameraSide("s", max_record_ns=60_000_000_000))
    with agents.leading(remote, "s") as line:
        async with radio(card, 1000):
            recording = asyncio.create_task(walk.record(line, finish))
            await until(lambda: walk.wifi.state == "recording" or recording.done(), "everybody records")
            for word, lasts_s in (("mend", 3.0), ("cut", 3.0), ("mend", 6.0)):
                assert network.stdin is not None
                network.stdin.write(word + "\n")
                network.stdin.flush()
                await asyncio.sleep(lasts_s)
            finish.set()
            await recording
    return walk


@pytest.mark.slow
@pytest.mark.timeout(240)
async def test_a_session_through_a_network_that_delays_and_breaks(tmp_path: Path) -> None:
    port, card = free_port(), Card(tmp_path / "csi.dat", patient=True)
    with (
        router(port) as session,
        wire_tap(session) as frames,
        process(*BAD_NETWORK, str(port), "0.2", "1.0") as network,
        process(*agent(f"tcp/127.0.0.1:{await told(network)}", tmp_path / "csi.dat")),
    ):
        async with hearing(session) as agents:
            remote = await there(agents, timeout_s=STARTED_S)
            await until(lambda: remote.clock_error_ns < GOOD_CLOCK_NS, "the clock is known well", SETTLED_S)
            walk = await a_walk(agents, network, card)
    card.close()
    assert walk.wifi.state == "solving", walk.wifi.reason
    assert walk.camera.state == "stopped"
    assert walk.lost == 0
    numbers = np.concatenate([batch.packets.bfee_count for batch in walk.batches]).astype(int)
    assert (np.diff(numbers) % 65536 == 1).all(), "complete, each once and in order"
    times = np.concatenate([batch.packets.arrival_ns for batch in walk.batches])
    first = walk.wifi.first_ns("attic")
    assert first is not None
    # The agent knew the clock as well when it began, and may know it a little better since.
    assert np.abs(times - first).min() < GOOD_CLOCK_NS
    assert (times[-1] - times[0]) / 1e9 > 11
    assert np.diff(times).max() < 2e9, "there is no hole where the network broke"
    assert (times >= first - GOOD_CLOCK_NS).sum() >= walk.wifi.recorded("attic") > 10_000
    offset_ns = -CLOCK_AHEAD_S * 10**9 if other_clock() else 0
    with_packets = [frame for frame in frames if frame.packets]
    errors_ms = np.abs([frame.offset_ns - offset_ns for frame in with_packets]) / 1e6
    bounds_ms = np.array([frame.error_ns for frame in with_packets]) / 1e6
    assert np.quantile(errors_ms, 0.99) <= 1.0, np.quantile(errors_ms, [0.5, 0.9, 0.99, 1.0])
    assert (errors_ms <= bounds_ms + 0.001).all(), "it says how wrong it can be"
