"""The hub's side of its agents: their CSI comes in like the local card's, and they are led in a session."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import zenoh
from zenoh import handlers

from vad.agent.frames import (
    COMMAND_ENCODING,
    MAX_FRAME_BYTES,
    TIME_ENCODING,
    Command,
    Frame,
    HubTime,
    decode_frame,
    encode_command,
    encode_time,
)
from vad.agent.inbox import Inbox
from vad.bus.keys import HubKeys, parse_key
from vad.capture.handshake import Answer, Message, no_such_session
from vad.csi.logfile import LogReader
from vad.csi.packets import CsiBatch
from vad.errors import ProtocolError
from vad.handover import Handover, Intake
from vad.health import Health
from vad.mac import mac_from_text
from vad.streams import DropOldestQueue

log = logging.getLogger(__name__)

MAX_AGENTS = 32
HEARD_OVER_NS = 2_000_000_000
QUEUED_BATCHES = 4096
"""Minutes of a session's batches: what a disk may hold up without a loss."""
ACK_S = 0.1
"""Confirmations are collected for this long: an agent may have seconds of frames under way."""
SILENT_NS = 10_000_000_000
"""An agent says something every two seconds; one that is silent for this long is away."""
FUTURE_NS = 1_000_000_000
PAST_NS = 900_000_000_000
"""Packets from outside of this span have a wrong clock; an agent's buffer holds minutes."""
FRAMES = Intake(max_bytes=MAX_FRAME_BYTES, per_s=2000.0, burst=1000, waiting=512)
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


@dataclass(slots=True)
class RemoteCard:
    """What the hub knows of one agent's card.

    Attributes:
        id, mac: the agent; the device.
        carrier_hz, bandwidth_mhz: its channel.
        heard_ns: when its last frame came.
        clock_error_ns: how wrong its times can be.
        trouble: why it has no CSI, as it says.
        inbox: its stream, with counters.
        recent: times and numbers of packets.
    """

    id: str
    mac: str
    carrier_hz: float = 0.0
    bandwidth_mhz: int = 0
    heard_ns: int = 0
    clock_error_ns: int = 0
    trouble: str = ""
    inbox: Inbox = field(default_factory=Inbox)
    reader: LogReader = field(default_factory=LogReader)
    recent: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=400))

    def heard_per_s(self, now_ns: int) -> float:
        """Packets per second over the last two seconds."""
        return sum(n for t_ns, n in self.recent if now_ns - t_ns <= HEARD_OVER_NS) / (HEARD_OVER_NS / 1e9)

    def there(self, now_ns: int) -> bool:
        """Whether it has been heard of late."""
        return now_ns - self.heard_ns <= SILENT_NS


class Line:
    """A session's line to one agent: what is said goes out at once, what it answers waits to be taken."""

    def __init__(self, agents: Agents, card: RemoteCard) -> None:
        self.card = card
        self._agents = agents
        self._answers: list[Answer] = []
        self._batches: DropOldestQueue[CsiBatch] = DropOldestQueue(QUEUED_BATCHES)
        self._lost = 0

    def batches(self) -> list[CsiBatch]:
        """What has come since the last call, in order; arrival_ns on the hub's timeline, mac the agent's."""
        return self._batches.drain()

    def lost(self) -> int:
        """Packets given up on their way since the last call."""
        lost, self._lost = self._lost, 0
        return lost

    def say(self, messages: Sequence[Message]) -> None:
        """Send the leader's messages; what gets lost is said again by the leader."""
        for message in messages:
            self._agents.command(self.card.id, message)

    def heard(self) -> list[Answer]:
        """What the agent answered since the last call, in order, each after the packets before it."""
        answers, self._answers = self._answers, []
        return answers

    def take(self, batch: CsiBatch | None, lost: int) -> None:
        """Keep packets for `batches`, and how many are missing before them."""
        self._lost += lost
        if batch is not None:
            self._batches.put(batch)

    def answer(self, answer: Answer) -> None:
        """Keep an answer for `heard`."""
        self._answers.append(answer)


