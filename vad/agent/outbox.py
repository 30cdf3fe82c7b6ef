"""What an agent has to send, until the hub has it: bounded, in order, sent again where need be; no I/O."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vad.agent.frames import MAX_RAW_BYTES, Ack
from vad.capture.handshake import Answer

WINDOW_FRAMES = 64
"""Frames under way at once: what a network that delays by a second needs at 50 ms a frame, thrice."""
AGAIN_NS = 2_500_000_000
"""Without news of what was sent, it is sent again after this long: twice a delay of a second, and some."""
AGAIN_LAST_NS = 10_000_000_000
_DRAFT_BYTES = 400
"""What a frame costs beside its packets."""


@dataclass(frozen=True, slots=True)
class Draft:
    """A frame but for what is known only when it is sent. first_ns: of its packets, or when it was made."""

    seq: int
    before: int
    first_ns: int
    arrival_ns: bytes
    raw: bytes
    answers: tuple[Answer, ...]
    trouble: str

    @property
    def packets(self) -> int:
        return len(self.arrival_ns) // 8

    @property
    def size(self) -> int:
        return len(self.raw) + len(self.arrival_ns) + _DRAFT_BYTES


class Outbox:
    """The stream's frames from the first one that the hub has not confirmed.

    When they are more than `limit_bytes`, the oldest are given up: the hub sees by the next one how many
    packets it misses.

    Attributes:
        packets, dropped_packets: taken in; given up without a confirmation.
        sent, sent_again: frames.
    """

    def __init__(self, stream: int, limit_bytes: int) -> None:
        self.stream = stream
        self.packets = self.dropped_packets = self.sent = self.sent_again = 0
        self._limit_bytes = limit_bytes
        self._drafts: deque[Draft] = deque()
        self._bytes = 0
        self._next_seq = 0  # of the next frame made
        self._cursor = 0  # of the next frame sent
        self._highest = 0  # one more than the highest ever sent
        self._news_ns = 0  # when something was confirmed, or all was begun again
        self._again_ns = AGAIN_NS

    def __len__(self) -> int:
        """Frames that wait or are not confirmed."""
        return len(self._drafts)

    @property
    def oldest(self) -> int:
        """The first frame that can still be sent."""
        return self._next_seq - len(self._drafts)

    def add_packets(
        self, raw: bytes, starts: NDArray[np.int64], arrival_ns: NDArray[np.int64], trouble: str = ""
    ) -> None:
        """Packets: their records one after the other, which start at `starts` (N,), arrived at (N,)."""
        ends = np.append(starts[1:], len(raw))
        first = 0
        while first < len(starts):
            # At least one record, and as many as fit.
            last = max(int(np.searchsorted(ends, starts[first] + MAX_RAW_BYTES, side="right")), first + 1)
            part = arrival_ns[first:last]
            piece = raw[int(starts[first]) : int(ends[last - 1])]
            self._add(int(part[0]), part.astype("<i8").tobytes(), piece, (), trouble)
            first = last

    def add_answers(self, answers: Sequence[Answer], now_ns: int, trouble: str = "") -> None:
        """A frame without packets."""
        self._add(now_ns, b"", b"", tuple(answers), trouble)

    def _add(
        self, first_ns: int, arrival_ns: bytes, raw: bytes, answers: tuple[Answer, ...], trouble: str
    ) -> None:
        draft = Draft(self._next_seq, self.packets, first_ns, arrival_ns, raw, answers, trouble)
        self._next_seq += 1
        self.packets += draft.packets
        self._drafts.append(draft)
        self._bytes += draft.size
        while self._bytes > self._limit_bytes and len(self._drafts) > 1:
            self.dropped_packets += self._forget_oldest().packets

    def _forget_oldest(self) -> Draft:
        draft = self._drafts.popleft()
        self._bytes -= draft.size
        self._cursor = max(self._cursor, self.oldest)
        return draft

    def confirmed(self, ack: Ack, now_ns: int) -> None:
        """The hub says what it has."""
        if ack.stream != self.stream or not self.oldest < ack.next_seq <= self._highest:
            return
        while self._drafts and self.oldest < ack.next_seq:
            self._forget_oldest()
        self._news_ns, self._again_ns = now_ns, AGAIN_NS

    def begin_again(self, now_ns: int) -> None:
        """The link was lost and is back: all that is not confirmed has to be sent again."""
        self._cursor = self.oldest
        self._news_ns, self._again_ns = now_ns, AGAIN_NS

    def next(self, now_ns: int) -> Draft | None:
        """The next frame to be sent now; None where none is due."""
        if self._cursor > self.oldest and now_ns - self._news_ns >= self._again_ns:
            self._cursor, self._news_ns = self.oldest, now_ns
            self._again_ns = min(2 * self._again_ns, AGAIN_LAST_NS)
        at = self._cursor - self.oldest
        if at >= min(len(self._drafts), WINDOW_FRAMES):
            return None
        if at == 0:
            self._news_ns = now_ns  # nothing was under way: the wait begins
        draft = self._drafts[at]
        self._cursor += 1
        self.sent += 1
        self.sent_again += draft.seq < self._highest
        self._highest = max(self._highest, self._cursor)
        return draft
