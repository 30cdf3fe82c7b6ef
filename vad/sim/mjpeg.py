"""A simulated network camera: MJPEG over HTTP as mjpg-streamer or ustreamer send it."""

from __future__ import annotations

import asyncio
import time
from typing import Literal, Self

from vad.streams import DropOldestQueue

Style = Literal["mjpg-streamer", "ustreamer"]

_BOUNDARY = "boundarydonotcross"
_REQUEST_TIMEOUT_S = 5.0
_MAX_REQUEST_BYTES = 8192
# A client that is this many pictures behind loses the oldest.
_WAITING = 2


class MjpegServer:
    """Sends every published picture to every client; a slow client misses pictures, nobody waits for it.

    Args:
        host, port: where to listen; port 0 takes a free one, see `port`.
        style: whose headers. mjpg-streamer: X-Timestamp is the driver's stamp, CLOCK_MONOTONIC. ustreamer:
            X-Timestamp is the wall clock at sending; the time of grabbing, CLOCK_MONOTONIC, comes as
            X-UStreamer-Grab-Time to clients that ask with `?extra_headers=1`.
    """

    def __init__(self, host: str, port: int, *, style: Style = "mjpg-streamer") -> None:
        self._host = host
        self._style = style
        self.port = port
        self.dropped = 0
        self._server: asyncio.Server | None = None
        self._clients: set[DropOldestQueue[tuple[bytes, int]]] = set()
        self._tasks: set[asyncio.Task[None]] = set()

    @property
    def url(self) -> str:
        """The stream's address."""
        return f"http://{self._host}:{self.port}/stream"

    @property
    def clients(self) -> int:
        """How many are connected and get pictures."""
        return len(self._clients)

    async def __aenter__(self) -> Self:
        self._server = await asyncio.start_server(
            self._accept, self._host, self.port, limit=_MAX_REQUEST_BYTES
        )
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        if self._server is not None:
            self._server.close()
        self.disconnect()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def publish(self, jpeg: bytes, t_ns: int) -> None:
        """Send one picture, taken at `t_ns` on the timeline, to all clients."""
        for client in self._clients:
            before = client.dropped
            client.put((jpeg, t_ns))
            self.dropped += client.dropped - before

    def disconnect(self) -> None:
        """End every client's connection, as a camera that restarts does."""
        for task in self._tasks:
            task.cancel()

    def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.create_task(self._serve(reader, writer))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        waiting: DropOldestQueue[tuple[bytes, int]] = DropOldestQueue(_WAITING)
        try:
            async with asyncio.timeout(_REQUEST_TIMEOUT_S):
                request = await reader.readuntil(b"\r\n\r\n")
            extra = b"extra_headers=1" in request.partition(b"\r\n")[0]
            writer.write(
                "HTTP/1.0 200 OK\r\nConnection: close\r\nCache-Control: no-store\r\n"
                f"Content-Type: multipart/x-mixed-replace;boundary={_BOUNDARY}\r\n\r\n"
                f"--{_BOUNDARY}\r\n".encode()
            )
            await writer.drain()
            self._clients.add(waiting)
            while True:
                jpeg, t_ns = await waiting.get()
                writer.write(self._head(len(jpeg), t_ns, extra) + jpeg + f"\r\n--{_BOUNDARY}\r\n".encode())
                await writer.drain()
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            return
        finally:
            self._clients.discard(waiting)
            writer.transport.abort()

    def _head(self, length: int, t_ns: int, extra: bool) -> bytes:
        stamp = _seconds(t_ns if self._style == "mjpg-streamer" else time.time_ns())
        head = f"Content-Type: image/jpeg\r\nContent-Length: {length}\r\nX-Timestamp: {stamp}\r\n"
        if extra and self._style == "ustreamer":
            head += f"X-UStreamer-Grab-Time: {_seconds(t_ns)}\r\n"
        return (head + "\r\n").encode()


def _seconds(t_ns: int) -> str:
    return f"{t_ns // 1_000_000_000}.{t_ns % 1_000_000_000 // 1000:06d}"
