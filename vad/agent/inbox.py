"""An agent's stream on the hub: in order, each frame once, what is missing counted exactly; no I/O."""

from __future__ import annotations

from collections import deque

from vad.agent.frames import Ack, Frame

_REMEMBERED_STREAMS = 8


class Inbox:
    """Takes the frames of one agent as they come.

    Attributes:
        packets: accepted; lost: given up by the agent, so that they never come; streams: runs of the agent;
        repeated, early: frames refused because they were there already, or are not next (they come again).
    """

    def __init__(self) -> None:
        self.packets = self.lost = self.streams = self.repeated = self.early = 0
        self._stream: int | None = None
        self._former: deque[int] = deque(maxlen=_REMEMBERED_STREAMS)
        self._next_seq = 0
        self._expected: int | None = None  # packets before the next frame; None where a stream begins
        self._given_up = 0  # packets before the first frame, by all that has been heard of them

    @property
    def ack(self) -> Ack | None:
        """What is to be told to the agent; None before its first frame."""
        return None if self._stream is None else Ack(self._stream, self._next_seq)

    def take(self, frame: Frame) -> bool:
        """True where the frame is the next one."""
        if frame.stream != self._stream and not self._begin(frame):
            return False
        self._given_up = max(self._given_up, frame.given_up)
        if frame.seq < self._next_seq:
            self.repeated += 1
            return False
        if frame.oldest > self._next_seq:
            self._next_seq = frame.oldest
        if frame.seq > self._next_seq:
            self.early += 1
            return False
        # What came before the first frame this run of the hub sees, an earlier run may have.
        missing = self._given_up if self._expected is None else frame.before - self._expected
        self.lost += max(0, missing)
        self._next_seq = frame.seq + 1
        self._expected = frame.before + frame.packets
        self.packets += frame.packets
        return True

    def _begin(self, frame: Frame) -> bool:
        """Another run of the agent; False for a late frame of a former one."""
        if frame.stream in self._former:
            return False
        if self._stream is not None:
            self._former.append(self._stream)
        self._stream = frame.stream
        self.streams += 1
        self._next_seq = frame.oldest
        self._expected = None
        self._given_up = 0
        return True
