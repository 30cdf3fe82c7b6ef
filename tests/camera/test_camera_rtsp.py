"""The RTSP camera against a server that speaks RTSP and RTP byte for byte, and against GStreamer's own."""

from __future__ import annotations

import subprocess
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from camera_world import running
from numpy.typing import NDArray
from rtsp_world import RtspServer
from waiting import free_port, until

from vad.camera import opencv_capture
from vad.camera.rtsp import RtspCamera, Transport
from vad.errors import ConfigError

STRIPES = 8


def picture(k: int) -> NDArray[np.uint8]:
    """The number `k` (8 bits) as dark and bright stripes: survives JPEG and video coding."""
    image = np.zeros((96, 128, 3), np.uint8)
    for bit in range(STRIPES):
        image[:, bit * 16 : bit * 16 + 16] = 230 if k >> bit & 1 else 20
    return image


def number(image: NDArray[np.uint8]) -> int:
    means = image.reshape(image.shape[0], STRIPES, -1).mean((0, 2))
    return sum(int(mean > 128) << bit for bit, mean in enumerate(means))


async def test_pictures_come_in_order_with_the_streams_times() -> None:
    async with RtspServer(picture, fps=25.0) as server:
        camera = RtspCamera(f"rtsp://127.0.0.1:{server.port}/live")
        async with running(camera) as out:
            await until(lambda: len(out) >= 20)
            frames = out.drain()
        assert camera.health.state == "ok"
        assert camera.health.detail == "128x96, stamps: stream"
        numbers = [number(f.image) for f in frames]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        # Evenly spaced as they were taken, whatever the arrival; and from after they were sent.
        steps_ms = np.diff([f.t_ns for f in frames][5:]) * 1e-6
        assert np.median(steps_ms) == pytest.approx(40.0, abs=1.0)
        late_ms = [(f.t_ns - server.sent[n][1]) * 1e-6 for f, n in zip(frames, numbers, strict=True)]
        assert min(late_ms) > -5.0
        assert frames[-1].t_ns <= time.monotonic_ns()
        assert [f.seq for f in frames] == list(range(len(frames)))


async def test_a_server_that_goes_and_comes_back() -> None:
    async with RtspServer(picture) as server:
        camera = RtspCamera(f"rtsp://user:secret@127.0.0.1:{server.port}/live")
        async with running(camera) as out:
            await until(lambda: len(out) >= 3)
            await server.close()
            await until(lambda: camera.health.state == "degraded")
            assert "secret" not in camera.health.detail
            assert f"127.0.0.1:{server.port}" in camera.health.detail
            await server.listen()
            out.drain()
            await until(lambda: len(out) >= 3)
            assert camera.health.state == "ok"
            assert camera.health.counters["reopens"] >= 1


async def test_the_newest_pictures_win_and_the_others_are_counted() -> None:
    async with RtspServer(picture, fps=50.0) as server:
        camera = RtspCamera(f"rtsp://127.0.0.1:{server.port}/live")
        async with running(camera, depth=2) as out:
            await until(lambda: camera.health.counters["frames"] >= 12)
            frames = out.drain()
            assert [f.seq for f in frames] == [
                camera.health.counters["frames"] - 2,
                camera.health.counters["frames"] - 1,
            ]
            assert camera.health.counters["dropped"] == camera.health.counters["frames"] - 2


async def test_nobody_listens() -> None:
    async with RtspServer(picture) as server:
        port = server.port
    camera = RtspCamera(f"rtsp://127.0.0.1:{port}/live")
    async with running(camera):
        await until(lambda: camera.health.state == "degraded")
        assert "cannot be opened" in camera.health.detail


