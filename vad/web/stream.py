"""Server-sent events: each browser is told what changed since it was last told, at its own pace."""

from __future__ import annotations

import asyncio
import contextlib

from aiohttp import web

from vad.health import Health
from vad.web.feed import Feed, Item
from vad.web.guard import RefusedError

MAX_STREAMS = 16
"""Pages open at one time."""
RETRY_MS = 2000
"""How long a browser waits before it comes back."""
GAP_S = 0.01
"""Between two writes to one browser: a burst of changes goes out together."""
ALIVE_S = 15.0
"""Without a change something is said so often: a browser notices when the hub is gone."""
SLOW_S = 20.0
"""A browser that takes nothing for so long is let go; it comes back, and goes on where it was."""
CHUNK = 48 * 1024
"""Bytes that are handed over at once, and so what a slow browser costs."""


class Streams:
    """All open streams of one feed."""

    def __init__(self, feed: Feed, health: Health) -> None:
        self.watched = asyncio.Event()
        """Set while somebody looks."""
        self._feed = feed
        self._health = health
        self._open = 0
        self._closing = False

    @property
    def count(self) -> int:
        """How many are open now."""
        return self._open

    def close(self) -> None:
        """End all streams soon; none begins any more."""
        self._closing = True
        self._feed.wake()

    async def serve(self, request: web.Request) -> web.StreamResponse:
        """Stream until the browser goes, is too slow, or `close`."""
        if self._open >= MAX_STREAMS or self._closing:
            text = f"{MAX_STREAMS} pages are open already; close one, this one then comes up by itself."
            raise RefusedError(503, "too_many_pages", text, {"Retry-After": "5"})
        self._open += 1
        self.watched.set()
        try:
            return await self._stream(request)
        finally:
            self._open -= 1
            if not self._open:
                self.watched.clear()

    async def _stream(self, request: web.Request) -> web.StreamResponse:
        response = web.StreamResponse(headers={"X-Accel-Buffering": "no"})
        response.content_type = "text/event-stream"
        await response.prepare(request)
        with contextlib.suppress(ConnectionResetError):
            try:
                await self._tell(request, response)
            except TimeoutError:
                self._health.counters["too_slow"] += 1
                if request.transport is not None:
                    request.transport.abort()
        return response

    async def _tell(self, request: web.Request, response: web.StreamResponse) -> None:
        feed = self._feed
        told = feed.position(request.headers.get("Last-Event-ID"))
        begin = f"retry: {RETRY_MS}\n\n"
        if told is None:
            told = 0
            begin += "event: reset\ndata: {}\n\n"
        else:
            self._health.counters["resumed"] += 1
        await self._write(response, begin.encode())
        with feed.watching() as changed:
            while not self._closing:
                changed.clear()
                news = feed.since(told)
                if news:
                    self._health.counters["coalesced"] += news[-1].number - told - len(news) if told else 0
                    await self._send(response, news)
                    told = news[-1].number
                    await asyncio.sleep(GAP_S)
                elif not await _set_within(changed, ALIVE_S):
                    await self._write(response, b"event: alive\ndata: {}\n\n")

    async def _send(self, response: web.StreamResponse, news: list[Item]) -> None:
        chunk = bytearray()
        for item in news:
            key = item.key.encode()  # keys hold neither quotes nor line ends (vad.bus.keys.chunk)
            number = self._feed.event_id(item.number).encode()
            chunk += b'id: %b\ndata: {"key":"%b","value":%b}\n\n' % (number, key, item.value)
            if len(chunk) >= CHUNK:
                await self._write(response, bytes(chunk))
                chunk.clear()
        await self._write(response, bytes(chunk))
        self._health.counters["told"] += len(news)

    async def _write(self, response: web.StreamResponse, data: bytes) -> None:
        async with asyncio.timeout(SLOW_S):
            await response.write(data)


async def _set_within(event: asyncio.Event, seconds: float) -> bool:
    try:
        async with asyncio.timeout(seconds):
            await event.wait()
    except TimeoutError:
        return False
    return True
