"""Arrival times for batches that were collected before they were read; pure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vad.clock import ClockMap
from vad.csi.packets import CsiBatch


class Stamper:
    """Fills `arrival_ns` of a stream of batches through a clock map from the NIC's counter."""

    def __init__(self) -> None:
        self.clock = ClockMap()
        self._drained_ns: int | None = None

    def stamp(self, batch: CsiBatch, drained_ns: int, woken_ns: int | None = None) -> CsiBatch:
        """The batch with arrival times.

        While the counter stands still, a batch's packets are spread evenly over the time in which they
        arrived: since the wake-up, or since the drain before.

        Args:
            drained_ns: when the last byte had been read: no record arrived later.
            woken_ns: when the first record arrived, if the source was empty before it.
        """
        packets = batch.packets
        n = len(packets)
        if not n:
            return batch
        arrival = np.full(n, drained_ns, np.int64)
        # The wake-up is the first packet's own only if nothing but its frame came before it.
        first_record = 2 + int.from_bytes(batch.raw[:2], "big")
        if woken_ns is not None and int(batch.raw_offsets[0]) in (0, first_record):
            arrival[0] = woken_ns
        times = self.clock.update(packets.nic_us, arrival)
        if self.clock.still:
            since_ns = next((t for t in (woken_ns, self._drained_ns) if t is not None), drained_ns)
            times = drained_ns - (drained_ns - since_ns) * np.arange(n - 1, -1, -1) // n
        self._drained_ns = drained_ns
        return replace(batch, packets=replace(packets, arrival_ns=times))
