"""What a broker is to retain, what it does as far as known, and what to send when."""

from __future__ import annotations

from collections.abc import Callable, Iterator

GONE = b""
"""An empty payload makes a broker forget a topic."""


class Retained:
    """The difference between what is wanted and what was sent; newer values replace ones not sent yet.

    Args:
        every_ns: at which intervals a topic may change at most; disappearing waits for nothing.
    """

    def __init__(self, every_ns: Callable[[str], int]) -> None:
        self._every_ns = every_ns
        self._wanted: dict[str, bytes] = {}
        self._sent: dict[str, bytes] = {}
        self._sent_ns: dict[str, int] = {}

    def want(self, topic: str, payload: bytes) -> bool:
        """The broker is to retain this; False where that is nothing new."""
        news = self._wanted.get(topic) != payload
        self._wanted[topic] = payload
        return news

    def drop(self, topic: str) -> None:
        """The broker is to forget this topic; nothing where that was never wanted."""
        if topic in self._wanted:
            self._wanted[topic] = GONE

    def found(self, topic: str) -> bool:
        """The broker retains a topic from an earlier run; True where it is to be forgotten."""
        if topic in self._wanted:
            return False
        self._wanted[topic] = GONE
        return True

    def again(self) -> None:
        """Send everything anew, at once: another broker may be there, or another reader."""
        self._sent.clear()
        self._sent_ns.clear()

    def due(self, now_ns: int) -> Iterator[tuple[str, bytes]]:
        """Topics and payloads to send now, in the order in which the topics came up; call `sent` for each."""
        for topic, payload in list(self._wanted.items()):
            if self._sent.get(topic) != payload and self._free_ns(topic, payload) <= now_ns:
                yield topic, payload

    def next_ns(self) -> int | None:
        """When something that waits becomes due; None where nothing waits."""
        return min(
            (self._free_ns(t, p) for t, p in self._wanted.items() if self._sent.get(t) != p), default=None
        )

    def sent(self, topic: str, payload: bytes, now_ns: int) -> None:
        """The broker has it."""
        if payload != GONE:
            self._sent[topic] = payload
            self._sent_ns[topic] = now_ns
            return
        self._sent.pop(topic, None)
        self._sent_ns.pop(topic, None)
        if self._wanted.get(topic) == GONE:
            del self._wanted[topic]

    def _free_ns(self, topic: str, payload: bytes) -> int:
        """From when on the topic may be sent; 0 where it may be at any time."""
        sent_ns = self._sent_ns.get(topic)
        return 0 if sent_ns is None or payload == GONE else sent_ns + self._every_ns(topic)
