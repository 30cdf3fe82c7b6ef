"""Why a station has no CSI: what its received frames were like (formats.md 2); pure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vad.csi.dot11 import FRAME_CODE, frame_facts
from vad.csi.logfile import scan
from vad.csi.packets import CsiBatch
from vad.mac import UNKNOWN_MAC

WINDOW_NS = 5_000_000_000
"""Counts are over the last one to two of these."""
_KEPT_STATIONS = 512
_BB_RECORD_BYTES = 2 + 1 + 20 + 12  # length, code, header, and what is left of the payload without antennas

NOT_HEARD = "it is not heard at all"
ENCRYPTED = "its frames are encrypted: the card gives CSI on open networks only"
LEGACY = "it is heard, but only in frames without CSI (legacy rates)"
NO_FRAMES = "CSI comes without frames, so nobody's packets can be told: set the driver's connector_log to 5"


@dataclass(slots=True)
class Tally:
    """One station's frames: all, encrypted data frames, other data frames; its packets with CSI."""

    frames: int = 0
    encrypted: int = 0
    plain_data: int = 0
    packets: int = 0

    def add(self, other: Tally) -> None:
        """Count the other one's too."""
        self.frames += other.frames
        self.encrypted += other.encrypted
        self.plain_data += other.plain_data
        self.packets += other.packets


class HeardStations:
    """Counts every station's frames and packets of the last seconds; bounded however many there are."""

    def __init__(self) -> None:
        self._now: dict[int, Tally] = {}
        self._before: dict[int, Tally] = {}
        self._since_ns: int | None = None

    def take(self, batch: CsiBatch, now_ns: int) -> None:
        """Count a batch that came at about `now_ns`."""
        self._turn(now_ns)
        packets = batch.packets
        stations, counts = np.unique(packets.mac, return_counts=True)
        for mac, n in zip(stations.tolist(), counts.tolist(), strict=True):
            self._tally(mac).packets += n
        csi_bytes = 60 * int((packets.n_rx.astype(np.int64) * packets.n_tx).sum())
        if csi_bytes + _BB_RECORD_BYTES * len(packets) == len(batch.raw):
            return  # there is nothing but CSI
        offsets = scan(batch.raw).offsets
        data = np.frombuffer(batch.raw, np.uint8)
        offsets = offsets[data[offsets + 2] == FRAME_CODE]
        lengths = (data[offsets].astype(np.int64) << 8 | data[offsets + 1]) - 1
        facts = frame_facts(batch.raw, offsets + 3, lengths)
        senders, station = np.unique(facts.sender, return_inverse=True)
        encrypted = np.bincount(station, facts.is_data & facts.is_protected, len(senders))
        plain = np.bincount(station, facts.is_data & ~facts.is_protected, len(senders))
        for i, (mac, n) in enumerate(zip(senders.tolist(), np.bincount(station).tolist(), strict=True)):
            self._tally(mac).add(Tally(n, int(encrypted[i]), int(plain[i])))

    def tally(self, mac: int, now_ns: int) -> Tally:
        """What was heard of the station in the last seconds."""
        self._turn(now_ns)
        total = Tally()
        for part in (self._now, self._before):
            total.add(part.get(mac, Tally()))
        return total

    def reason(self, mac: int, now_ns: int) -> str:
        """Why the station gives no CSI; empty where it does."""
        heard = self.tally(mac, now_ns)
        if heard.packets:
            return ""
        if heard.encrypted > heard.plain_data:
            return ENCRYPTED
        if heard.frames:
            return LEGACY
        frames = any(tally.frames for part in (self._now, self._before) for tally in part.values())
        nameless = self.tally(UNKNOWN_MAC, now_ns).packets
        return NO_FRAMES if nameless and not frames else NOT_HEARD

    def _tally(self, mac: int) -> Tally:
        if mac not in self._now and len(self._now) >= _KEPT_STATIONS:
            # Made-up addresses come and go: the quietest one makes room.
            del self._now[min(self._now, key=lambda m: self._now[m].frames + self._now[m].packets)]
        return self._now.setdefault(mac, Tally())

    def _turn(self, now_ns: int) -> None:
        """Forget what is too old."""
        age_ns = WINDOW_NS if self._since_ns is None else now_ns - self._since_ns
        if age_ns >= WINDOW_NS:
            self._before = self._now if age_ns < 2 * WINDOW_NS else {}
            self._now = {}
            self._since_ns = now_ns
