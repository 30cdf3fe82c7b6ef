"""Network cameras: an MJPEG stream over HTTP (ESP32-CAM, mjpg-streamer, ustreamer, go2rtc)."""

from __future__ import annotations

import asyncio
import base64
import logging
import time
from concurrent.futures import Executor, ThreadPoolExecutor
from urllib.parse import unquote, urlsplit

import cv2
import numpy as np

from vad.camera.frame import BAD_PICTURES, Frame, FrameQueue
from vad.camera.mjpeg import (
    MAX_HEAD_BYTES,
    ChunkedDecoder,
    MultipartParser,
    boundary_of,
    parse_response_head,
)
from vad.camera.stamps import StreamClock
from vad.errors import ConfigError, ProtocolError, SourceError
from vad.health import Health
from vad.streams import DropOldestQueue

log = logging.getLogger(__name__)

CONNECT_TIMEOUT_S = 5.0
SILENCE_TIMEOUT_S = 10.0
BACKOFF_FIRST_S = 0.5
BACKOFF_MAX_S = 10.0
_READ_BYTES = 65_536
# One picture is being decoded, at most this many wait; older ones are dropped before the work.
_WAITING = 2

Undecoded = tuple[int, bytes]


class HttpStreamCamera:
    """An MJPEG stream as a camera; reconnects by itself.

    Args:
        url: `http://[user:password@]host[:port]/path?query`.
        part: the camera's name in health and logs.

    Raises:
        ConfigError: the address is not http.
    """

    def __init__(self, url: str, *, part: str = "camera") -> None:
        try:
            address = urlsplit(url)
            port = address.port or 80
        except ValueError as error:
            raise ConfigError("the camera's address cannot be read", remedy=str(error)) from error
        if address.scheme != "http" or not address.hostname:
            remedy = "give http://host[:port]/path; for other protocols put go2rtc in front"
            raise ConfigError("only http:// streams can be opened", where=part, remedy=remedy)
        self._host, self._port = address.hostname, port
        self._request = _request(address.hostname, port, address.path, address.query, _login(address.netloc))
        self.health = Health(part)
        self._seq = 0

    async def run(self, out: FrameQueue) -> None:
        """Emit frames into `out` until cancelled."""
        backoff_s = BACKOFF_FIRST_S
        while True:
            seq_before = self._seq
            try:
                await self._stream(out)
            except (OSError, TimeoutError, asyncio.IncompleteReadError, ProtocolError, SourceError) as error:
                reason = f"{self._host}:{self._port}: {_say(error)}"
                level = logging.WARNING if self.health.trouble(reason) else logging.DEBUG
                log.log(level, "%s: %s", self.health.part, reason)
            if self._seq > seq_before:
                backoff_s = BACKOFF_FIRST_S
            self.health.counters["reconnects"] += 1
            await asyncio.sleep(backoff_s)
            backoff_s = min(2.0 * backoff_s, BACKOFF_MAX_S)

    async def _stream(self, out: FrameQueue) -> None:
        async with asyncio.timeout(CONNECT_TIMEOUT_S):
            # A picture fits: the connection is not stopped and started again for each.
            reader, writer = await asyncio.open_connection(self._host, self._port, limit=_READ_BYTES)
        waiting: DropOldestQueue[Undecoded] = DropOldestQueue(_WAITING)
        clock = StreamClock()
        pool = ThreadPoolExecutor(1, thread_name_prefix="decode")
        decoder = asyncio.create_task(self._decode(pool, waiting, clock, out))
        try:
            await self._receive(reader, writer, clock, waiting)
        finally:
            decoder.cancel()
            await asyncio.gather(decoder, return_exceptions=True)
            # Waits for the one picture being decoded: milliseconds.
            pool.shutdown()
            writer.close()

    async def _receive(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        clock: StreamClock,
        waiting: DropOldestQueue[Undecoded],
    ) -> None:
        """Put every picture of the stream into `waiting`; ends only by an error."""
        async with asyncio.timeout(CONNECT_TIMEOUT_S):
            writer.write(self._request)
            await writer.drain()
            try:
                raw = await reader.readuntil(b"\r\n\r\n")
            except asyncio.LimitOverrunError as error:
                raise ProtocolError("the answer's head is too long") from error
            if len(raw) > MAX_HEAD_BYTES:
                raise ProtocolError("the answer's head is too long")
            head = parse_response_head(raw)
        if head.status != 200:
            remedy = "put user and password into the address" if head.status == 401 else ""
            raise SourceError(f"the camera answers {head.status} {head.reason}".strip(), remedy=remedy)
        chunks = ChunkedDecoder() if head.headers.get("transfer-encoding", "").lower() == "chunked" else None
        parser = MultipartParser(boundary_of(head))
        counters = self.health.counters
        dropped, refused, bad = 0, 0, 0
        while True:
            async with asyncio.timeout(SILENCE_TIMEOUT_S):
                data = await reader.read(_READ_BYTES)
            if not data:
                raise SourceError("the camera closed the stream")
            arrival_ns, wall_ns = time.monotonic_ns(), time.time_ns()
            for part in parser.receive(chunks.receive(data) if chunks else data):
                waiting.put((clock.stamp(part.headers, arrival_ns, wall_ns), part.body))
                counters["received"] += 1
            counters["dropped"] += waiting.dropped - dropped
            counters["stamps_refused"] += clock.refused - refused
            counters["bad_parts"] += parser.bad - bad
            dropped, refused, bad = waiting.dropped, clock.refused, parser.bad

    async def _decode(
        self,
        pool: Executor,
        waiting: DropOldestQueue[Undecoded],
        clock: StreamClock,
        out: FrameQueue,
    ) -> None:
        loop = asyncio.get_running_loop()
        while True:
            t_ns, jpeg = await waiting.get()
            if not out.wants(t_ns):
                self.health.counters["unwanted"] = out.unwanted
                continue
            image = await loop.run_in_executor(pool, decode_jpeg, jpeg)
            if image is None:
                self.health.counters[BAD_PICTURES] += 1
                if self.health.counters[BAD_PICTURES] == 1:
                    log.warning("%s: a picture of %d bytes cannot be decoded", self.health.part, len(jpeg))
                continue
            out.put(Frame(t_ns, self._seq, image))
            self._seq += 1
            self.health.counters["frames"] += 1
            height, width = image.shape[:2]
            self.health.ok(f"{width}x{height}, stamps: {clock.source}")


def decode_jpeg(data: bytes) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]] | None:
    """A JPEG as (height, width, 3) uint8 BGR; None if it is none."""
    if not data:
        return None
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        return None
    return None if image is None else np.asarray(image, dtype=np.uint8)


def _login(netloc: str) -> str:
    login, at, _ = netloc.rpartition("@")
    return unquote(login) if at else ""


def _request(host: str, port: int, path: str, query: str, login: str) -> bytes:
    target = (path or "/") + (f"?{query}" if query else "")
    shown = f"[{host}]" if ":" in host else host
    lines = [
        f"GET {target} HTTP/1.1",
        f"Host: {shown}" + ("" if port == 80 else f":{port}"),
        "User-Agent: vad",
        "Accept: multipart/x-mixed-replace",
        "Connection: close",
    ]
    if login:
        lines.append("Authorization: Basic " + base64.b64encode(login.encode()).decode())
    return ("\r\n".join(lines) + "\r\n\r\n").encode("utf-8")


def _say(error: Exception) -> str:
    if isinstance(error, TimeoutError):
        return "the camera does not answer"
    if isinstance(error, asyncio.IncompleteReadError):
        return "the camera closed the connection without an answer"
    return str(error)
