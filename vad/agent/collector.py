"""The agent's part without its wires: packets in, frames out, the handshake in between; no I/O, no clock."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from vad.agent.frames import MAX_FRAME_BYTES, VERSION, Ack, Command, Frame, encode_frame
from vad.agent.info import AgentInfo
from vad.agent.offset import ClockOffset
from vad.agent.outbox import Outbox
from vad.capture.handshake import REMOTE_GIVE_UP_NS, Abort, Follower, Message, Started, Stopped
from vad.csi.packets import CsiBatch
from vad.health import Health
from vad.mac import UNKNOWN_MAC

MAX_RECORD_NS = 120_000_000_000
STALL_NS = 5_000_000_000
"""A device under measurement is made to hear much more than a packet in this time."""
KEPT_SESSIONS = 16
HEARTBEAT_NS = 2_000_000_000
"""A stream without packets says this often that it goes on."""
CLOCK_ERROR_NS = 10_000_000
"""A walker moves a centimetre in this time: with a worse clock no session is begun."""


class Collector:
    """What the card gives becomes the stream; what the hub asks is answered in it.

    Times are this machine's CLOCK_MONOTONIC; the stream carries the offset to the hub's.

    Args:
        info: who this is.
        stream: a number that no other run has.
        limit_bytes: how much waits for the hub at most.
        transmitter: packets that are known to come from somebody else are left out; None: all are taken.

    Attributes:
        health: counters packets, foreign (left out), sessions, dropped_packets.
        source: health of the card; its trouble goes to the hub.
    """

    def __init__(
        self,
        info: AgentInfo,
        source: Health,
        *,
        stream: int,
        limit_bytes: int,
        transmitter: int | None = None,
    ) -> None:
        self.health = Health(f"agent {info.id}")
        self.source = source
        self.clock = ClockOffset()
        self.outbox = Outbox(stream, limit_bytes)
        self._info = info
        self._transmitter = transmitter
        self._boot: str | None = None
        self._followers: dict[str, Follower] = {}
        self._trouble = ""
        self._made_ns = 0

    @property
    def recording(self) -> bool:
        """Whether a session is under way."""
        return any(follower.recording for follower in self._followers.values())

    def take(self, batches: Sequence[CsiBatch], now_ns: int) -> None:
        """Packets of the card, in order."""
        wanted = [self._wanted(batch) for batch in batches]
        pieces = [csi_records(batch, mine) for batch, mine in zip(batches, wanted, strict=True)]
        arrivals = [batch.packets.arrival_ns[mine] for batch, mine in zip(batches, wanted, strict=True)]
        arrival_ns = np.concatenate([np.empty(0, np.int64), *arrivals])
        counters = self.health.counters
        counters["packets"] += len(arrival_ns)
        counters["foreign"] += sum(len(batch.packets) for batch in batches) - len(arrival_ns)
        if not len(arrival_ns):
            return
        sizes = np.concatenate([np.diff(np.append(starts, len(raw))) for raw, starts in pieces])
        raw = b"".join(raw for raw, _ in pieces)
        self.outbox.add_packets(raw, np.cumsum(sizes) - sizes, arrival_ns, self._trouble)
        counters["dropped_packets"] = self.outbox.dropped_packets
        self._made_ns = now_ns
        if self.clock.known and self.recording:
            offset_ns = self.clock.at(now_ns)
            first_ns, last_ns = int(arrival_ns[0]) + offset_ns, int(arrival_ns[-1]) + offset_ns
            for follower in self._followers.values():
                self._say(follower.took(first_ns, last_ns, len(arrival_ns), now_ns + offset_ns), now_ns)

    def _wanted(self, batch: CsiBatch) -> NDArray[np.bool_]:
        mac = batch.packets.mac
        if self._transmitter is None:
            return np.ones(len(mac), np.bool_)
        return np.asarray((mac == self._transmitter) | (mac == UNKNOWN_MAC))

    def told(self, command: Command, now_ns: int) -> None:
        """The hub says something."""
        if isinstance(command, Ack):
            self.outbox.confirmed(command, now_ns)
            return
        follower = self._followers.get(command.session)
        if follower is None:
            follower = self._follow(command.session)
        hub_ns = self._hub_ns(now_ns)
        self._say(follower.receive(command, hub_ns), now_ns)
        if follower.state == "armed" and (trouble := self._trouble or self._clock_trouble(now_ns)):
            self._say(follower.give_up(trouble, hub_ns), now_ns)

    def _clock_trouble(self, now_ns: int) -> str:
        """Why times are not good enough for a session; empty where they are."""
        if not self.clock.known:
            return "its clock has not been compared with the hub's yet"
        error_ns = self.clock.error_ns(now_ns)
        if error_ns <= CLOCK_ERROR_NS:
            return ""
        return f"its clock is only known to {error_ns / 1e6:.0f} ms: the network delays too much"

    def _follow(self, session: str) -> Follower:
        while len(self._followers) >= KEPT_SESSIONS:
            del self._followers[next(iter(self._followers))]
        follower = Follower(
            session,
            thing="packet",
            max_record_ns=MAX_RECORD_NS,
            silent_ns=REMOTE_GIVE_UP_NS,
            stall_ns=STALL_NS,
        )
        self._followers[session] = follower
        self.health.counters["sessions"] += 1
        return follower

    def tick(self, now_ns: int) -> None:
        """Time passes: sessions that nobody ends, trouble of the card, a sign of life."""
        for follower in self._followers.values():
            self._say(follower.tick(self._hub_ns(now_ns)), now_ns)
        trouble = "" if self.source.state in ("ok", "starting") else self.source.detail[:500]
        if trouble != self._trouble or now_ns - self._made_ns >= HEARTBEAT_NS:
            self._trouble = trouble
            self.outbox.add_answers((), now_ns, trouble)
            self._made_ns = now_ns

    def compared(self, asked_ns: int, hub_ns: int, answered_ns: int, boot: str) -> None:
        """The hub told its clock. boot: names its timeline."""
        if boot != self._boot:
            for follower in self._followers.values():  # their times are of the old timeline
                self._say(follower.give_up("the hub was restarted", self._hub_ns(answered_ns)), answered_ns)
            self._boot = boot
            self.clock.forget()
        self.clock.add(asked_ns, hub_ns, answered_ns)

    def next_frame(self, now_ns: int) -> bytes | None:
        """The next frame to be sent now; None where none is due, or the hub's clock is not known."""
        if not self.clock.known:
            return None
        draft = self.outbox.next(now_ns)
        if draft is None:
            return None
        frame = Frame(
            version=VERSION,
            stream=self.outbox.stream,
            seq=draft.seq,
            oldest=self.outbox.oldest,
            before=draft.before,
            given_up=self.outbox.dropped_packets,
            offset_ns=self.clock.at(draft.first_ns),
            error_ns=self.clock.error_ns(draft.first_ns),
            mac=self._info.mac,
            carrier_hz=self._info.carrier_hz,
            bandwidth_mhz=self._info.bandwidth_mhz,
            arrival_ns=draft.arrival_ns,
            raw=draft.raw,
            answers=draft.answers,
            trouble=draft.trouble,
        )
        payload = encode_frame(frame)
        assert len(payload) <= MAX_FRAME_BYTES
        return payload

    def _hub_ns(self, now_ns: int) -> int:
        return now_ns + (self.clock.at(now_ns) if self.clock.known else 0)

    def _say(self, messages: Sequence[Message], now_ns: int) -> None:
        answers = [message for message in messages if isinstance(message, Started | Stopped | Abort)]
        if answers:
            shortened = [
                msgspec.structs.replace(a, reason=a.reason[:500]) if isinstance(a, Abort) else a
                for a in answers
            ]
            self.outbox.add_answers(shortened, now_ns, self._trouble)
            self._made_ns = now_ns


def csi_records(batch: CsiBatch, wanted: NDArray[np.bool_]) -> tuple[bytes, NDArray[np.int64]]:
    """The 0xBB records of the wanted packets (N,), one after the other, and where each starts."""
    data = np.frombuffer(batch.raw, np.uint8)
    starts = batch.raw_offsets[wanted]
    ends = starts + 2 + (data[starts].astype(np.int64) << 8 | data[starts + 1])
    sizes = ends - starts
    if sizes.sum() == len(batch.raw):
        return batch.raw, starts  # there is nothing else in it
    view = memoryview(batch.raw)
    records = [view[a:b] for a, b in zip(starts.tolist(), ends.tolist(), strict=True)]
    return b"".join(records), np.cumsum(sizes) - sizes
