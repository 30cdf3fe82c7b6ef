"""The daemon's side of the bus: what was published last, and the answers to who asks for it.

State is a snapshot that the event loop replaces and never changes. zenoh calls back on its own network
thread, one a link: there a query is answered from the snapshot at hand, and all else goes over to the loop. A
reader that stops reading holds up its own link only (measured: others are answered as fast as ever, and the
interpreter lock is free meanwhile).
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from types import MappingProxyType, TracebackType
from typing import Self

import msgspec
import zenoh
from zenoh import handlers

from vad.bus import messages as m
from vad.bus.keys import ANY, HubKeys
from vad.bus.selectors import SelectorError, parse_device_selector, require_no_selector
from vad.bus.session import BusSettings, open_session
from vad.errors import VadError
from vad.health import Health

log = logging.getLogger(__name__)

PNG_ENCODING = "image/png"
CLOSE_TIMEOUT_S = 0.8
KEPT_CAPTURES = 32
"""Captures a query still finds; older ones are forgotten."""


@dataclass(frozen=True, slots=True)
class Entry:
    """The last value of one key. message: without its times, to compare and select; None for a picture."""

    key: zenoh.KeyExpr
    payload: bytes
    encoding: str
    message: m.Message | None


Wanted = Callable[[Entry], bool]
Entries = MappingProxyType[str, Entry]


def now_rfc3339() -> str:
    """Wall time, UTC, to the millisecond."""
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _wants_everything(parameters: str) -> Wanted:
    require_no_selector(parameters)
    return lambda _entry: True


def _wants_devices(parameters: str) -> Wanted:
    selector = parse_device_selector(parameters)
    return lambda entry: isinstance(entry.message, m.DeviceMessage) and selector.wants(entry.message)


async def _close_in_time(session: zenoh.Session) -> None:
    """Close `session`; leave it to the process's end where a reader that stopped reading holds it up.

    zenoh tries for 10 s to say goodbye on such a link. The thread is a daemon one, so that it cannot hold up
    the end of the process.
    """
    loop = asyncio.get_running_loop()
    closed = asyncio.Event()

    def close() -> None:
        try:
            session.close()  # type: ignore[no-untyped-call]
        except zenoh.ZError as error:
            log.debug("closing: %s", error)
        with suppress(RuntimeError):  # the loop ended before: nobody waits any more
            loop.call_soon_threadsafe(closed.set)

    threading.Thread(target=close, name="vad-bus-close", daemon=True).start()
    try:
        await asyncio.wait_for(closed.wait(), CLOSE_TIMEOUT_S)
    except TimeoutError:
        log.warning("zenoh did not close within %s s: a client does not read", CLOSE_TIMEOUT_S)


class Bus:
    """Publishes on change and answers queries; one per daemon, used on one event loop.

    What is published before `open` is there for the first query after it.
    """

    def __init__(self, settings: BusSettings) -> None:
        if settings.hub == ANY:
            raise VadError("a daemon needs a hub name of its own", where="hub")
        self.keys = HubKeys(settings.hub)
        self.health = Health("bus")
        self._settings = settings
        self._session: zenoh.Session | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._token: zenoh.LivelinessToken | None = None
        self._tables: dict[str, Entries] = {
            pattern: MappingProxyType({})
            for pattern in (
                self.keys.status,
                self.keys.map,
                self.keys.grid,
                self.keys.camera(),
                self.keys.device(),
                self.keys.heatmap(),
                self.keys.capture(),
            )
        }

    async def open(self) -> None:
        """Listen, answer, show the liveliness token; VadError where the address cannot be used."""
        self._loop = asyncio.get_running_loop()
        session = await asyncio.to_thread(open_session, self._settings)
        self._session = session
        for pattern in self._tables:
            parse = _wants_devices if pattern == self.keys.device() else _wants_everything
            # indirect=False: no Python thread of its own, which would keep the process from ending
            callback = handlers.Callback(partial(self._answer, pattern, parse), indirect=False)
            session.declare_queryable(pattern, callback, complete=True)
        self._token = session.liveliness().declare_token(self.keys.alive)
        self._listening()

    def _listening(self) -> None:
        self.health.ok(f"listening on {', '.join(self._settings.listen)}")

    async def close(self) -> None:
        """Take everything back, in CLOSE_TIMEOUT_S at most; safe to call twice."""
        session, self._session = self._session, None
        self._token = None
        if session is not None:
            await _close_in_time(session)

    async def __aenter__(self) -> Self:
        await self.open()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    @property
    def session(self) -> zenoh.Session:
        """The open session, for who reads other keys on the same router; RuntimeError before `open`."""
        if self._session is None:
            raise RuntimeError("the bus is not open")
        return self._session

    def publish_status(self, message: m.StatusMessage) -> None:
        """Replace the status; a put only where more than the uptime changed."""
        self._publish(self.keys.status, self.keys.status, message)

    def publish_map(self, message: m.MapMessage) -> None:
        """Replace the map's frame and rooms."""
        self._publish(self.keys.map, self.keys.map, message)

    def publish_grid(self, png: bytes) -> None:
        """Replace the occupancy grid's picture (see vad.bus.grid)."""
        old = self._tables[self.keys.grid].get(self.keys.grid)
        entry = Entry(zenoh.KeyExpr(self.keys.grid), png, PNG_ENCODING, None)
        self._keep(self.keys.grid, entry)
        if old is None or old.payload != png:
            self._put(entry)

    def publish_camera(self, message: m.CameraMessage) -> None:
        """Replace what is known of one camera."""
        self._publish(self.keys.camera(), self.keys.camera(message.id), message)

    def publish_device(self, message: m.DeviceMessage) -> None:
        """Replace what is known of one device."""
        self._publish(self.keys.device(), self.keys.device(message.mac), message)

    def publish_heatmap(self, message: m.HeatmapMessage) -> None:
        """Replace the posterior of one device."""
        self._publish(self.keys.heatmap(), self.keys.heatmap(message.mac), message)

    def publish_capture(self, message: m.CaptureMessage) -> None:
        """Replace the progress of one capture; only the last KEPT_CAPTURES stay."""
        pattern = self.keys.capture()
        self._publish(pattern, self.keys.capture(message.session), message)
        kept = list(self._tables[pattern].items())[-KEPT_CAPTURES:]
        self._tables[pattern] = MappingProxyType(dict(kept))

    def publish_event(self, message: m.EventMessage) -> None:
        """Tell subscribers what happened; nobody can ask for it later."""
        self._put(self._entry(self.keys.events, message))

    def forget_device(self, mac: str) -> None:
        """Remove a device and its heatmap; subscribers see a delete."""
        for pattern, key in (
            (self.keys.device(), self.keys.device(mac)),
            (self.keys.heatmap(), self.keys.heatmap(mac)),
        ):
            table = self._tables[pattern]
            if key not in table:
                continue
            self._tables[pattern] = MappingProxyType({k: v for k, v in table.items() if k != key})
            if self._session is not None:
                self._guard(partial(self._session.delete, key))

    def _entry(self, key: str, message: m.Message) -> Entry:
        """What to send; its message lacks what changes by itself, for comparing."""
        plain = msgspec.structs.replace(message, hub=self.keys.hub, published_at="")
        sent = msgspec.structs.replace(plain, published_at=now_rfc3339())
        if isinstance(plain, m.StatusMessage):
            plain = msgspec.structs.replace(plain, uptime_s=0.0)
        return Entry(zenoh.KeyExpr(key), m.encode(sent), m.encoding_of(type(message)), plain)

    def _publish(self, pattern: str, key: str, message: m.Message) -> None:
        old = self._tables[pattern].get(key)
        entry = self._entry(key, message)
        self._keep(pattern, entry)
        if old is None or old.message != entry.message:
            self._put(entry)

    def _keep(self, pattern: str, entry: Entry) -> None:
        self._tables[pattern] = MappingProxyType({**self._tables[pattern], str(entry.key): entry})

    def _put(self, entry: Entry) -> None:
        if self._session is None:
            return
        put = partial(
            self._session.put,
            entry.key,
            entry.payload,
            encoding=entry.encoding,
            congestion_control=zenoh.CongestionControl.DROP,
            express=True,
        )
        self._guard(put)

    def _guard(self, send: Callable[[], None]) -> None:
        try:
            send()
        except zenoh.ZError as error:
            if self.health.trouble(f"cannot publish: {error}"):
                log.warning("cannot publish: %s", error)
        else:
            self.health.counters["puts"] += 1
            if self.health.state != "ok":
                self._listening()

    def _count(self, name: str) -> None:
        """Add one to a counter, from zenoh's thread."""
        if self._loop is None:
            return
        with suppress(RuntimeError):  # the loop ended before an answer that a stalled reader held up
            self._loop.call_soon_threadsafe(self._add_one, name)

    def _add_one(self, name: str) -> None:
        self.health.counters[name] += 1

    def _answer(self, pattern: str, parse: Callable[[str], Wanted], query: zenoh.Query) -> None:
        """Answer one query, on zenoh's thread."""
        with query:
            self._count("queries")
            try:
                self._reply_all(self._tables[pattern], parse(str(query.parameters)), query)
            except SelectorError as error:
                self._count("refused")
                self._refuse(query, m.ErrorMessage(code="bad_selector", text=str(error)))
            except zenoh.ZError as error:
                self._count("replies_lost")
                log.debug("a reply was lost: %s", error)
            except (ArithmeticError, LookupError, TypeError, ValueError) as error:
                self._count("failed")
                log.exception("a query on %s failed", query.key_expr)
                text = f"The daemon could not answer ({type(error).__name__}); its log says more"
                self._refuse(query, m.ErrorMessage(code="internal", text=text))

    def _reply_all(self, entries: Entries, wanted: Wanted, query: zenoh.Query) -> None:
        asked = str(query.key_expr)
        hit = entries.get(asked)
        if hit is not None:
            found = [hit]
        else:
            found = [entry for entry in entries.values() if query.key_expr.intersects(entry.key)]
        for entry in found:
            if self._session is None:
                return  # closing: do not wait for readers any more
            if wanted(entry):
                query.reply(entry.key, entry.payload, encoding=entry.encoding)

    @staticmethod
    def _refuse(query: zenoh.Query, message: m.ErrorMessage) -> None:
        try:
            query.reply_err(m.encode(message), encoding=m.encoding_of(m.ErrorMessage))
        except zenoh.ZError as error:
            log.debug("a refusal was lost: %s", error)
