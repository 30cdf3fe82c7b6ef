"""The daemon's side of the bus: what was published last, and the answers to who asks for it.

State is a snapshot that the event loop replaces and never changes (board.py). zenoh calls back on its own
network thread, one a link: there a query is answered from the snapshot at hand, and all else goes over to the
loop. A reader that stops reading holds up its own link only (measured: others are answered as fast as ever,
and the interpreter lock is free meanwhile).
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from types import TracebackType
from typing import Self

import zenoh
from zenoh import handlers

from vad.bus import messages as m
from vad.bus.answers import Answerer, Later, NoHistoryError, Past, Reply, answerers
from vad.bus.board import PNG_ENCODING, Board, Entry, Form, entry_of, raw_entry
from vad.bus.closing import close_in_time
from vad.bus.keys import ANY, HubKeys
from vad.bus.schemas import SCHEMA_ENCODING, json_schemas
from vad.bus.selectors import SelectorError
from vad.bus.session import BusSettings, open_session
from vad.errors import VadError
from vad.health import Health
from vad.wall import now_rfc3339 as now_rfc3339  # where publishers look for it

log = logging.getLogger(__name__)

KEPT_CAPTURES = 32
"""Captures a query still finds; older ones are forgotten."""
MAX_LATER = 64
"""Questions about the past that may wait for the store at one time."""


Listener = Callable[[str, Form | None], None]
"""Hears of each change of what is published: the key, and the value as sent; None where it is no more."""


class BusyError(VadError):
    """More is asked than can be answered now."""

    code = "busy"


class Bus:
    """Publishes on change and answers queries; one per daemon, used on one event loop.

    What is published before `open` is there for the first query after it. source: what the daemon's home is,
    for answers that hold several messages or none.
    """

    def __init__(self, settings: BusSettings, *, source: m.Source = "live") -> None:
        if settings.hub == ANY:
            raise VadError("a daemon needs a hub name of its own", where="hub")
        self.keys = HubKeys(settings.hub)
        self.health = Health("bus")
        self._settings = settings
        self._session: zenoh.Session | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._token: zenoh.LivelinessToken | None = None
        self._board = Board(self.keys)
        self._answerers = answerers(self._board, source)
        self._past: Past | None = None
        self._later: set[asyncio.Task[None]] = set()
        self._listeners: list[Listener] = []
        self._asked_past = 0
        for name, text in json_schemas().items():
            self._board.put(
                self.keys.schema(), raw_entry(self.keys.schema(name), text.encode(), SCHEMA_ENCODING)
            )

    async def open(self) -> None:
        """Listen, answer, show the liveliness token; VadError where the address cannot be used."""
        self._loop = asyncio.get_running_loop()
        session = await asyncio.to_thread(open_session, self._settings)
        self._session = session
        for pattern, answerer in self._answerers.items():
            # indirect=False: no Python thread of its own, which would keep the process from ending
            callback = handlers.Callback(partial(self._answer, answerer), indirect=False)
            session.declare_queryable(pattern, callback, complete=True)
        for entry in self._board.tables[self.keys.schema()].values():
            self._put(entry)
        self._token = session.liveliness().declare_token(self.keys.alive)
        self._listening()

    def _listening(self) -> None:
        self.health.ok(f"listening on {', '.join(self._settings.listen)}")

    async def close(self) -> None:
        """Take everything back, in vad.bus.closing.CLOSE_TIMEOUT_S at most; safe to call twice."""
        session, self._session = self._session, None
        self._token = None
        waiting = set(self._later)
        for task in waiting:
            task.cancel()
        if waiting:
            await asyncio.wait(waiting)
        if session is not None:
            await close_in_time(session)

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

    def ask_past(self, past: Past | None) -> None:
        """From now on questions about the past (`?at=`, history) go to `past`."""
        self._past = past

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Tell `listener` all that is known, then every change and event; what this returns ends it.

        It is called on the event loop, in the midst of publishing: it keeps what it hears and returns.
        """
        self._listeners.append(listener)
        for table in self._board.tables.values():
            for key, entry in table.items():
                listener(key, entry.form)
        return partial(self._listeners.remove, listener)

    @property
    def status(self) -> m.StatusMessage | None:
        """The status that was published last."""
        entry = self._board.tables[self.keys.status].get(self.keys.status)
        return None if entry is None else m.decode(entry.form.payload, m.StatusMessage)

    def device_states(self) -> Counter[str]:
        """How many devices are in which state."""
        devices = self._board.tables[self.keys.device()].values()
        return Counter(entry.facts.state for entry in devices if entry.facts is not None)

    def publish_status(self, message: m.StatusMessage) -> None:
        """Replace the status; a put only where more than the uptime changed."""
        self._publish(self.keys.status, self.keys.status, message)

    def publish_map(self, message: m.MapMessage) -> None:
        """Replace the map's frame and rooms."""
        self._publish(self.keys.map, self.keys.map, message)

    def publish_grid(self, png: bytes) -> None:
        """Replace the occupancy grid's picture (see vad.bus.grid)."""
        entry = raw_entry(self.keys.grid, png, PNG_ENCODING)
        if self._board.put(self.keys.grid, entry):
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
        self._board.keep_last(pattern, KEPT_CAPTURES)

    def publish_event(self, message: m.EventMessage) -> None:
        """Tell subscribers what happened; who asks is answered with the last ones."""
        now = now_rfc3339()  # one time for the message and for `since`, which asks for what is later
        entry = entry_of(self.keys.events, message, self.keys.hub, now)
        self._board.tell(entry, now)
        self._put(entry)

    def forget_device(self, mac: str) -> None:
        """Remove a device and its heatmap; subscribers see a delete."""
        for pattern, key in (
            (self.keys.device(), self.keys.device(mac)),
            (self.keys.heatmap(), self.keys.heatmap(mac)),
        ):
            if not self._board.drop(pattern, key):
                continue
            self._tell(key, None)
            if self._session is not None:
                self._guard(partial(self._session.delete, key))

    def _publish(self, pattern: str, key: str, message: m.Message) -> None:
        entry = entry_of(key, message, self.keys.hub)
        if self._board.put(pattern, entry):
            self._put(entry)

    def _tell(self, key: str, form: Form | None) -> None:
        for listener in self._listeners:
            listener(key, form)

    def _put(self, entry: Entry) -> None:
        self._tell(str(entry.key), entry.form)
        if self._session is None:
            return
        put = partial(
            self._session.put,
            entry.key,
            entry.form.payload,
            encoding=entry.form.encoding,
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

    def _to_loop(self, call: Callable[[], object]) -> None:
        """Have the loop do something, from zenoh's thread."""
        if self._loop is None:
            return
        with suppress(RuntimeError):  # the loop ended before an answer that a stalled reader held up
            self._loop.call_soon_threadsafe(call)

    def _note(self, outcome: str, begun_s: float) -> None:
        """A question is dealt with; called on the loop."""
        self.health.counters["queries"] += 1
        if outcome:
            self.health.counters[outcome] += 1
        self.health.took("answer", time.perf_counter() - begun_s)

    def _answer(self, answerer: Answerer, query: zenoh.Query) -> None:
        """Answer one query, on zenoh's thread; what needs the store waits on the loop."""
        begun_s = time.perf_counter()
        answer: list[Reply] | Later = []
        outcome = ""
        try:
            answer = answerer(str(query.key_expr), str(query.parameters))
            if isinstance(answer, list):
                outcome = self._send(query, answer)
        except SelectorError as error:
            outcome = self._refuse(query, error)
        except (ArithmeticError, LookupError, TypeError, ValueError, VadError) as error:
            log.exception("a query on %s failed", query.key_expr)
            outcome = self._fail(query, error)
        if isinstance(answer, Later):
            self._to_loop(partial(self._begin_later, answer, query, begun_s))
            return
        query.drop()  # type: ignore[no-untyped-call]
        self._to_loop(partial(self._note, outcome, begun_s))

    def _begin_later(self, answer: Later, query: zenoh.Query, begun_s: float) -> None:
        admitted = self._asked_past < MAX_LATER
        self._asked_past += admitted
        task = asyncio.create_task(self._answer_later(answer, query, begun_s, admitted), name="bus: the past")
        self._later.add(task)
        task.add_done_callback(self._later.discard)

    async def _answer_later(self, answer: Later, query: zenoh.Query, begun_s: float, admitted: bool) -> None:
        """Ask the store, then send in a thread: an asker that does not read must not stop the loop."""
        outcome = ""
        try:
            if self._past is None:
                raise NoHistoryError("this daemon keeps no history")
            if not admitted:
                raise BusyError("too many questions about the past at once", remedy="Ask again in a second")
            replies = await answer.ask(self._past)
            outcome = await asyncio.to_thread(self._send, query, replies)
        except VadError as error:
            outcome = await asyncio.to_thread(self._refuse, query, error)
        finally:
            self._asked_past -= admitted
            query.drop()  # type: ignore[no-untyped-call]
            self._note(outcome, begun_s)

    def _send(self, query: zenoh.Query, replies: list[Reply]) -> str:
        """What to count it as."""
        try:
            for reply in replies:
                if self._session is None:
                    return ""  # closing: do not wait for readers any more
                query.reply(reply.key, reply.form.payload, encoding=reply.form.encoding)
        except zenoh.ZError as error:
            log.debug("a reply was lost: %s", error)
            return "replies_lost"
        return ""

    def _refuse(self, query: zenoh.Query, error: VadError) -> str:
        self._reply_error(query, m.ErrorMessage(code=error.code, text=str(error)))
        return "refused"

    def _fail(self, query: zenoh.Query, error: Exception) -> str:
        text = f"The daemon could not answer ({type(error).__name__}); its log says more"
        self._reply_error(query, m.ErrorMessage(code="internal", text=text))
        return "failed"

    @staticmethod
    def _reply_error(query: zenoh.Query, message: m.ErrorMessage) -> None:
        try:
            query.reply_err(m.encode(message), encoding=m.encoding_of(m.ErrorMessage))
        except zenoh.ZError as error:
            log.debug("a refusal was lost: %s", error)
