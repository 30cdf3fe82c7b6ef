"""CSI packets as arrays, and the contract of every CSI source."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vad.health import Health
from vad.streams import DropOldestQueue

UNKNOWN_ARRIVAL = -1


@dataclass(frozen=True, slots=True)
class CsiPackets:
    """N packets in the order of their reception (struct of arrays, axis 0 = packet).

    arrival_ns  int64 (N,)   arrival on the timeline; UNKNOWN_ARRIVAL where it was not recorded
    nic_us      uint32 (N,)  the NIC's 1 MHz counter, wraps
    bfee_count  uint16 (N,)  the driver's count, wraps
    n_rx, n_tx  uint8 (N,)
    rssi        uint8 (N, 3) antennas A, B, C; 0 = absent
    noise_dbm   int8 (N,)    -127 = unknown
    agc         uint8 (N,)
    antenna_sel uint8 (N,)
    rate        uint16 (N,)  rate_n_flags: 0x100 HT, 0x800 40 MHz, low bits MCS
    mac         int64 (N,)   the transmitter (vad.mac); UNKNOWN_MAC where it cannot be told
    csi         complex64 (N, 30, R, T), rows in antenna order (perm applied), raw units; R, T are the
                largest n_rx, n_tx of the batch, what a packet lacks is 0
    """

    arrival_ns: NDArray[np.int64]
    nic_us: NDArray[np.uint32]
    bfee_count: NDArray[np.uint16]
    n_rx: NDArray[np.uint8]
    n_tx: NDArray[np.uint8]
    rssi: NDArray[np.uint8]
    noise_dbm: NDArray[np.int8]
    agc: NDArray[np.uint8]
    antenna_sel: NDArray[np.uint8]
    rate: NDArray[np.uint16]
    mac: NDArray[np.int64]
    csi: NDArray[np.complex64]

    def __len__(self) -> int:
        return len(self.nic_us)


@dataclass(frozen=True, slots=True)
class CsiBatch:
    """What a live source hands over at once: the packets and the raw log bytes they came from.

    packets: decoded 0xBB records in order; raw: the same stretch byte for byte in the format of the CSI
    Tool's log_to_file (all codes: u16 big-endian length, code, body), so that a session folder keeps
    exactly what came; raw_offsets: int64 (N,) start of packet i's 0xBB record (its length field) in raw;
    records without a packet (0xC1 and others) lie between.
    """

    packets: CsiPackets
    raw: bytes
    raw_offsets: NDArray[np.int64]


class CsiSource(Protocol):
    """A CSI source: `run` emits batches until it is cancelled and reopens by itself."""

    health: Health

    async def run(self, out: DropOldestQueue[CsiBatch]) -> None:
        """Emit batches into `out` until cancelled; trouble goes into `health`, never out of here."""
        ...
