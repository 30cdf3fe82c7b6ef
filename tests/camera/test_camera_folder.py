"""Recordings as cameras: folders with times, videos, what is broken in them, and playing them."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from vad.camera.folder import FolderCamera, Recording
from vad.camera.frame import FrameQueue
from vad.errors import SourceError


def picture(path: Path, value: int) -> None:
    assert cv2.imwrite(str(path), np.full((24, 32, 3), value, np.uint8))


def folder(path: Path, rows: list[str]) -> Path:
    for k in range(4):
        picture(path / f"{k}.png", 10 * k)
    (path / "times.csv").write_text("\n".join(["t_ns,file", *rows]) + "\n")
    return path


def video(path: Path, frames: int = 10, fps: float = 20.0) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), fps, (32, 24))
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no MJPG")
    for k in range(frames):
        writer.write(np.full((24, 32, 3), 20 * k, np.uint8))
    writer.release()
    return path


def test_folder_keeps_its_times(tmp_path: Path) -> None:
    recording = Recording(folder(tmp_path, ["1000,0.png", "2000,1.png", "5000,3.png"]))
    frames = list(recording.frames())
    assert [(f.t_ns, f.seq, int(f.image.mean())) for f in frames] == [
        (1000, 0, 0),
        (2000, 1, 10),
        (5000, 2, 30),
    ]
    assert not recording.counters
    assert len(list(recording.frames())) == 3


def test_broken_rows_are_counted_and_left_out(tmp_path: Path) -> None:
    rows = [
        "1000,0.png",
        "x,1.png",
        "",
        "900,1.png",
        "2000,absent.png",
        "3000,../0.png",
        "4000",
        "5000,3.png",
    ]
    recording = Recording(folder(tmp_path, rows))
    assert [f.t_ns for f in recording.frames()] == [1000, 5000]
    assert recording.counters == {"bad_rows": 4, "times_backwards": 1, "bad_pictures": 1}


def test_video_has_its_own_times_or_given_ones(tmp_path: Path) -> None:
    path = video(tmp_path / "a.avi")
    own = list(Recording(path, start_ns=7).frames())
    assert len(own) == 10
    assert np.diff([f.t_ns for f in own]) == pytest.approx(50_000_000, abs=1_000_000)
    given = list(Recording(path, start_ns=7, fps=5.0).frames())
    assert [f.t_ns for f in given] == [7 + 200_000_000 * k for k in range(10)]


@pytest.mark.parametrize("make", ["nothing", "empty_folder"])
def test_no_recording(tmp_path: Path, make: str) -> None:
    with pytest.raises(SourceError):
        Recording(tmp_path if make == "empty_folder" else tmp_path / "none")


async def test_playing_follows_the_times_and_ends(tmp_path: Path) -> None:
    recording = Recording(folder(tmp_path, ["1000000000,0.png", "1020000000,1.png", "1060000000,2.png"]))
    camera = FolderCamera(recording, speed=0.5)
    out = FrameQueue(10)
    before = time.monotonic_ns()
    async with asyncio.timeout(40.0):
        await camera.run(out)
    frames = out.drain()
    assert [f.t_ns - frames[0].t_ns for f in frames] == [0, 40_000_000, 120_000_000]
    assert frames[0].t_ns >= before
    assert time.monotonic_ns() - before >= 115_000_000
    assert camera.health.state == "ok"
    assert "ended after 3" in camera.health.detail


async def test_a_file_that_is_no_video_is_said(tmp_path: Path) -> None:
    path = tmp_path / "a.avi"
    path.write_bytes(b"no video")
    camera = FolderCamera(Recording(path))
    await camera.run(FrameQueue(1))
    assert camera.health.state == "failed"


def test_speed_is_positive(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="speed"):
        FolderCamera(Recording(folder(tmp_path, [])), speed=0.0)
