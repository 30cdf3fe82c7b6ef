"""The HTTP camera against the simulated server and against raw sockets that behave as ESP32-CAMs do."""

from __future__ import annotations

import asyncio
import base64
import logging
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from functools import partial

import cv2
import numpy as np
import pytest
from camera_world import running
from waiting import free_port, until

from vad.camera import stamps
from vad.camera.frame import Frame, FrameQueue
from vad.camera.http_stream import HttpStreamCamera, decode_jpeg
from vad.errors import ConfigError
from vad.sim.mjpeg import MjpegServer, Style


def jpeg(value: int, width: int = 64, height: int = 48) -> bytes:
    good, data = cv2.imencode(".jpg", np.full((height, width, 3), value, np.uint8))
    assert good
    return data.tobytes()


async def next_frame(out: FrameQueue) -> Frame:
    async with asyncio.timeout(40.0):
        return await out.get()


@pytest.mark.parametrize(
    ("style", "query", "source", "exact"),
    [
        ("mjpg-streamer", "", "monotonic", True),
        ("ustreamer", "?extra_headers=1", "monotonic", True),
        ("ustreamer", "", "wall", False),
    ],
)
async def test_pictures_come_with_their_times(
    monkeypatch: pytest.MonkeyPatch, style: Style, query: str, source: str, exact: bool
) -> None:
    # A stamp older than 2 s is no camera's, but may be a busy machine's; what is too old has its own test.
    monkeypatch.setattr(stamps, "is_plausible", partial(stamps.is_plausible, oldest_ns=60_000_000_000))
    async with MjpegServer("127.0.0.1", 0, style=style) as server:
        camera = HttpStreamCamera(server.url + query)
        async with running(camera) as out:
            await until(lambda: server.clients == 1)
            for value in (40, 200):
                t_ns = time.monotonic_ns() - 50_000_000
                server.publish(jpeg(value), t_ns)
                frame = await next_frame(out)
                assert abs(int(frame.image.mean()) - value) <= 2
                assert frame.image.shape == (48, 64, 3)
                if exact:
                    assert 0 <= t_ns - frame.t_ns < 1000
                else:
                    assert t_ns < frame.t_ns <= time.monotonic_ns()
            assert frame.seq == 1
            assert camera.health.state == "ok"
            assert source in camera.health.detail
            assert "64x48" in camera.health.detail


async def test_reconnects_and_warns_once(caplog: pytest.LogCaptureFixture) -> None:
    async with MjpegServer("127.0.0.1", 0) as server:
        camera = HttpStreamCamera(server.url, part="hall")
        async with running(camera) as out:
            await until(lambda: server.clients == 1)
            server.publish(jpeg(10), time.monotonic_ns())
            await next_frame(out)
            with caplog.at_level(logging.DEBUG, logger="vad.camera"):
                server.disconnect()
                await until(lambda: camera.health.state == "degraded")
                await until(lambda: server.clients == 1)
            server.publish(jpeg(20), time.monotonic_ns())
            assert (await next_frame(out)).seq == 1
            assert camera.health.counters["reconnects"] >= 1
            assert [r.levelname for r in caplog.records].count("WARNING") == 1


async def test_broken_pictures_are_counted() -> None:
    async with MjpegServer("127.0.0.1", 0) as server:
        camera = HttpStreamCamera(server.url)
        async with running(camera) as out:
            await until(lambda: server.clients == 1)
            server.publish(b"no picture", time.monotonic_ns())
            await until(lambda: camera.health.counters["bad_pictures"] == 1)
            server.publish(jpeg(99), time.monotonic_ns())
            await next_frame(out)
            assert camera.health.state == "ok"


