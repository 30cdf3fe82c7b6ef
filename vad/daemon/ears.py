"""The daemon's CSI: who is heard and how often, and the stream into a recording."""

from __future__ import annotations

import time
from collections import deque
from functools import partial

import numpy as np

from vad.capture.walk_writer import WalkWriter
from vad.csi.heard import HeardStations
from vad.csi.packets import CsiBatch
from vad.finish import to_the_end
from vad.mac import UNKNOWN_MAC, mac_from_text
from vad.streams import DropOldestQueue

_HEARD_OVER_NS = 2_000_000_000
_KEPT_STATIONS = 512


class Ears:
    """Takes every batch of the CSI source; a recording gets each batch while it is attached.

    Batches that cannot be written in time are held for `drain`, bounded by the source's queue.
    """

    def __init__(self) -> None:
        self._heard: dict[int, deque[tuple[int, int]]] = {}
        self._recording: list[CsiBatch] | None = None
        self._stations = HeardStations()

    async def run(self, batches: DropOldestQueue[CsiBatch]) -> None:
        """Listen until cancelled."""
        while True:
            self._take(await batches.get())

    def heard_per_s(self, mac: str, now_ns: int) -> float:
        """Packets per second of this station over the last two seconds."""
        recent = self._heard.get(mac_from_text(mac), ())
        return sum(n for t, n in recent if now_ns - t <= _HEARD_OVER_NS) / (_HEARD_OVER_NS / 1e9)

    def why_unheard(self, mac: str, now_ns: int) -> str:
        """Why the station gives no CSI; empty where it does."""
        return self._stations.reason(mac_from_text(mac), now_ns)

    def start_recording(self) -> None:
        """Keep every batch from now on."""
        self._recording = []

    def stop_recording(self) -> None:
        """Keep no more; what waits is dropped."""
        self._recording = None

    async def drain(self, writer: WalkWriter) -> None:
        """Write what was recorded since the last call."""
        if self._recording:
            waiting, self._recording = self._recording, []
            await to_the_end(partial(_write, writer, waiting))

    def _take(self, batch: CsiBatch) -> None:
        if self._recording is not None:
            self._recording.append(batch)
        self._stations.take(batch, time.monotonic_ns())
        packets = batch.packets
        if not len(packets):
            return
        last_ns = int(packets.arrival_ns[-1])
        stations, counts = np.unique(packets.mac[packets.mac != UNKNOWN_MAC], return_counts=True)
        for station, count in zip(stations.tolist(), counts.tolist(), strict=True):
            recent = self._heard.setdefault(station, deque(maxlen=400))
            recent.append((last_ns, count))
        while len(self._heard) > _KEPT_STATIONS:
            oldest = min(self._heard, key=lambda s: self._heard[s][-1][0])
            del self._heard[oldest]


def _write(writer: WalkWriter, batches: list[CsiBatch]) -> None:
    for batch in batches:
        writer.append(batch)
