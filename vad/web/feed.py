"""What the page shows, by key, each with the number of its last change. No I/O.

A stream is a number: what it has been told. What is newer than that is what it needs next, so a browser that
reads slowly, or comes back after a break, gets the newest of each key, once; nothing queues up for it.
"""

from __future__ import annotations

import asyncio
import secrets
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

GONE_KEPT = 1000
"""Keys that were taken back and are still told of; a stream that missed more begins anew."""
ROLLING = {"events/": 50, "capture/": 32}
"""Keys below these are a log: so many, the oldest go without a word."""
_GONE = b"null"


@dataclass(frozen=True, slots=True)
class Item:
    """A key's last change. number: of the change; value: JSON, `null` where the key was taken back."""

    number: int
    key: str
    value: bytes

    @property
    def gone(self) -> bool:
        """Whether the key was taken back."""
        return self.value == _GONE


class Feed:
    """The last value of each key; used on one event loop.

    Attributes:
        life: names this feed; numbers of another one say nothing here.
        number: of the last change.
    """

    def __init__(self) -> None:
        self.life = secrets.token_hex(4)
        self.number = 0
        self._items: OrderedDict[str, Item] = OrderedDict()  # in order of their last change
        self._gone = 0
        self._forgotten = 0
        self._watchers: set[asyncio.Event] = set()

    def put(self, key: str, value: bytes) -> None:
        """Replace a value. value: JSON on one line."""
        self._replace(key, value)
        for prefix, most in ROLLING.items():
            if key.startswith(prefix):
                rolling = [k for k in self._items if k.startswith(prefix)]
                for old in rolling[:-most]:
                    del self._items[old]

    def drop(self, key: str) -> None:
        """Take a key back; nothing happens where it is not known."""
        known = self._items.get(key)
        if known is None or known.gone:
            return
        self._replace(key, _GONE)
        self._gone += 1
        if self._gone > GONE_KEPT:
            oldest = next(item for item in self._items.values() if item.gone)
            del self._items[oldest.key]
            self._gone -= 1
            self._forgotten = oldest.number

    def _replace(self, key: str, value: bytes) -> None:
        self.number += 1
        before = self._items.pop(key, None)
        if before is not None and before.gone:
            self._gone -= 1
        self._items[key] = Item(self.number, key, value)
        self.wake()

    def wake(self) -> None:
        """Have every watcher look."""
        for watcher in self._watchers:
            watcher.set()

    def since(self, number: int) -> list[Item]:
        """What changed after that number, the oldest change first; what is there now for 0."""
        found = []
        for item in reversed(self._items.values()):
            if item.number <= number:
                break
            found.append(item)
        return [item for item in reversed(found) if number or not item.gone]

    def position(self, last_id: str | None) -> int | None:
        """The number behind the id of an event that was sent; None where the stream has to begin anew."""
        life, _, text = (last_id or "").partition("-")
        if life != self.life or not text.isascii() or not text.isdigit() or len(text) > 18:
            return None
        number = int(text)
        return number if self._forgotten <= number <= self.number else None

    def event_id(self, number: int) -> str:
        """The id of an event for `position`."""
        return f"{self.life}-{number}"

    @contextmanager
    def watching(self) -> Iterator[asyncio.Event]:
        """An event that is set whenever something changes; its user clears it."""
        changed = asyncio.Event()
        self._watchers.add(changed)
        try:
            yield changed
        finally:
            self._watchers.discard(changed)
