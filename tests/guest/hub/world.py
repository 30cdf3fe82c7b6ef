"""In the guest: a process that is one part of the home, `world.py camera|robot|radio FOLDER`.

Lines of JSON on standard input say what is played: {"play": SEGMENT, "then": SEGMENT, "t_ns": when it begins,
"backwards": true}; {"do": "plug" | "unplug" | "mute" | "speak"}. Each is answered by a line.
"""

from __future__ import annotations

import json
import struct
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from acm import AcmDevice
from uvc import UvcCamera

from vad.sim.driver import ConnectorSender
from vad.sim.neato import VirtualNeato

TICK_S = 0.02
LATE_S = 0.2
"""Packets that are later than this are lost, as in the driver's own queue."""
_BFEE = 0xBB
_NIC_US, _COUNT = struct.Struct("<I"), struct.Struct("<H")


@dataclass(frozen=True, slots=True)
class Playing:
    """What is played, from when on, and what follows it."""

    name: str
    then: str
    start_ns: int
    backwards: bool = False


class Story:
    """What is on at a time. Safe to use from several threads."""

    def __init__(self, folder: Path) -> None:
        self.told = json.loads((folder / "story.json").read_text())
        self.segments: dict[str, Any] = self.told["segments"]
        self._lock = threading.Lock()
        self._now = Playing("start", "start", time.monotonic_ns())

    def play(self, playing: Playing) -> None:
        """Go on with another segment."""
        with self._lock:
            self._now = playing

    def at(self, t_ns: int) -> tuple[str, float, bool]:
        """The segment of t_ns, the seconds since it began, whether it runs backwards."""
        with self._lock:
            now = self._now
        name, since_s, backwards = now.name, (t_ns - now.start_ns) / 1e9, now.backwards
        length_s = self.segments[name]["seconds"]
        if since_s >= length_s and not self.segments[name]["loops"]:
            since_s, name, backwards = since_s - length_s, now.then, False
        return name, max(0.0, since_s) % self.segments[name]["seconds"], backwards

    def pick(self, t_ns: int, what: str, per_s: float) -> Any:
        """What a list of a segment (`frames`, `poses`) says for t_ns."""
        name, since_s, backwards = self.at(t_ns)
        values = self.segments[name][what]
        k = min(int(since_s * per_s + 1e-6), len(values) - 1)
        return values[len(values) - 1 - k if backwards else k]


class Camera:
    """The USB camera: sends each picture at its time."""

    def __init__(self, story: Story, folder: Path) -> None:
        self._story, self._fps = story, float(story.told["fps"])
        self._jpeg = [path.read_bytes() for path in sorted((folder / "frames").glob("*.jpg"))]
        self._grid_ns = 0
        self.device = UvcCamera(self._picture, 640, 480, self._fps)

    def play(self, playing: Playing) -> None:
        """Pictures are due at the segment's begin and every 1 / fps from there on."""
        self._grid_ns = playing.start_ns
        self._story.play(playing)

    def do(self, word: str) -> None:
        """plug, unplug."""
        getattr(self.device, word)()

    def _picture(self, _k: int) -> bytes:
        step_ns = 1e9 / self._fps
        due_ns = self._grid_ns + int(np.ceil((time.monotonic_ns() - self._grid_ns) / step_ns) * step_ns)
        time.sleep(max(0.0, (due_ns - time.monotonic_ns()) / 1e9))
        return self._jpeg[self._story.pick(due_ns, "frames", self._fps)]


class Robot:
    """The Neato on its USB port. It knows its place once it has left its dock."""

    def __init__(self, story: Story) -> None:
        self._story = story
        self._away = False
        self._words = VirtualNeato(self._pose)
        self.device = AcmDevice(self._words.reply_to)

    def play(self, playing: Playing) -> None:
        """Drive, or stand."""
        self._away |= playing.name != "start"
        self._story.play(playing)

    def do(self, word: str) -> None:
        """plug, unplug; mute, speak."""
        if word in ("mute", "speak"):
            self.device.mute = word == "mute"
        else:
            getattr(self.device, word)()

    def _pose(self, t_ns: int) -> tuple[float, float, float] | None:
        if not self._away:
            return None
        x_m, y_m, yaw_rad = self._story.pick(t_ns, "poses", self._story.told["poses_per_s"])
        return x_m, y_m, yaw_rad


class Radio:
    """The Intel 5300's driver: the segment's packets, with one clock and one count throughout."""

    def __init__(self, story: Story, folder: Path) -> None:
        self._story = story
        with np.load(folder / "radio.npz") as arrays:
            kept = {name: arrays[name] for name in arrays.files}
        self._times: dict[str, Any] = {n[:-2]: kept[n] for n in kept if n.endswith("-t")}
        self._records: dict[str, list[bytes]] = {}
        for name in self._times:
            ends = np.cumsum(kept[f"{name}-size"])
            data = kept[f"{name}-data"].tobytes()
            self._records[name] = [
                data[b - n : b] for b, n in zip(ends.tolist(), kept[f"{name}-size"].tolist(), strict=True)
            ]
        self._count = 0
        self._sender = ConnectorSender()
        threading.Thread(target=self._send, daemon=True).start()

    def play(self, playing: Playing) -> None:
        """A walk changes the channel; in `start` and `drive` there is no device yet."""
        self._story.play(playing)

    def _send(self) -> None:
        done_ns = time.monotonic_ns()
        while True:
            time.sleep(TICK_S)
            now_ns = time.monotonic_ns()
            from_ns = max(done_ns, now_ns - int(LATE_S * 1e9))
            name, since_s, _ = self._story.at(now_ns)
            if name in self._times:
                begin_s = max(0.0, since_s - (now_ns - from_ns) / 1e9)
                first, last = np.searchsorted(self._times[name], [begin_s, since_s])
                times = self._times[name][first:last]
                nic_us = ((now_ns / 1e9 - since_s + times) * 1e6).astype(np.int64) & 0xFFFF_FFFF
                records = self._records[name][first:last]
                self._sender.send(
                    [self._stamped(r, n) for r, n in zip(records, nic_us.tolist(), strict=True)]
                )
            done_ns = now_ns

    def _stamped(self, record: bytes, nic_us: int) -> bytes:
        """A CSI record with the card's time and count of now; others as they are."""
        if record[2] != _BFEE:
            return record
        self._count = (self._count + 1) & 0xFFFF
        return record[:3] + _NIC_US.pack(nic_us) + _COUNT.pack(self._count) + record[9:]


def main() -> None:
    kind, folder = sys.argv[1], Path(sys.argv[2])
    story = Story(folder)
    part: Any = {"camera": Camera, "radio": Radio}[kind](story, folder) if kind != "robot" else Robot(story)

    def answer() -> None:
        sys.stdout.write("{}\n")
        sys.stdout.flush()

    answer()
    for line in sys.stdin:
        said = json.loads(line)
        if "play" in said:
            part.play(Playing(said["play"], said["then"], said["t_ns"], said.get("backwards", False)))
        else:
            part.do(said["do"])
        answer()


main()
