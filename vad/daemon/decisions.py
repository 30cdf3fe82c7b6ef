"""The log of decisions: who was measured when, and why not. It reads like a story; bounded in size."""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Callable
from pathlib import Path

import msgspec

from vad.finish import to_the_end
from vad.health import Health
from vad.wall import now_rfc3339

_log = logging.getLogger(__name__)

FILE = "decisions.jsonl"
OLDER = "decisions.1.jsonl"
MAX_BYTES = 500_000
"""The file is then set aside as the older one: up to twice this is kept, some thousand decisions."""


class Decision(msgspec.Struct, frozen=True):
    """at: RFC 3339 UTC; text: one sentence; mac: the device concerned, null where it is none."""

    at: str
    text: str
    mac: str | None = None


class DecisionLog:
    """Decisions in a file of one JSON object a line. `tell` on the loop, `flush` writes what was told.

    Args:
        folder: where the file is, or will be. wall: the wall time now, RFC 3339.

    Attributes:
        health: of the part `captures`: its detail is the last decision, its counters are what callers count.
    """

    def __init__(self, folder: Path, wall: Callable[[], str] = now_rfc3339) -> None:
        self.health = Health("captures")
        self._folder = folder
        self._wall = wall
        self._waiting: list[Decision] = []
        self._last: dict[str | None, str] = {}

    def tell(self, text: str, mac: str | None = None, *, lasts: bool = False) -> None:
        """A decision, or what came of one. lasts: it holds on and is not told twice in a row, of a device."""
        if lasts and self._last.get(mac) == text:
            return
        if len(self._last) > 4096:
            self._last.clear()
        self._last[mac] = text
        self._waiting.append(Decision(self._wall(), text, mac))
        self.health.detail = text
        _log.info("%s", text)

    async def flush(self) -> None:
        """Write down what was told since the last call; where that fails it is said and not tried again."""
        if not self._waiting:
            return
        lines, self._waiting = self._waiting, []
        try:
            await to_the_end(lambda: append(self._folder, lines))
        except OSError as error:
            if self.health.trouble(f"decisions cannot be written down ({error.strerror})"):
                _log.warning("%s: %s", self._folder, self.health.detail)
        else:
            self.health.ok(lines[-1].text)

    async def close(self) -> None:
        """Write down the rest, whatever is cancelled."""
        await asyncio.shield(self.flush())


def append(folder: Path, lines: list[Decision]) -> None:
    """Add to the file in `folder`; a full one is set aside first. Blocking. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / FILE
    if path.exists() and path.stat().st_size > MAX_BYTES:
        os.replace(path, folder / OLDER)  # noqa: PTH105 - as in the session writer
    with path.open("ab") as file:
        file.write(b"".join(msgspec.json.encode(line) + b"\n" for line in lines))


def read(folder: Path) -> list[Decision]:
    """All decisions that are kept, the oldest first; lines that a crash cut off are left out. Blocking."""
    found = []
    for name in (OLDER, FILE):
        try:
            text = (folder / name).read_bytes()
        except FileNotFoundError:
            continue
        for line in text.splitlines():
            try:
                found.append(msgspec.json.decode(line, type=Decision))
            except msgspec.MsgspecError:
                continue
    return found
