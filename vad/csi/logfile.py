"""Logs in the format of the CSI Tool's log_to_file (formats.md 2), whole or in pieces; no I/O."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from vad.csi.attribution import Attribution, count_steps
from vad.csi.bfee import BFEE_CODE, Bytes, decode_bodies, empty_packets
from vad.csi.packets import CsiBatch, CsiPackets

_LENGTH_BYTES = 2
_HEAD_BYTES = 3  # length and code


@dataclass(slots=True)
class LogStats:
    """What a log held.

    n_bytes: all of it; records: by code; packets: sound CSI records; truncated_bytes: the incomplete
    record at the end; bad: refused records by reason (decode_bodies' reasons, and empty for a record of
    length 0); gaps: places where bfee_count does not go on by one; lost: packets missing there, not
    counting restarts of the counter.
    """

    n_bytes: int = 0
    records: Counter[int] = field(default_factory=Counter)
    packets: int = 0
    truncated_bytes: int = 0
    bad: Counter[str] = field(default_factory=Counter)
    gaps: int = 0
    lost: int = 0


@dataclass(frozen=True, slots=True)
class Records:
    """The complete records of a buffer: int64 (M,) start of each length field; where they end; how many
    records of length 0 were passed over."""

    offsets: NDArray[np.int64]
    end: int
    empty: int


def scan(buffer: Bytes) -> Records:
    """Walk the records of a buffer that starts with one."""
    offsets: list[int] = []
    at, empty, size = 0, 0, len(buffer)
    while at + _LENGTH_BYTES <= size:
        after = at + _LENGTH_BYTES + (buffer[at] << 8 | buffer[at + 1])
        if after > size:
            break
        if after > at + _LENGTH_BYTES:
            offsets.append(at)
        else:
            empty += 1
        at = after
    return Records(np.array(offsets, np.int64), at, empty)


def record(code: int, body: bytes) -> bytes:
    """One record as log_to_file writes it."""
    return (len(body) + 1).to_bytes(_LENGTH_BYTES, "big") + bytes((code,)) + body


class LogReader:
    """Reads a log piece by piece; the pieces may break anywhere.

    Args:
        attribution: fills `mac`; without one it stays unknown.

    Attributes:
        stats: what came so far; its truncated_bytes is the incomplete record which waits for its rest.
    """

    def __init__(self, attribution: Attribution | None = None) -> None:
        self.stats = LogStats()
        self._attribution = attribution
        self._tail = b""
        self._count: int | None = None

    def feed(self, data: bytes) -> CsiBatch:
        """The records that are complete with `data`; perhaps none."""
        self.stats.n_bytes += len(data)
        buffer = self._tail + data
        records = scan(buffer)
        self._tail = buffer[records.end :]
        self.stats.truncated_bytes = len(self._tail)
        packets, offsets = self.decode(buffer, records)
        return CsiBatch(packets, buffer[: records.end], offsets)

    def restart(self) -> None:
        """Another log begins: give up the incomplete record and the count; the stats go on."""
        self._tail = b""
        self._count = None
        self.stats.truncated_bytes = 0

    def mark_loss(self) -> None:
        """Records were lost here: the next packet's sender is unknown."""
        if self._attribution is not None:
            self._attribution.mark_loss()

    @property
    def unattributed(self) -> Counter[str]:
        """Packets without a sender so far, by reason (vad.csi.attribution)."""
        return Counter() if self._attribution is None else self._attribution.unknown

    def decode(self, buffer: Bytes, records: Records) -> tuple[CsiPackets, NDArray[np.int64]]:
        """Packets of the next records, which lie complete in `buffer`, and where each one's record starts."""
        stats, offsets = self.stats, records.offsets
        if records.empty:
            stats.bad["empty"] += records.empty
        if not len(offsets):
            return empty_packets(), offsets
        data = np.frombuffer(buffer, np.uint8)
        codes = data[offsets + _LENGTH_BYTES]
        bodies = offsets + _HEAD_BYTES
        lengths = (data[offsets].astype(np.int64) << 8 | data[offsets + 1]) - 1
        tally = np.bincount(codes)
        for code in tally.nonzero()[0].tolist():
            stats.records[code] += int(tally[code])
        csi_records = np.flatnonzero(codes == BFEE_CODE)
        decoded = decode_bodies(buffer, bodies[csi_records], lengths[csi_records])
        packets, sound = decoded.packets, csi_records[decoded.index]
        stats.bad.update(decoded.bad)
        stats.packets += len(packets)
        self._count_gaps(packets.bfee_count)
        if self._attribution is not None:
            mac = self._attribution.attribute(buffer, codes, bodies, lengths, sound, packets.bfee_count)
            packets = replace(packets, mac=mac)
        return packets, offsets[sound]

    def _count_gaps(self, bfee_count: NDArray[np.uint16]) -> None:
        if not len(bfee_count):
            return
        step = count_steps(bfee_count, self._count)
        self._count = int(bfee_count[-1])
        missing = step[step != 1] - np.uint16(1)
        if len(missing):
            self.stats.gaps += len(missing)
            # A count that goes backwards shows as a jump of more than half its range.
            self.stats.lost += int(missing[missing < 0x8000].sum(dtype=np.int64))


def read_log(buffer: Bytes, attribution: Attribution | None = None) -> tuple[CsiPackets, LogStats]:
    """Everything in one log; an incomplete record at the end is counted and left out."""
    reader = LogReader(attribution)
    records = scan(buffer)
    packets, _ = reader.decode(buffer, records)
    reader.stats.n_bytes = len(buffer)
    reader.stats.truncated_bytes = len(buffer) - records.end
    return packets, reader.stats
