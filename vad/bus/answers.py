"""Questions to answers: what a query's key and parameters get from the board. No I/O, no waiting."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

import zenoh

from vad.bus import messages as m
from vad.bus import selectors as s
from vad.bus.board import Board, Entries, Entry, Form, collection, entry_of
from vad.bus.keys import parse_key
from vad.errors import VadError
from vad.mac import normal_mac
from vad.wall import now_rfc3339


@dataclass(frozen=True, slots=True)
class Reply:
    """One answer to a question that may have several."""

    key: zenoh.KeyExpr | str
    form: Form


class HistoryError(VadError):
    """Asked for a time of which nothing is kept any more."""

    code = "out_of_history"


class NoHistoryError(VadError):
    """Nobody keeps history here."""

    code = "not_available"


class Past(Protocol):
    """Who remembers how devices were; asked on the event loop."""

    async def devices_at(self, at: str, mac: str | None) -> list[m.DeviceMessage]:
        """Devices as they were at `at` (`now_rfc3339` form): one, or all. HistoryError where that is gone."""
        ...

    async def history(self, mac: str, question: s.HistoryQuestion) -> m.HistoryMessage | None:
        """What was said of a device; None for one that is not known."""
        ...


@dataclass(frozen=True, slots=True)
class Later:
    """A question that only the past can answer: `ask` waits for it."""

    ask: Callable[[Past], Awaitable[list[Reply]]]


Answer = list[Reply] | Later
Answerer = Callable[[str, str], Answer]
"""Key expression and parameters -> the answer; SelectorError where the question is wrong."""


def answerers(board: Board, source: m.Source) -> dict[str, Answerer]:
    """Which pattern is answered how."""
    keys = board.keys
    plain = (keys.status, keys.map, keys.grid, keys.camera(), keys.capture(), keys.schema())
    found: dict[str, Answerer] = {pattern: _Plain(board, pattern).answer for pattern in plain}
    found[keys.heatmap()] = _Heatmaps(board).answer
    found[keys.device()] = _Devices(board, source, together=False).answer
    found[keys.devices] = _Devices(board, source, together=True).answer
    found[keys.history()] = _History(board).answer
    found[keys.events] = _Events(board, source).answer
    return found


def hits(entries: Entries, asked: str) -> list[Entry]:
    """The entries whose key the question covers; one look-up where it names a key."""
    hit = entries.get(asked)
    if hit is not None:
        return [hit]
    wanted = zenoh.KeyExpr(asked)
    return [entry for entry in entries.values() if wanted.intersects(entry.key)]


@dataclass(frozen=True, slots=True)
class _Plain:
    board: Board
    pattern: str

    def answer(self, asked: str, parameters: str) -> Answer:
        s.require_no_selector(parameters)
        return [Reply(e.key, e.form) for e in hits(self.board.tables[self.pattern], asked)]


@dataclass(frozen=True, slots=True)
class _Heatmaps:
    board: Board

    def answer(self, asked: str, parameters: str) -> Answer:
        form = s.parse_heatmap_format(parameters)
        found = hits(self.board.tables[self.board.keys.heatmap()], asked)
        return [Reply(e.key, e.as_(form)) for e in found]


@dataclass(frozen=True, slots=True)
class _Devices:
    """Devices each by itself, or all together in one reply."""

    board: Board
    source: m.Source
    together: bool

    def answer(self, asked: str, parameters: str) -> Answer:
        question = s.parse_device_question(parameters)
        if self.together and not _names(asked, "devices"):
            return []  # asked for with a wildcard: each device answers for itself
        if question.at is not None:
            return Later(lambda past: self._past(past, asked, question))
        entries = self.board.tables[self.board.keys.device()]
        everything = question.selector == s.DeviceSelector()
        if self.together and everything:
            form = self.board.all_devices(question.format, self.source)
            return [Reply(self.board.keys.devices, form)]
        found: Iterable[Entry] = entries.values() if self.together else hits(entries, asked)
        return self._replies(found, question)

    def _replies(self, found: Iterable[Entry], question: s.DeviceQuestion) -> list[Reply]:
        wants = question.selector.wants
        chosen = [e for e in found if e.facts is not None and wants(e.facts)]
        if not self.together:
            return [Reply(e.key, e.as_(question.format)) for e in chosen]
        form = collection(chosen, question.format, hub=self.board.keys.hub, source=self.source)
        return [Reply(self.board.keys.devices, form)]

    async def _past(self, past: Past, asked: str, question: s.DeviceQuestion) -> list[Reply]:
        assert question.at is not None
        keys = self.board.keys
        mac = None if self.together else _named_mac(asked)
        now = now_rfc3339()
        entries = [
            entry_of(keys.device(device.mac), device, keys.hub, now)
            for device in await past.devices_at(question.at, mac)
        ]
        wanted = zenoh.KeyExpr(asked)
        if not self.together:
            entries = [entry for entry in entries if wanted.intersects(entry.key)]
        return self._replies(entries, question)


@dataclass(frozen=True, slots=True)
class _History:
    board: Board

    def answer(self, asked: str, parameters: str) -> Answer:
        if not _names(asked, "history"):
            return []  # `vad/home/**` is answered with what is, not with all that was
        question = s.parse_history_question(parameters)
        mac = _named_mac(asked)
        if mac is None:
            raise s.SelectorError(
                "history is answered for one device at a time", where=asked, remedy="Put a MAC for the *"
            )
        return Later(lambda past: self._past(past, mac, question))

    async def _past(self, past: Past, mac: str, question: s.HistoryQuestion) -> list[Reply]:
        found = await past.history(mac, question)
        if found is None:
            return []
        entry = entry_of(self.board.keys.history(mac), found, self.board.keys.hub)
        return [Reply(entry.key, entry.form)]


@dataclass(frozen=True, slots=True)
class _Events:
    board: Board
    source: m.Source

    def answer(self, asked: str, parameters: str) -> Answer:
        since = s.parse_event_question(parameters)
        wanted = [payload for at, payload in self.board.events if since is None or at > since]
        message = m.EventsMessage(
            source=self.source, events=tuple(m.decode(payload, m.EventMessage) for payload in wanted)
        )
        entry = entry_of(self.board.keys.events, message, self.board.keys.hub)
        return [Reply(entry.key, entry.form)]


def _names(asked: str, kind: str) -> bool:
    """Whether the question's key is one of this kind, and not a wildcard that only covers it."""
    parsed = parse_key(asked)
    return parsed is not None and parsed.kind == kind


def _named_mac(asked: str) -> str | None:
    """The MAC that a key names; None where it covers several."""
    parsed = parse_key(asked)
    try:
        return normal_mac(parsed.name) if parsed is not None else None
    except VadError:
        return None
