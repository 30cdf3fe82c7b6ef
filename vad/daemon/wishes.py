"""What people want of devices at run time: to be ignored, renamed, forgotten; asked over zenoh."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from functools import partial

import msgspec
import zenoh
from zenoh import handlers

from vad.bus import messages as m
from vad.bus.keys import HubKeys
from vad.daemon.registry import Registry
from vad.errors import VadError
from vad.streams import DropOldestQueue
from vad.wall import now_rfc3339

MAX_BYTES = 4096
PATIENCE_S = 3.0
"""Less than a client's: who asks is told that it waits (for a disk that is full), not that nobody answers."""
WAITING_AT_MOST = 32
"""Wishes that wait to be kept: more are refused, so that a full disk does not fill the memory too."""
_INBOX = 64

_log = logging.getLogger(__name__)


class Wishes:
    """Answers DeviceWish queries on `vad/<hub>/wishes`, and who asks inside the daemon.

    A wish is granted when it is kept. One that takes longer than `patience_s` goes on; who asked is told so.
    """

    def __init__(
        self, keys: HubKeys, registry: Registry, source: m.Source, *, patience_s: float = PATIENCE_S
    ) -> None:
        self._patience_s = patience_s
        self._granting: set[asyncio.Task[str]] = set()
        self._keys = keys
        self._registry = registry
        self._source = source

    async def run(self, session: zenoh.Session) -> None:
        """Answer until cancelled."""
        loop = asyncio.get_running_loop()
        inbox: DropOldestQueue[zenoh.Query] = DropOldestQueue(_INBOX)

        def arrived(query: zenoh.Query) -> None:
            # zenoh's network thread: hand over and return; the loop may have closed in the meantime.
            with contextlib.suppress(RuntimeError):
                loop.call_soon_threadsafe(inbox.put, query)

        handler = handlers.Callback(arrived, None, indirect=False)
        # Not in a thread: a cancellation in between would leave a queryable nobody can undeclare.
        queryable = session.declare_queryable(self._keys.wishes, handler, complete=True)
        try:
            while True:
                query = await inbox.get()
                reply = await self.answer(b"" if query.payload is None else query.payload.to_bytes())
                # in a thread: an asker that does not read must not stop the loop
                await asyncio.to_thread(partial(_send, query, self._keys.wishes, reply))
        finally:
            for granting in self._granting:
                granting.cancel()
            await asyncio.gather(*self._granting, return_exceptions=True)
            # The session may be closed already.
            with contextlib.suppress(zenoh.ZError):
                queryable.undeclare()  # type: ignore[no-untyped-call]

    async def answer(self, payload: bytes) -> m.WishReply | m.ErrorMessage:
        """Grant a DeviceWish in JSON: what became of it, or why it cannot be."""
        if len(payload) > MAX_BYTES:
            return m.ErrorMessage(code="bad_wish", text="The wish is too long")
        if len(self._granting) >= WAITING_AT_MOST:
            text = f"{len(self._granting)} wishes wait to be kept: see what the store says in `vad status`"
            return m.ErrorMessage(code="busy", text=text)
        try:
            wish = m.decode(payload, m.DeviceWish)
            text = await self._patiently(wish)
        except TimeoutError:
            text = "It waits to be kept, and is granted then: see what the store says in `vad status`"
            return m.ErrorMessage(code="waiting", text=text)
        except msgspec.DecodeError as error:
            return m.ErrorMessage(code="bad_wish", text=f"Not a wish: {error}")
        except VadError as error:
            return m.ErrorMessage(code="bad_wish", text=str(error))
        if text:
            _log.info("%s", text)
        return m.WishReply(
            source=self._source,
            hub=self._keys.hub,
            published_at=now_rfc3339(),
            text=text,
            ignored=self._ignored(),
        )

    async def _patiently(self, wish: m.DeviceWish) -> str:
        """`_grant` for as long as a client waits; TimeoutError where it goes on after that."""
        granting = asyncio.create_task(self._grant(wish), name="wish")
        self._granting.add(granting)
        granting.add_done_callback(self._granting.discard)
        try:
            async with asyncio.timeout(self._patience_s):
                return await asyncio.shield(granting)
        except TimeoutError:
            granting.add_done_callback(_say_late)
            raise
        except asyncio.CancelledError:
            granting.cancel()
            raise

    async def _grant(self, wish: m.DeviceWish) -> str:
        """Do what is wanted; one sentence of what became of it. VadError where it cannot be."""
        if wish.mac is None:
            if (wish.ignore, wish.name, wish.forget) != (None, None, False):
                raise VadError("a wish needs the address of its device")
            return ""
        registry, done = self._registry, []
        device = registry.roster.known(wish.mac)
        if wish.name is not None:
            if not wish.name.isprintable():
                raise VadError("a name is made of letters that can be printed")
            await registry.rename(device.mac, wish.name.strip())
            done.append(f"is called {wish.name.strip()!r}" if wish.name.strip() else "has no given name")
        if wish.ignore is not None:
            await registry.ignore(device.mac, on=wish.ignore)
            done.append("is left alone from now on" if wish.ignore else "is a device again")
        if wish.forget:
            await registry.forget(device.mac)
            done.append("is forgotten with its walks, and new when it joins again")
        return f"{device.mac} {' and '.join(done)}" if done else ""

    def _ignored(self) -> tuple[m.IgnoredDevice, ...]:
        table = self._registry.roster.table
        return tuple(
            m.IgnoredDevice(
                mac=device.mac,
                name=table.name_of(device),
                last_seen=device.last_seen,
                by_settings=table.in_settings(device),
            )
            for device in table.all()
            if table.ignores(device)
        )


def _say_late(wish: asyncio.Task[str]) -> None:
    """What became of a wish whose asker has gone."""
    if wish.cancelled():
        _log.warning("a wish was given up: it could not be kept")
    elif error := wish.exception():
        _log.warning("a wish came to nothing: %s", error)
    else:
        _log.info("%s", wish.result())


def _send(query: zenoh.Query, key: str, reply: m.WishReply | m.ErrorMessage) -> None:
    try:
        with query:
            if isinstance(reply, m.ErrorMessage):
                query.reply_err(m.encode(reply), encoding=m.encoding_of(m.ErrorMessage))
            else:
                query.reply(key, m.encode(reply), encoding=m.encoding_of(m.WishReply))
    except zenoh.ZError as error:
        _log.debug("a reply was lost: %s", error)
