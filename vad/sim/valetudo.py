"""A robot with Valetudo: serves map JSON as server-sent events like Valetudo's web server (formats.md, 4)."""

from __future__ import annotations

import asyncio
import base64
import contextlib

KEEP_ALIVE_S = 5.0
_PATH = b"/api/v2/robot/state/map/sse"
_HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: text/event-stream\r\nTransfer-Encoding: chunked\r\n\r\n"


class ValetudoServer:
    """Serves whatever JSON is published, the last one to new listeners at once. Use `async with`.

    Args:
        password: `user:password` that listeners must give. port: 0 takes a free one.
        keep_alive_s: between comments that keep the connection alive.
    """

    def __init__(self, port: int = 0, *, password: str = "", keep_alive_s: float = KEEP_ALIVE_S) -> None:
        self.port = port
        self._password = password
        self._keep_alive_s = keep_alive_s
        self._map = b""
        self._fresh = asyncio.Condition()
        self._listeners: set[asyncio.Task[None]] = set()
        self._server: asyncio.Server | None = None

    @property
    def url(self) -> str:
        """What a client is given."""
        user = f"{self._password}@" if self._password else ""
        return f"http://{user}127.0.0.1:{self.port}"

    @property
    def listeners(self) -> int:
        """Connections that are open now."""
        return len(self._listeners)

    async def __aenter__(self) -> ValetudoServer:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", self.port)
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        assert self._server is not None
        self._server.close()
        await self.cut_off()

    async def publish(self, map_json: bytes) -> None:
        """Send a map (one line of JSON) to everyone who listens."""
        async with self._fresh:
            self._map = map_json
            self._fresh.notify_all()

    async def cut_off(self) -> None:
        """End every connection, as Valetudo does to slow readers."""
        tasks = list(self._listeners)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._listeners.add(task)
        try:
            await self._answer(reader, writer)
        except (OSError, asyncio.IncompleteReadError, asyncio.CancelledError):
            return  # gone, or cut off
        finally:
            self._listeners.discard(task)
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        request = await reader.readuntil(b"\r\n\r\n")
        if self._password:
            wanted = b"Authorization: Basic " + base64.b64encode(self._password.encode())
            if wanted not in request:
                writer.write(b"HTTP/1.1 401 Unauthorized\r\nContent-Length: 0\r\n\r\n")
                return await writer.drain()
        if request.split(b" ", 2)[1] != _PATH:
            writer.write(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n")
            return await writer.drain()
        writer.write(_HEAD)
        sent = b""
        while True:
            if self._map is not sent:
                sent = self._map
                writer.write(_chunk(b"event: MapUpdated\ndata: " + sent + b"\n\n"))
            else:
                writer.write(_chunk(b": keep-alive\n\n"))
            await writer.drain()
            await self._next(sent)

    async def _next(self, sent: bytes) -> None:
        """Wait for a new map, or until the next keep-alive is due."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self._keep_alive_s), self._fresh:
                await self._fresh.wait_for(lambda: self._map is not sent)


def _chunk(data: bytes) -> bytes:
    return b"%x\r\n" % len(data) + data + b"\r\n"
