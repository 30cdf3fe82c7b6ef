"""ICMP echo (RFC 792) as bytes, and how many of them a device and the air can take; no I/O."""

from __future__ import annotations

import struct
from collections import deque

from vad.errors import ProtocolError

_ECHO_REPLY, _ECHO_REQUEST = 0, 8
_HEADER = struct.Struct("!BBHHH")
_IP_HEADER_BYTES = 20

WINDOW_NS = 500_000_000
LOST_NS = 400_000_000
"""A request without its reply for so long is lost."""
MAX_LOSS = 0.1
MAX_QUEUE_NS = 30_000_000
"""Replies that take this much longer than the fastest stand in a queue: the air is full."""
BACK_OFF = 0.7
RECOVER = 0.05
"""Part of the wanted rate that a window without trouble gives back."""
MIN_PACKETS_PER_S = 10.0
MAX_BURST = 4
"""After a stall at most so many requests go out at once; the rest is left out."""
_FLOOR_WINDOWS = 120


def checksum(data: bytes) -> int:
    """The Internet checksum (RFC 1071) of an even or odd number of bytes."""
    padded = data + b"\0" * (len(data) % 2)
    total: int = sum(struct.unpack(f"!{len(padded) // 2}H", padded))
    while total > 0xFFFF:
        total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF


def echo_request(identifier: int, sequence: int, payload: bytes) -> bytes:
    """An ICMP echo request; a ping socket replaces identifier and checksum with its own."""
    head = _HEADER.pack(_ECHO_REQUEST, 0, 0, identifier, sequence)
    return _HEADER.pack(_ECHO_REQUEST, 0, checksum(head + payload), identifier, sequence) + payload


def reply_sequence(datagram: bytes, identifier: int | None) -> int:
    """The sequence number of an echo reply.

    Args:
        identifier: the one that was sent, for what a raw socket gives, IP header included; None for what a
            ping socket gives: the kernel has picked our own replies and removed the IP header.

    Raises ProtocolError for anything that is no echo reply to us.
    """
    start = 0
    if identifier is not None:
        if len(datagram) < _IP_HEADER_BYTES or datagram[0] >> 4 != 4:
            raise ProtocolError("no IPv4 packet")
        start = 4 * (datagram[0] & 0x0F)
    if len(datagram) < start + _HEADER.size or start < _IP_HEADER_BYTES * (identifier is not None):
        raise ProtocolError("short ICMP message")
    kind, _, _, sent_as, sequence = _HEADER.unpack_from(datagram, start)
    if kind != _ECHO_REPLY or identifier not in (None, sent_as):
        raise ProtocolError("no echo reply to us")
    return int(sequence)


class EchoPacer:
    """Says when to send and how fast: additive increase, multiplicative decrease.

    Every half second the rate drops to 70 % where more than 10 % of the requests got no reply, or where the
    fastest reply took 30 ms longer than the fastest of the last minute: then requests queue, and the air or
    the device is full. Else it goes back up by 5 % of the wanted rate. Sequence numbers are 16 bits;
    what is outstanding is bounded by rate times LOST_NS.

    Args:
        wanted_per_s: the rate without trouble.

    Attributes:
        rate_per_s: the rate now.
        sent, replies, lost, backed_off: totals.
        reply_share: replies to the requests of the last window, 0..1; None before the first.
    """

    def __init__(self, wanted_per_s: float, now_ns: int) -> None:
        self.rate_per_s = wanted_per_s
        self.sent = self.replies = self.lost = self.backed_off = 0
        self.reply_share: float | None = None
        self._wanted_per_s = wanted_per_s
        self._next_ns = now_ns
        self._window_ends_ns = now_ns + WINDOW_NS
        self._outstanding: dict[int, int] = {}  # sequence -> sent at, oldest first
        self._answered_in_window = self._lost_in_window = 0
        self._fastest_ns: int | None = None
        self._floors: deque[int] = deque(maxlen=_FLOOR_WINDOWS)

    @property
    def next_ns(self) -> int:
        """When the next request is due."""
        return self._next_ns

    @property
    def waits(self) -> bool:
        """Whether a reply is still waited for."""
        return bool(self._outstanding)

    def due(self, now_ns: int) -> list[int]:
        """The sequence numbers to send now; counts them as sent."""
        self._judge(now_ns)
        interval_ns = round(1e9 / self.rate_per_s)
        self._next_ns = max(self._next_ns, now_ns - (MAX_BURST - 1) * interval_ns)
        sequences = []
        while self._next_ns <= now_ns:
            sequence = self.sent & 0xFFFF
            self._outstanding.pop(sequence, None)
            self._outstanding[sequence] = now_ns
            self.sent += 1
            sequences.append(sequence)
            self._next_ns += interval_ns
        return sequences

    def replied(self, sequence: int, now_ns: int) -> None:
        """A reply came; one that was not waited for any more, or came twice, changes nothing."""
        sent_ns = self._outstanding.pop(sequence, None)
        if sent_ns is None:
            return
        self.replies += 1
        self._answered_in_window += 1
        took_ns = now_ns - sent_ns
        self._fastest_ns = took_ns if self._fastest_ns is None else min(self._fastest_ns, took_ns)

    def _judge(self, now_ns: int) -> None:
        """Give up what is too old; at a window's end change the rate."""
        while self._outstanding:
            sequence, sent_ns = next(iter(self._outstanding.items()))
            if now_ns - sent_ns < LOST_NS:
                break
            del self._outstanding[sequence]
            self.lost += 1
            self._lost_in_window += 1
        if now_ns < self._window_ends_ns:
            return
        ended = self._answered_in_window + self._lost_in_window
        if ended:
            self.reply_share = self._answered_in_window / ended
            if self._lost_in_window > MAX_LOSS * ended or self._queues():
                self.backed_off += 1
                self.rate_per_s = max(BACK_OFF * self.rate_per_s, min(MIN_PACKETS_PER_S, self._wanted_per_s))
            else:
                self.rate_per_s = min(self.rate_per_s + RECOVER * self._wanted_per_s, self._wanted_per_s)
        if self._fastest_ns is not None:
            self._floors.append(self._fastest_ns)
        self._fastest_ns = None
        self._answered_in_window = self._lost_in_window = 0
        self._window_ends_ns = now_ns + WINDOW_NS

    def _queues(self) -> bool:
        if self._fastest_ns is None or not self._floors:
            return False
        return self._fastest_ns - min(self._floors) > MAX_QUEUE_NS
