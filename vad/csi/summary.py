"""What is in a CSI log, in numbers; pure."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vad.clock import unwrap_nic_us
from vad.csi.attribution import Attribution
from vad.csi.bfee import NOISE_UNKNOWN_DBM, Bytes
from vad.csi.logfile import read_log
from vad.csi.packets import CsiPackets
from vad.mac import UNKNOWN_MAC, mac_to_text

RATE_40_MHZ = 0x800


@dataclass(frozen=True, slots=True)
class Spread:
    """Lowest, middle and highest of some values."""

    lowest: float
    median: float
    highest: float


@dataclass(frozen=True, slots=True)
class Sender:
    """One transmitter's packets; mac: text, None for those that cannot be told."""

    mac: str | None
    packets: int
    rate_per_s: float | None


@dataclass(frozen=True, slots=True)
class LogSummary:
    """What a log holds; None where nothing can be said.

    n_bytes: all of it; truncated_bytes: the incomplete record at the end; records: by code (0xbb ...);
    bad: refused records by reason; packets: sound CSI records; shapes: packets by receive x transmit
    antennas and bandwidth; span_s: by the NIC's counter, from the first packet to the last; rate_per_s: mean;
    interval_ms: between packets; gaps, lost: places where bfee_count does not go on, packets missing there;
    counter_still: the NIC's counter never advances, so nothing is known of time; senders: most packets
    first; unattributed: packets without a sender by reason; rssi_db: by antenna; noise_dbm: where it is
    known; noise_known: share of the packets for which it is; agc_db.
    """

    n_bytes: int
    truncated_bytes: int
    records: dict[str, int]
    bad: dict[str, int]
    packets: int
    shapes: dict[str, int]
    span_s: float | None
    rate_per_s: float | None
    interval_ms: Spread | None
    gaps: int
    lost: int
    counter_still: bool
    senders: list[Sender]
    unattributed: dict[str, int]
    rssi_db: dict[str, Spread]
    noise_dbm: Spread | None
    noise_known: float
    agc_db: Spread | None


def summarise(log: Bytes) -> LogSummary:
    """Read a whole log and tell what is in it; broken parts are counted, never an error."""
    attribution = Attribution()
    packets, stats = read_log(log, attribution)
    step_us = np.diff(unwrap_nic_us(packets.nic_us))
    still = len(step_us) > 0 and not step_us.any()
    span_s = float(step_us.sum()) / 1e6 if len(step_us) and not still else None
    known = packets.noise_dbm != NOISE_UNKNOWN_DBM
    rssi = {
        name: _spread(packets.rssi[packets.rssi[:, antenna] > 0, antenna])
        for antenna, name in enumerate("ABC")
    }
    return LogSummary(
        n_bytes=stats.n_bytes,
        truncated_bytes=stats.truncated_bytes,
        records={f"{code:#04x}": n for code, n in sorted(stats.records.items())},
        bad=dict(stats.bad),
        packets=len(packets),
        shapes=_shapes(packets),
        span_s=span_s,
        rate_per_s=_rate(len(packets), span_s),
        interval_ms=None if still else _spread(step_us / 1e3),
        gaps=stats.gaps,
        lost=stats.lost,
        counter_still=still,
        senders=_senders(packets.mac, span_s),
        unattributed=dict(attribution.unknown),
        rssi_db={name: spread for name, spread in rssi.items() if spread is not None},
        noise_dbm=_spread(packets.noise_dbm[known]),
        noise_known=float(known.mean()) if len(packets) else 0.0,
        agc_db=_spread(packets.agc),
    )


def _spread(values: ArrayLike) -> Spread | None:
    found = np.asarray(values, np.float64)
    if not len(found):
        return None
    return Spread(float(found.min()), float(np.median(found)), float(found.max()))


def _rate(packets: int, span_s: float | None) -> float | None:
    return (packets - 1) / span_s if span_s else None


def _shapes(packets: CsiPackets) -> dict[str, int]:
    wide = packets.rate & RATE_40_MHZ != 0
    shapes = Counter(zip(packets.n_rx.tolist(), packets.n_tx.tolist(), wide.tolist(), strict=True))
    return {
        f"{n_rx}x{n_tx} {40 if mhz_40 else 20} MHz": n for (n_rx, n_tx, mhz_40), n in shapes.most_common()
    }


def _senders(mac: NDArray[np.int64], span_s: float | None) -> list[Sender]:
    found = Counter(mac.tolist()).most_common()
    return [
        Sender(None if sender == UNKNOWN_MAC else mac_to_text(sender), n, _rate(n, span_s))
        for sender, n in found
    ]