async def test_a_slow_client_misses_pictures_and_another_does_not_wait() -> None:
    async with MjpegServer("127.0.0.1", 0) as server:
        _, stuck = await asyncio.open_connection("127.0.0.1", server.port, limit=1024)
        stuck.write(b"GET / HTTP/1.1\r\n\r\n")
        await until(lambda: server.clients == 1)
        camera = HttpStreamCamera(server.url)
        async with running(camera) as out:
            await until(lambda: server.clients == 2)
            noise = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
            big = cv2.imencode(".jpg", noise, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
            for count in range(40):
                server.publish(big, time.monotonic_ns())
                await until(lambda wanted=count: camera.health.counters["received"] > wanted)
            await next_frame(out)
            assert server.dropped > 0
        stuck.transport.abort()


@asynccontextmanager
async def raw_server(answer: Callable[[bytes], bytes]) -> AsyncIterator[tuple[int, list[bytes]]]:
    """A server of these bytes: its port, and what it was asked. At the end it has done with every client."""
    requests: list[bytes] = []
    clients: set[asyncio.Task[None]] = set()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            request = await reader.readuntil(b"\r\n\r\n")
            requests.append(request)
            writer.write(answer(request))
            await writer.drain()
            # A stream stays open until the client goes; everything else ends with its answer.
            if b"multipart" in answer(request):
                await reader.read()
        except (OSError, asyncio.IncompleteReadError):
            return  # the client went first
        finally:
            writer.close()

    def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        clients.add(asyncio.create_task(serve(reader, writer)))

    async with await asyncio.start_server(accept, "127.0.0.1", 0) as server:
        yield server.sockets[0].getsockname()[1], requests
        server.close()
        await asyncio.gather(*clients)


async def test_esp32_chunks_and_login() -> None:
    body = jpeg(77)
    pieces = [
        b"\r\n--12345\r\n",
        f"Content-Length: {len(body)}\r\nX-Timestamp: 12.000001\r\n\r\n".encode(),
        body,
    ]
    chunks = b"".join(f"{len(p):x}\r\n".encode() + p + b"\r\n" for p in pieces)
    head = (
        b"HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=12345\r\n"
        b"Transfer-Encoding: chunked\r\n\r\n"
    )
    before_ns = time.monotonic_ns()
    async with raw_server(lambda _: head + chunks) as (port, requests):
        camera = HttpStreamCamera(f"http://me:p%40ss@127.0.0.1:{port}/cam?x=1")
        async with running(camera) as out:
            frame = await next_frame(out)
            assert abs(int(frame.image.mean()) - 77) <= 2
            # The ESP32's stamp, seconds since its own start, is none: when it came counts.
            assert before_ns <= frame.t_ns <= time.monotonic_ns()
    assert requests[0].startswith(b"GET /cam?x=1 HTTP/1.1\r\n")
    assert b"Authorization: Basic " + base64.b64encode(b"me:p@ss") in requests[0]


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (b"HTTP/1.1 401 Unauthorized\r\n\r\n", "401 Unauthorized"),
        (b"HTTP/1.1 200 OK\r\nContent-Type: text/html\r\n\r\n<p>", "text/html"),
        (b"SSH-2.0-OpenSSH\r\n\r\n", "not HTTP"),
        (b"", "without an answer"),
        (b"HTTP/1.1 200 OK\r\n" + b"X: y\r\n" * 9000 + b"\r\n", "too long"),
    ],
)
async def test_bad_answers_are_told(answer: bytes, reason: str) -> None:
    async with raw_server(lambda _: answer) as (port, _):
        camera = HttpStreamCamera(f"http://127.0.0.1:{port}/")
        async with running(camera):
            await until(lambda: camera.health.state == "degraded")
        assert reason in camera.health.detail
        assert "me:" not in camera.health.detail


async def test_nobody_listens() -> None:
    camera = HttpStreamCamera(f"http://127.0.0.1:{free_port()}/")
    async with running(camera):
        await until(lambda: camera.health.state == "degraded")


@pytest.mark.parametrize(
    "url", ["rtsp://x/", "https://x/", "http://", "x", "http://h:99999/", "http://[::1/"]
)
def test_other_addresses_are_refused(url: str) -> None:
    with pytest.raises(ConfigError):
        HttpStreamCamera(url)


def test_decode() -> None:
    assert decode_jpeg(b"") is None
    assert decode_jpeg(b"\xff\xd8\xff") is None
    image = decode_jpeg(jpeg(5))
    assert image is not None
    assert image.shape == (48, 64, 3)