class Still:
    """A stream whose times do not advance, as some cameras send them."""

    def __init__(self) -> None:
        self._tick = threading.Event()
        self.grabbed = 0

    def isOpened(self) -> bool:  # noqa: N802
        return True

    def grab(self) -> bool:
        self._tick.wait(0.005)
        self.grabbed += 1
        return True

    def retrieve(self) -> tuple[bool, NDArray[np.uint8]]:
        return True, picture(1)

    def get(self, prop: int, /) -> float:
        return 0.0

    def release(self) -> None:
        return


class Jittering(Still):
    """A picture every 40 ms by the stream's times, which come 5 to 35 ms late."""

    def get(self, prop: int, /) -> float:
        return 40.0 * self.grabbed

    def arrival_ms(self) -> float:
        return 40.0 * self.grabbed + (30.0, 5.0, 12.0, 35.0, 20.0)[self.grabbed % 5]


async def test_jitter_of_the_arrival_goes_and_the_least_delay_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    stream, start_ns = Jittering(), time.monotonic_ns()
    clock = SimpleNamespace(monotonic_ns=lambda: start_ns + round(1e6 * stream.arrival_ms()))
    monkeypatch.setattr(opencv_capture, "time", clock)
    async with running(RtspCamera("rtsp://camera/live", opener=lambda url, transport: stream)) as out:
        await until(lambda: len(out) >= 20)
        frames = out.drain()
    late_ms = [1e-6 * (f.t_ns - start_ns) - 40.0 * (f.seq + 1) for f in frames]
    assert late_ms[5:] == pytest.approx([5.0] * (len(frames) - 5), abs=1.0)


async def test_times_that_do_not_advance_give_way_to_the_arrival() -> None:
    def open_still(url: str, transport: Transport) -> Still:
        return Still()

    camera = RtspCamera("rtsp://camera/live", opener=open_still)
    async with running(camera) as out:
        before_ns = time.monotonic_ns()
        await until(lambda: len(out) >= 20)
        last = out.drain()[-1]
        assert camera.health.detail.endswith("arrival")
        assert camera.health.counters["arrival_stamps"] >= 1
        assert before_ns <= last.t_ns <= time.monotonic_ns()


@pytest.mark.parametrize("url", ["http://camera/live", "rtsp:///live", "rtsp://camera:port/live", "camera"])
def test_addresses_that_are_none(url: str) -> None:
    with pytest.raises(ConfigError):
        RtspCamera(url)


def gstreamer(port: int) -> subprocess.Popen[str]:
    """GStreamer's own RTSP server; the test is skipped where Debian's packages for it are missing."""
    python, script = Path("/usr/bin/python3"), Path(__file__).parent / "gst_rtsp.py"
    wanted = "import gi; gi.require_version('GstRtspServer', '1.0')"
    if not python.exists() or subprocess.run([python, "-c", wanted], capture_output=True).returncode:
        pytest.skip(
            "no GStreamer: apt-get install gir1.2-gst-rtsp-server-1.0 gstreamer1.0-plugins-ugly python3-gi"
        )
    return subprocess.Popen(
        [python, script, str(port)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )


@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.parametrize("transport", ["tcp", "udp"])
async def test_h264_of_gstreamers_server(transport: Transport) -> None:
    port = free_port()
    with gstreamer(port) as server:
        assert server.stdout is not None
        assert int(server.stdout.readline()) == port
        camera = RtspCamera(f"rtsp://127.0.0.1:{port}/live", transport=transport)
        async with running(camera) as out:
            await until(lambda: len(out) >= 50)
            frames = out.drain()
            assert camera.health.detail == "320x240, stamps: stream"
            steps_ms = np.diff([f.t_ns for f in frames]) * 1e-6
            assert np.median(steps_ms[10:]) == pytest.approx(40.0, abs=2.0)
            assert frames[0].image.shape == (240, 320, 3)
            server.terminate()
            await until(lambda: camera.health.state == "degraded")
        with gstreamer(port) as again:
            assert again.stdout is not None
            assert int(again.stdout.readline()) == port
            async with running(camera) as out:
                await until(lambda: len(out) >= 10)
            again.terminate()
