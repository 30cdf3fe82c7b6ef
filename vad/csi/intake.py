"""From a live source's log bytes to finished batches: decoded, attributed, timed, counted; pure."""

from __future__ import annotations

import logging

from vad.csi.attribution import Attribution
from vad.csi.logfile import LogReader
from vad.csi.packets import CsiBatch
from vad.csi.stamping import Stamper
from vad.health import Health

log = logging.getLogger(__name__)


class Intake:
    """What every live source does with the bytes it reads.

    Args:
        health: the source's; its counters get packets, bad_<reason> records, unattributed_<reason> packets
            (vad.csi.attribution), clock_restarts, and still_packets (timed by their arrival because the
            NIC's counter stood still).
        attribution: who the packets are from; pairs frames and CSI by default.
    """

    def __init__(self, health: Health, attribution: Attribution | None) -> None:
        self.reader = LogReader(attribution or Attribution())
        self._health = health
        self._stamper = Stamper()
        self._said_still = False

    def feed(self, data: bytes, read_ns: int, woken_ns: int | None) -> CsiBatch:
        """The records that are complete with `data`; perhaps none.

        Args:
            read_ns: when the last byte had been read.
            woken_ns: when the first record arrived, if the source was empty before it.
        """
        batch = self._stamper.stamp(self.reader.feed(data), read_ns, woken_ns)
        stats, counters, clock = self.reader.stats, self._health.counters, self._stamper.clock
        counters["packets"] += len(batch.packets)
        counters["clock_restarts"] = clock.restarts
        for reason, n in stats.bad.items():
            counters[f"bad_{reason}"] = n
        for reason, n in self.reader.unattributed.items():
            counters[f"unattributed_{reason}"] = n
        if clock.still:
            counters["still_packets"] += len(batch.packets)
            if not self._said_still:
                log.warning("The NIC's counter stands still: packets are timed by their arrival")
                self._said_still = True
        return batch

    def mark_loss(self) -> None:
        """Records were lost here: the next packet's sender is unknown."""
        self.reader.mark_loss()

    def restart(self) -> None:
        """Another log begins; gives up the incomplete record."""
        self.reader.restart()
        self.reader.mark_loss()
