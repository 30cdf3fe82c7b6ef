"""Recorded pictures as a camera: an image folder with times, or a video file, played at its own times."""

from __future__ import annotations

import asyncio
import csv
import itertools
import logging
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from vad.camera.frame import Frame, FrameQueue
from vad.errors import SourceError
from vad.health import Health

log = logging.getLogger(__name__)

TIMES_FILE = "times.csv"
# A picture that is due sooner than this is shown at once.
_SOON_S = 0.002


class Recording:
    """Pictures on disk with their times, read one after the other.

    A folder holds `times.csv` (`t_ns,file`, a header line, increasing times) and the pictures it names. A
    video file has the times of its container, or those of `fps` where the container's are wrong. What
    cannot be used is left out and counted.

    Args:
        path: folder or file. start_ns: time of a video's first frame. fps: overrides a video's own times.

    Raises:
        SourceError: neither a folder with times nor a video.
    """

    def __init__(self, path: Path, *, start_ns: int = 0, fps: float | None = None) -> None:
        self.counters: Counter[str] = Counter()
        self._path = path
        self._start_ns = start_ns
        self._fps = fps
        if path.is_dir():
            if not (path / TIMES_FILE).is_file():
                remedy = f"put a {TIMES_FILE} with the columns t_ns,file beside the pictures"
                raise SourceError("the folder has no times", where=str(path), remedy=remedy)
        elif not path.is_file():
            raise SourceError("there is no such folder or video", where=str(path))

    def frames(self) -> Iterator[Frame]:
        """All frames in order, at their recorded times; nothing is dropped.

        Raises:
            SourceError: the file is no video.
        """
        return self._folder() if self._path.is_dir() else self._video()

    def _folder(self) -> Iterator[Frame]:
        seq, last_ns = 0, None
        for t_ns, name in self._times():
            if last_ns is not None and t_ns <= last_ns:
                self._skip("times_backwards", name)
                continue
            image = cv2.imread(str(self._path / name), cv2.IMREAD_COLOR)
            if image is None:
                self._skip("bad_pictures", name)
                continue
            yield Frame(t_ns, seq, np.asarray(image, dtype=np.uint8))
            seq, last_ns = seq + 1, t_ns

    def _times(self) -> Iterator[tuple[int, str]]:
        with (self._path / TIMES_FILE).open(newline="", encoding="utf-8", errors="replace") as file:
            for row in itertools.islice(csv.reader(file), 1, None):
                # Only names beside the list: a recording must not make us read elsewhere.
                if (
                    len(row) < 2
                    or not row[0].isascii()
                    or not row[0].isdigit()
                    or Path(row[1]).name != row[1]
                ):
                    self._skip("bad_rows", ",".join(row))
                    continue
                yield int(row[0]), row[1]

    def _video(self) -> Iterator[Frame]:
        capture = cv2.VideoCapture(str(self._path))
        try:
            if not capture.isOpened():
                raise SourceError("the file is no video that can be read", where=str(self._path))
            for seq in itertools.count():
                good, image = capture.read()
                if not good:
                    return
                since_ns = (
                    round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
                    if self._fps is None
                    else round(seq * 1e9 / self._fps)
                )
                yield Frame(self._start_ns + since_ns, seq, np.asarray(image, dtype=np.uint8))
        finally:
            capture.release()

    def _skip(self, counter: str, what: str) -> None:
        self.counters[counter] += 1
        if self.counters[counter] == 1:
            log.warning("%s: %s: %s", self._path, counter.replace("_", " "), what)


class FolderCamera:
    """Plays a recording once at its own pace, stamped as if it happened now; then `run` returns.

    Args:
        recording: what to play. part: the camera's name in health and logs.
        speed: 2.0 plays twice as fast; the stamps follow.
    """

    def __init__(self, recording: Recording, *, part: str = "camera", speed: float = 1.0) -> None:
        if not speed > 0.0:
            raise ValueError("speed must be positive")
        self.health = Health(part)
        self._recording = recording
        self._speed = speed

    async def run(self, out: FrameQueue) -> None:
        """Emit frames into `out` until the recording ends or this is cancelled."""
        loop = asyncio.get_running_loop()
        frames = self._recording.frames()
        pool = ThreadPoolExecutor(1, thread_name_prefix="folder")
        first_ns: int | None = None
        start_ns = time.monotonic_ns()
        try:
            while True:
                frame = await loop.run_in_executor(pool, next, frames, None)
                if frame is None:
                    break
                if first_ns is None:
                    first_ns, start_ns = frame.t_ns, time.monotonic_ns()
                due_ns = start_ns + round((frame.t_ns - first_ns) / self._speed)
                wait_s = 1e-9 * (due_ns - time.monotonic_ns())
                if wait_s > _SOON_S:
                    await asyncio.sleep(wait_s)
                if not out.wants(due_ns):
                    continue
                out.put(Frame(due_ns, frame.seq, frame.image))
                self.health.counters["frames"] += 1
                self.health.ok("playing a recording")
        except SourceError as error:
            self.health.trouble(str(error), failed=True)
            log.warning("%s: %s", self.health.part, error)
            return
        finally:
            pool.shutdown()
        self.health.counters.update(self._recording.counters)
        self.health.ok(f"the recording has ended after {self.health.counters['frames']} pictures")