class Agents:
    """All agents of this hub; used on one event loop.

    `health.counters`: packets, lost; frames: repeated, early, bad_frames, bad_times, strangers (which claim
    another agent's card), and those of vad.handover.
    """

    def __init__(self, keys: HubKeys) -> None:
        self.health = Health("csi.agents")
        self._keys = keys
        self._session: zenoh.Session | None = None
        self._cards: dict[str, RemoteCard] = {}
        self._lines: dict[tuple[str, str], Line] = {}
        self._ack_timers: dict[str, asyncio.TimerHandle] = {}
        self.health.ok("no agent has been heard")

    def card_of(self, mac: str) -> RemoteCard | None:
        """The agent whose card has this address; None where no agent does, or it is away."""
        now_ns = time.monotonic_ns()
        return next((card for card in self._cards.values() if card.mac == mac and card.there(now_ns)), None)

    def why_away(self, mac: str) -> str:
        """Why an agent's card that was there gives nothing; empty for any other address."""
        return next((f"its agent {card.id} is away" for card in self._cards.values() if card.mac == mac), "")

    @contextlib.contextmanager
    def leading(self, card: RemoteCard, session: str) -> Iterator[Line]:
        """A line to the agent for one session; answers to sessions without a line are told off."""
        line = self._lines[card.id, session] = Line(self, card)
        try:
            yield line
        finally:
            del self._lines[card.id, session]

    async def run(self, session: zenoh.Session) -> None:
        """Take what agents send until cancelled; the session stays the caller's."""
        loop = asyncio.get_running_loop()
        boot = (await asyncio.to_thread(BOOT_ID.read_text)).strip()
        handovers: dict[str, Handover] = {}

        def on_frame(sample: zenoh.Sample) -> None:
            # zenoh's thread: one link's samples come one after the other, so nobody else adds this agent.
            key = parse_key(str(sample.key_expr))
            if key is None:
                return
            agent = key.name
            handover = handovers.get(agent)
            if handover is None:
                if len(handovers) >= MAX_AGENTS:
                    return
                take = partial(self._frame, agent)
                handover = handovers[agent] = Handover(loop, take, FRAMES, self.health.counters)
            handover(sample.payload)

        def on_clock(query: zenoh.Query) -> None:
            with query, contextlib.suppress(zenoh.ZError):
                payload = encode_time(HubTime(time.monotonic_ns(), boot))
                query.reply(query.key_expr, payload, encoding=TIME_ENCODING, express=True)

        self._session = session
        # indirect=False: no Python thread of its own
        frames = session.declare_subscriber(
            self._keys.agent_csi(), handlers.Callback(on_frame, indirect=False)
        )
        clock = session.declare_queryable(
            self._keys.agent_clock(), handlers.Callback(on_clock, indirect=False), complete=True
        )
        try:
            while True:
                self._tell(time.monotonic_ns())
                await asyncio.sleep(1.0)
        finally:
            self._session = None
            for timer in self._ack_timers.values():
                timer.cancel()
            self._ack_timers.clear()
            for entity in (frames, clock):
                with contextlib.suppress(zenoh.ZError):  # the session may be closed already
                    entity.undeclare()  # type: ignore[no-untyped-call]

    def command(self, agent: str, command: Command | Message) -> None:
        """Send a command; it may get lost."""
        if self._session is None:
            return
        try:
            self._session.put(
                self._keys.agent_cmd(agent),
                encode_command(command),
                encoding=COMMAND_ENCODING,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.INTERACTIVE_HIGH,
                express=True,
            )
        except zenoh.ZError as error:
            log.debug("a command was lost: %s", error)

    def _frame(self, agent: str, payload: bytes, arrival_ns: int) -> None:
        counters = self.health.counters
        try:
            frame = decode_frame(payload)
        except ProtocolError as error:
            self._refuse("bad_frames", f"agent {agent}: {error}")
            return
        card = self._cards.get(agent)
        if card is None or card.mac != frame.mac:
            other = self.card_of(frame.mac)
            if other is not None and other.id != agent:
                self._refuse("strangers", f"agent {agent} claims {frame.mac}, the card of agent {other.id}")
                return
            card = self._cards[agent] = RemoteCard(agent, frame.mac)
            log.info("agent %s is there: %s", agent, frame.mac)
        card.heard_ns = arrival_ns
        before = card.inbox.lost
        fresh = card.inbox.take(frame)
        self._ack_soon(card)
        if not fresh:
            return
        card.carrier_hz, card.bandwidth_mhz = frame.carrier_hz, frame.bandwidth_mhz
        card.clock_error_ns, card.trouble = frame.error_ns, frame.trouble
        lost = card.inbox.lost - before
        counters["lost"] += lost
        batch = self._batch(card, frame, arrival_ns)
        if batch is not None:
            counters["packets"] += frame.packets
            card.recent.append((int(batch.packets.arrival_ns[-1]), frame.packets))
        for (its, _), line in self._lines.items():
            if its == agent:
                line.take(batch, lost)
        for answer in frame.answers:
            asked = self._lines.get((agent, answer.session))
            if asked is not None:
                asked.answer(answer)
                continue
            for message in no_such_session(answer):
                self.command(agent, message)

    def _batch(self, card: RemoteCard, frame: Frame, now_ns: int) -> CsiBatch | None:
        """The frame's packets like those of a card of our own; None where there are none, or none usable."""
        if not frame.packets:
            return None
        card.reader.restart()  # frames hold whole records: a broken one spoils no other
        batch = card.reader.feed(frame.raw)
        arrival_ns = frame.arrivals()
        if len(batch.packets) != frame.packets or len(batch.raw) != len(frame.raw):
            self._refuse("bad_frames", f"agent {card.id}: a frame's records and times do not fit")
            return None
        if arrival_ns.max() > now_ns + FUTURE_NS or arrival_ns.min() < now_ns - PAST_NS:
            self._refuse("bad_times", f"agent {card.id}: packets come from another time")
            return None
        mac = np.full(frame.packets, mac_from_text(card.mac), np.int64)
        packets = replace(batch.packets, arrival_ns=arrival_ns, mac=mac)
        return CsiBatch(packets, batch.raw, batch.raw_offsets)

    def _refuse(self, counter: str, reason: str) -> None:
        level = logging.DEBUG if self.health.counters[counter] else logging.WARNING
        self.health.counters[counter] += 1
        log.log(level, "%s", reason)

    def _ack_soon(self, card: RemoteCard) -> None:
        if card.id not in self._ack_timers:
            loop = asyncio.get_running_loop()
            self._ack_timers[card.id] = loop.call_later(ACK_S, self._ack, card.id)

    def _ack(self, agent: str) -> None:
        self._ack_timers.pop(agent, None)
        ack = self._cards[agent].inbox.ack
        if ack is not None:
            self.command(agent, ack)

    def _tell(self, now_ns: int) -> None:
        """How the agents are, in one line."""
        if not self._cards:
            return
        counters = self.health.counters
        for name in ("repeated", "early"):
            counters[name] = sum(getattr(card.inbox, name) for card in self._cards.values())
        wrong = {
            card.id: "away" if not card.there(now_ns) else card.trouble
            for card in self._cards.values()
            if card.trouble or not card.there(now_ns)
        }
        if not wrong:
            cards = self._cards.values()
            self.health.ok("; ".join(f"{c.id} clock ±{c.clock_error_ns / 1e6:.1f} ms" for c in cards))
            return
        text = "; ".join(f"{agent}: {reason}" for agent, reason in wrong.items())
        if self.health.trouble(text):
            log.warning("agents: %s", text)
