"""Whose packet it is: pairing each CSI record with the frame it belongs to (formats.md 2); no I/O."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from vad.csi.bfee import BFEE_CODE, Bytes
from vad.csi.dot11 import FRAME_CODE, transmitters
from vad.mac import UNKNOWN_MAC

NO_FRAME = "no_frame"
AFTER_LOSS = "after_loss"
LEGACY_FRAME = "legacy_frame"


def count_steps(bfee_count: NDArray[np.uint16], before: int | None) -> NDArray[np.uint16]:
    """By how much each count (N,) is ahead of the one before it, modulo 2^16; 1 where none is missing.

    Args:
        before: the count before the first; None where there was none, which is no gap.
    """
    step = np.ones(len(bfee_count), np.uint16)
    np.subtract(bfee_count[1:], bfee_count[:-1], out=step[1:])
    if before is not None:
        step[0] = (int(bfee_count[0]) - before) & 0xFFFF
    return step


class Attribution:
    """Gives every CSI packet its transmitter, batch after batch of one stream of records.

    The driver logs a frame (0xC1) and then its CSI (0xBB), so a packet belongs to the frame right before
    it: the last 0xC1 since the last 0xBB. Unknown rather than wrong: the packet after a gap in bfee_count
    or after `mark_loss`, a packet without a frame, and one whose frame cannot have been sent as HT (its
    own frame was lost). What cannot be seen is the loss of one single 0xC1 right after a data frame that
    was sent at a legacy rate.

    Args:
        fixed_mac: give every packet this transmitter instead (client mode: the AP; injection).

    Attributes:
        unknown: packets without a transmitter, by reason (no_frame, after_loss, legacy_frame).
    """

    def __init__(self, fixed_mac: int | None = None) -> None:
        self._fixed_mac = fixed_mac
        self.unknown: Counter[str] = Counter()
        self._count: int | None = None
        self._open_frame: int | None = None
        self._lost = False

    def mark_loss(self) -> None:
        """Records were lost here (ENOBUFS, a writer that went away)."""
        self._lost = True
        self._open_frame = None

    def attribute(
        self,
        buffer: Bytes,
        codes: NDArray[np.uint8],
        bodies: NDArray[np.int64],
        lengths: NDArray[np.int64],
        packets: NDArray[np.int64],
        bfee_count: NDArray[np.uint16],
    ) -> NDArray[np.int64]:
        """The transmitters of the packets among the next M records; int64 (N,).

        Args:
            codes, bodies, lengths: code, start and length of each record's body in `buffer`; (M,).
            packets: which of the records are sound CSI records, ascending; (N,).
            bfee_count: their counts; (N,).
        """
        if self._fixed_mac is not None:
            return np.full(len(packets), self._fixed_mac, np.int64)
        frames = np.flatnonzero(codes == FRAME_CODE)
        sender = np.full(len(codes), UNKNOWN_MAC, np.int64)
        sender[frames] = transmitters(buffer, bodies[frames], lengths[frames])

        paired = np.flatnonzero((codes == FRAME_CODE) | (codes == BFEE_CODE))
        if not len(paired):
            return np.zeros(0, np.int64)
        # What the record before each one is; the last batch's open frame stands before the first.
        has_frame = np.empty(len(paired), np.bool_)
        owner = np.empty(len(paired), np.int64)
        has_frame[0] = self._open_frame is not None
        owner[0] = UNKNOWN_MAC if self._open_frame is None else self._open_frame
        np.equal(codes[paired[:-1]], FRAME_CODE, out=has_frame[1:])
        owner[1:] = sender[paired[:-1]]
        last = paired[-1]
        self._open_frame = int(sender[last]) if codes[last] == FRAME_CODE else None

        if not len(packets):
            return np.zeros(0, np.int64)
        place = np.searchsorted(paired, packets)
        mac, has_frame = owner[place], has_frame[place]
        gap = count_steps(bfee_count, self._count) != 1
        gap[0] |= self._lost
        self._count, self._lost = int(bfee_count[-1]), False
        mac[gap] = UNKNOWN_MAC
        for reason, hit in (
            (AFTER_LOSS, gap),
            (NO_FRAME, ~gap & ~has_frame),
            (LEGACY_FRAME, ~gap & has_frame & (mac == UNKNOWN_MAC)),
        ):
            if n := int(hit.sum()):
                self.unknown[reason] += n
        return mac
