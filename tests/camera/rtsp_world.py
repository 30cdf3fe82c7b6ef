"""An RTSP server for tests: RTP/JPEG (RFC 2435) interleaved in the TCP connection, byte for byte."""

from __future__ import annotations

import asyncio
import struct
import time
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray
from waiting import free_port

_FRAGMENT = 1200
_CLOCK_HZ = 90_000


class RtspServer:
    """Sends what `picture(k)` draws, `fps` times a second; async with.

    Attributes: port; sent: (RTP time, monotonic ns) of each picture of the newest connection; requests.
    """

    def __init__(self, picture: Callable[[int], NDArray[np.uint8]], *, fps: float = 25.0) -> None:
        self.port = free_port()  # nobody else's while it is closed, either
        self.sent: list[tuple[int, int]] = []
        self.requests: list[str] = []
        self._picture = picture
        self._fps = fps
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._players: set[asyncio.Task[None]] = set()
        self.silent = False

    async def __aenter__(self) -> RtspServer:
        await self.listen()
        return self

    async def __aexit__(self, *error: object) -> None:
        await self.close()

    async def listen(self) -> None:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", self.port)

    async def close(self) -> None:
        """Stop listening and break every connection."""
        assert self._server is not None
        self._server.close()
        for task in tuple(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, *self._players, return_exceptions=True)
        await self._server.wait_closed()
        self._players.clear()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        player: asyncio.Task[None] | None = None
        try:
            while True:
                first = await reader.readexactly(1)
                if first == b"$":  # RTCP from the client
                    _, size = struct.unpack(">BH", await reader.readexactly(3))
                    await reader.readexactly(size)
                    continue
                head = (first + await reader.readuntil(b"\r\n\r\n")).decode()
                method, url, _ = head.split("\r\n", 1)[0].split(" ")
                fields = dict(line.split(": ", 1) for line in head.split("\r\n")[1:] if ": " in line)
                self.requests.append(method)
                body, extra = b"", "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN\r\n"
                if method == "DESCRIBE":
                    lines = ["v=0", "o=- 1 1 IN IP4 127.0.0.1", "s=-", "t=0 0", "m=video 0 RTP/AVP 26"]
                    body = "".join(f"{line}\r\n" for line in [*lines, "a=control:track1"]).encode()
                    extra = f"Content-Type: application/sdp\r\nContent-Base: {url}/\r\n"
                elif method == "SETUP":
                    extra = "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 1;timeout=60\r\n"
                elif method in ("PLAY", "TEARDOWN"):
                    extra = "Session: 1\r\n"
                answer = (
                    f"RTSP/1.0 200 OK\r\nCSeq: {fields['CSeq']}\r\n{extra}Content-Length: {len(body)}\r\n\r\n"
                )
                writer.write(answer.encode() + body)
                await writer.drain()
                if method == "PLAY":
                    player = asyncio.create_task(self._play(writer))
                    self._players.add(player)
                elif method == "TEARDOWN":
                    return
        except (asyncio.IncompleteReadError, ConnectionError, asyncio.CancelledError):
            return
        finally:
            # First what cannot be interrupted: `close` may cancel this task once more.
            self._tasks.discard(task)
            writer.close()
            if player is not None:
                player.cancel()

    async def _play(self, writer: asyncio.StreamWriter) -> None:
        start_ns, sequence = time.monotonic_ns(), 0
        self.sent = []
        k = 0
        while True:
            due_ns = start_ns + round(k * 1e9 / self._fps)
            await asyncio.sleep(max(0.0, 1e-9 * (due_ns - time.monotonic_ns())))
            if not self.silent:
                stamp = 12345 + round(k * _CLOCK_HZ / self._fps)
                for packet in rtp_jpeg(self._picture(k), stamp, sequence):
                    writer.write(b"$\0" + struct.pack(">H", len(packet)) + packet)
                    sequence += 1
                self.sent.append((stamp, due_ns))
                await writer.drain()
            k += 1


def rtp_jpeg(image: NDArray[np.uint8], stamp: int, sequence: int) -> list[bytes]:
    """The RTP packets of one picture whose sides are multiples of 16."""
    jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()
    tables, at = b"", 2
    while True:
        marker, size = struct.unpack_from(">HH", jpeg, at)
        if marker == 0xFFDB:
            segment = jpeg[at + 4 : at + 2 + size]
            for k in range(0, len(segment), 65):
                tables += segment[k + 1 : k + 65]
        at += 2 + size
        if marker == 0xFFDA:
            break
    scan = jpeg[at:-2]
    height, width = image.shape[:2]
    packets = []
    for offset in range(0, len(scan), _FRAGMENT):
        part = scan[offset : offset + _FRAGMENT]
        last = offset + len(part) == len(scan)
        rtp = struct.pack(
            ">BBHII", 0x80, 26 | (0x80 if last else 0), (sequence + len(packets)) & 0xFFFF, stamp, 1
        )
        head = struct.pack(">II", offset, (1 << 24) | (255 << 16) | (width // 8 << 8) | height // 8)
        quantisation = struct.pack(">BBH", 0, 0, len(tables)) + tables if offset == 0 else b""
        packets.append(rtp + head + quantisation + part)
    return packets
