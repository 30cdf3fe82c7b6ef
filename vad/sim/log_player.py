"""A recorded CSI log as a radio that vad.sim.driver plays."""

from __future__ import annotations

from bisect import bisect_left
from itertools import pairwise

import numpy as np

from vad.clock import unwrap_nic_us
from vad.csi.bfee import Bytes
from vad.csi.logfile import LogReader, scan

STILL_PACKETS_PER_S = 1000.0
"""The rate of a log whose timestamps do not advance."""


class LogPlayer:
    """Plays a log's records, byte for byte, at the times that the NIC's counter gives, from t = 0.

    A record without a time of its own (0xC1 and others) goes out with the CSI record after it; what comes
    after the last one, and an incomplete record at the end, is left out.

    Args:
        log: in the format of log_to_file.

    Attributes:
        length_s: when the last record has gone out.
    """

    def __init__(self, log: Bytes) -> None:
        reader = LogReader()
        records = scan(log)
        packets, offsets = reader.decode(log, records)
        starts = records.offsets
        t_s = (unwrap_nic_us(packets.nic_us) - int(packets.nic_us[0])) / 1e6 if len(packets) else np.zeros(0)
        if not t_s.any():
            t_s = np.arange(len(t_s)) / STILL_PACKETS_PER_S
        # Reordered records go out in the order in which they were logged.
        t_s = np.maximum.accumulate(t_s)
        ends = np.searchsorted(starts, offsets) + 1
        played = int(ends[-1]) if len(ends) else 0
        self._times = np.repeat(t_s, np.diff(ends, prepend=0)).tolist()
        bounds = [*starts.tolist(), records.end][: played + 1]
        self._records = [bytes(log[a:b]) for a, b in pairwise(bounds)]
        self.length_s = float(t_s[-1]) if len(t_s) else 0.0

    def generate(self, t0_s: float, t1_s: float) -> list[tuple[float, bytes]]:
        """The records with t0_s <= t < t1_s and their times."""
        first, last = bisect_left(self._times, t0_s), bisect_left(self._times, t1_s)
        return list(zip(self._times[first:last], self._records[first:last], strict=True))

    def log_bytes(self, batch: list[tuple[float, bytes]]) -> list[tuple[float, bytes]]:
        """The batch: it is recorded bytes already."""
        return batch
