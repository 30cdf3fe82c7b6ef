"""Intel 5300 CSI records (code 0xBB, formats.md 2): bytes <-> arrays, no I/O.

A subcarrier starts at bit i (16 Nrx Ntx + 3) + 3 of the payload, LSB first. Three complex values are 48
bits, so with the at most 7 bits before them they fit one 64-bit load: a table per (Nrx, Ntx, antenna_sel)
says where to load, how far to shift and which 16-bit lane is which antenna.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vad.csi.packets import UNKNOWN_ARRIVAL, CsiPackets
from vad.mac import UNKNOWN_MAC

BFEE_CODE = 0xBB
SUBCARRIERS = 30
HEADER_BYTES = 20
NOISE_UNKNOWN_DBM = -127
ASSUMED_NOISE_DBM = -92.0

HEADER = np.dtype(
    [
        ("nic_us", "<u4"),
        ("bfee_count", "<u2"),
        ("reserved", "<u2"),
        ("n_rx", "u1"),
        ("n_tx", "u1"),
        ("rssi", "u1", (3,)),
        ("noise_dbm", "i1"),
        ("agc", "u1"),
        ("antenna_sel", "u1"),
        ("payload_bytes", "<u2"),
        ("rate", "<u2"),
    ]
)

# Records taken at once: the working set of one block stays in the second-level cache.
_BLOCK = 512
_VALUES_PER_WORD = 3
_WORD_BYTES = 8

Bytes = bytes | bytearray | memoryview
"""What the parsers read from; wrap an mmap in a memoryview."""


@dataclass(frozen=True, slots=True)
class Decoded:
    """The result of `decode_bodies`.

    packets: the sound records in order; index: int64 (N,) which of the given bodies each one is;
    bad: how many bodies were refused, by reason (short, shape, length, perm).
    """

    packets: CsiPackets
    index: NDArray[np.int64]
    bad: Counter[str]


def payload_bytes(n_rx: int, n_tx: int) -> int:
    """Length of the CSI payload of one record."""
    return 60 * n_rx * n_tx + 12


def permutation(antenna_sel: int, n_rx: int) -> tuple[int, ...] | None:
    """The antenna (0..2) behind each of the first `n_rx` chains; None where the field makes no sense."""
    perm = tuple(antenna_sel >> 2 * chain & 3 for chain in range(n_rx))
    return perm if len(set(perm)) == n_rx and max(perm) < 3 else None


def _top_antennas() -> NDArray[np.int8]:
    top = np.full((4, 256), -1, np.int8)
    for n_rx in (1, 2, 3):
        for antenna_sel in range(256):
            perm = permutation(antenna_sel, n_rx)
            if perm is not None:
                top[n_rx, antenna_sel] = max(perm)
    return top


# The highest antenna a record uses, by (n_rx, antenna_sel); -1 where antenna_sel makes no sense.
_TOP_ANTENNA = _top_antennas()


@dataclass(frozen=True, slots=True)
class _Table:
    """Where the values of one (n_rx, n_tx, antenna_sel) lie, for a batch of `rows` x `columns`."""

    word_start: NDArray[np.int64]
    word_shift: NDArray[np.uint64]
    lane: NDArray[np.intp]


@lru_cache(maxsize=256)
def _table(n_rx: int, n_tx: int, antenna_sel: int, rows: int, columns: int) -> _Table:
    perm = permutation(antenna_sel, n_rx)
    assert perm is not None  # records with another antenna_sel were refused before
    values = n_rx * n_tx
    words = -(-values // _VALUES_PER_WORD)
    subcarrier = np.arange(SUBCARRIERS)
    bit = (subcarrier[:, None] * (16 * values + 3) + 3 + 16 * _VALUES_PER_WORD * np.arange(words)).ravel()
    # The last words would reach past the payload: load earlier and shift further.
    start = np.minimum(bit >> 3, payload_bytes(n_rx, n_tx) - _WORD_BYTES)
    # What the record lacks comes from one more word, which stays zero.
    lane = np.full((SUBCARRIERS, rows, columns), 4 * len(bit), np.intp)
    for chain, antenna in enumerate(perm):
        for tx in range(n_tx):
            word, part = divmod(chain * n_tx + tx, _VALUES_PER_WORD)
            lane[:, antenna, tx] = (subcarrier * words + word) * 4 + part
    return _Table(
        word_start=start.astype(np.int64) + HEADER_BYTES,
        word_shift=(bit - 8 * start).astype(np.uint64),
        lane=lane.ravel(),
    )


def empty_packets() -> CsiPackets:
    """A batch without packets."""
    return _packets(np.zeros(0, HEADER), np.zeros((0, SUBCARRIERS, 0, 0), np.complex64))


def _packets(header: NDArray[np.void], csi: NDArray[np.complex64]) -> CsiPackets:
    n = len(header)
    fields = {
        name: np.ascontiguousarray(header[name])
        for name in HEADER.names or ()
        if name not in ("reserved", "payload_bytes")
    }
    return CsiPackets(
        arrival_ns=np.full(n, UNKNOWN_ARRIVAL, np.int64),
        mac=np.full(n, UNKNOWN_MAC, np.int64),
        csi=csi,
        **fields,
    )


def decode_bodies(buffer: Bytes, offsets: NDArray[np.int64], lengths: NDArray[np.int64]) -> Decoded:
    """Decode the 0xBB bodies that start at `offsets` (M,) of `buffer` and are `lengths` (M,) bytes long.

    The bodies must lie inside the buffer; what they say is checked: a record is refused when it is
    shorter than its header, has other than 1..3 antennas on a side, a length field or length that does
    not fit them, or an antenna_sel that names an antenna twice or a fourth one. `arrival_ns` and `mac`
    come out unknown. csi's R is the highest antenna used in the batch, at least the largest n_rx: a
    record with two chains on antennas A and C fills rows 0 and 2.
    """
    bad: Counter[str] = Counter()
    data = np.frombuffer(buffer, np.uint8)
    index = np.flatnonzero(lengths >= HEADER_BYTES)
    if len(index) < len(lengths):
        bad["short"] = len(lengths) - len(index)
    if not len(index):
        return Decoded(empty_packets(), index, bad)
    headers = np.ndarray((len(data) - HEADER_BYTES + 1,), HEADER, data, strides=(1,))
    header = headers[offsets[index]]

    n_rx, n_tx = header["n_rx"].astype(np.int64), header["n_tx"].astype(np.int64)
    shape_ok = (n_rx >= 1) & (n_rx <= 3) & (n_tx >= 1) & (n_tx <= 3)
    said = header["payload_bytes"]
    length_ok = (said == 60 * n_rx * n_tx + 12) & (lengths[index] == HEADER_BYTES + said.astype(np.int64))
    perm_ok = _TOP_ANTENNA[np.where(shape_ok, n_rx, 0), header["antenna_sel"]] >= 0
    sound = shape_ok & length_ok & perm_ok
    if not sound.all():
        for reason, refused in (
            ("shape", ~shape_ok),
            ("length", shape_ok & ~length_ok),
            ("perm", shape_ok & length_ok & ~perm_ok),
        ):
            if refused.any():
                bad[reason] = int(refused.sum())
        index, header = index[sound], header[sound]
        if not len(index):
            return Decoded(empty_packets(), index, bad)
    return Decoded(_packets(header, _decode_csi(data, offsets[index], header)), index, bad)


def _decode_csi(
    data: NDArray[np.uint8], offsets: NDArray[np.int64], header: NDArray[np.void]
) -> NDArray[np.complex64]:
    n_rx, n_tx, antenna_sel = (header[name].astype(np.int64) for name in ("n_rx", "n_tx", "antenna_sel"))
    # All three antennas wherever three chains are used; fewer only in batches of smaller records.
    rows = max(int(_TOP_ANTENNA[n_rx, antenna_sel].max()) + 1, int(n_rx.max()))
    columns = int(n_tx.max())
    key = n_rx | n_tx << 2 | antenna_sel << 4
    words = np.ndarray((len(data) - _WORD_BYTES + 1,), np.dtype("<u8"), data, strides=(1,))
    csi = np.empty((len(header), SUBCARRIERS, rows, columns), np.complex64)
    flat = csi.view(np.float32).reshape(len(csi), -1)
    uniform = bool((key == key[0]).all())
    for group in [int(key[0])] if uniform else np.unique(key).tolist():
        table = _table(group & 3, group >> 2 & 3, group >> 4, rows, columns)
        members = np.arange(len(key)) if uniform else np.flatnonzero(key == group)
        for first in range(0, len(members), _BLOCK):
            block = members[first : first + _BLOCK]
            loaded = np.zeros((len(block), len(table.word_start) + 1), np.uint64)
            np.right_shift(
                words[offsets[block][:, None] + table.word_start], table.word_shift, out=loaded[:, :-1]
            )
            values = np.take(loaded.view(np.int16), table.lane, axis=1, mode="clip").view(np.int8)
            # A slice lets numpy cast straight into place.
            flat[slice(first, first + len(block)) if uniform else block] = values
    return csi


def encode_bodies(
    csi: NDArray[np.int8],
    *,
    nic_us: ArrayLike,
    bfee_count: ArrayLike,
    rssi: ArrayLike,
    noise_dbm: ArrayLike = NOISE_UNKNOWN_DBM,
    agc: ArrayLike = 0,
    antenna_sel: ArrayLike = 0b100100,
    rate: ArrayLike = 0x100,
    n_rx: int | None = None,
) -> list[bytes]:
    """0xBB bodies from CSI: the inverse of `decode_bodies`.

    Args:
        csi: int8 (N, 30, A, T, 2), rows by antenna (A, B, C), real then imaginary.
        nic_us, bfee_count, noise_dbm, agc, antenna_sel, rate: scalars or (N,); the two counters wrap.
        rssi: (3,) or (N, 3).
        n_rx: chains; A by default. Less than A where the chains sit on antennas A and C, say.

    Raises ValueError for an antenna_sel which does not name `n_rx` distinct antennas below A.
    """
    count, _, antennas, n_tx, _ = csi.shape
    chains = antennas if n_rx is None else n_rx
    header = np.zeros(count, HEADER)
    header["nic_us"] = np.asarray(nic_us, np.int64) & 0xFFFF_FFFF
    header["bfee_count"] = np.asarray(bfee_count, np.int64) & 0xFFFF
    header["n_rx"], header["n_tx"] = chains, n_tx
    header["payload_bytes"] = payload_bytes(chains, n_tx)
    header["rssi"], header["noise_dbm"], header["agc"] = rssi, noise_dbm, agc
    header["antenna_sel"], header["rate"] = antenna_sel, rate

    size = HEADER_BYTES + payload_bytes(chains, n_tx)
    body = np.zeros((count, size), np.uint8)
    body[:, :HEADER_BYTES] = header.view(np.uint8).reshape(count, HEADER_BYTES)
    values = chains * n_tx * 2
    bit = (np.arange(SUBCARRIERS)[:, None] * (8 * values + 3) + 3 + 8 * np.arange(values)).ravel()
    start, shift = HEADER_BYTES + (bit >> 3), (bit & 7).astype(np.uint16)
    for sel in np.unique(header["antenna_sel"]).tolist():
        perm = permutation(sel, chains)
        if perm is None or max(perm) >= antennas:
            raise ValueError(f"antenna_sel {sel:#x} does not name {chains} of {antennas} antennas")
        members = np.flatnonzero(header["antenna_sel"] == sel)
        ordered = csi[members][:, :, list(perm)].reshape(len(members), -1).view(np.uint8)
        shifted = ordered.astype(np.uint16) << shift
        bits = np.zeros((len(members), size), np.uint8)
        # Values start at least 8 bits apart, so no byte is hit twice within one of the two passes.
        bits[:, start] = shifted & 0xFF
        bits[:, start + 1] |= (shifted >> 8).astype(np.uint8)
        body[members] |= bits
    blob = body.tobytes()
    return [blob[at : at + size] for at in range(0, count * size, size)]


def scaled_csi(packets: CsiPackets) -> NDArray[np.complex128]:
    """The channel H in absolute units: sqrt of signal to noise power; shape as `packets.csi`.

    The scaling of the CSI Tool's get_scaled_csi (formats.md 2). A packet without RSSI or whose CSI is
    all zero gives zeros.
    """
    csi = packets.csi.astype(np.complex128)
    streams = packets.n_rx.astype(np.float64) * packets.n_tx
    rssi = packets.rssi.astype(np.float64)
    rss_mw = np.where(packets.rssi > 0, 10.0 ** (rssi / 10), 0.0).sum(axis=1)
    rss_mw *= 10.0 ** (-(44.0 + packets.agc.astype(np.float64)) / 10)
    csi_power = (csi.real**2 + csi.imag**2).sum(axis=(1, 2, 3)) / SUBCARRIERS
    scale = np.divide(rss_mw, csi_power, out=np.zeros_like(rss_mw), where=csi_power > 0)
    noise_dbm = np.where(
        packets.noise_dbm == NOISE_UNKNOWN_DBM, ASSUMED_NOISE_DBM, packets.noise_dbm.astype(np.float64)
    )
    noise_mw = 10.0 ** (noise_dbm / 10) + scale * streams
    # The card splits its power over the streams; 4.5 dB for three is its own table, not 10 log10(3).
    gain = np.array([1.0, 1.0, np.sqrt(2.0), 10.0**0.225])[packets.n_tx]
    csi *= (np.sqrt(scale / noise_mw) * gain)[:, None, None, None]
    return csi
