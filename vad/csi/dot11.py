"""The received 802.11 frames of a log (code 0xC1, formats.md 2): who sent them. No I/O."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vad.csi.bfee import Bytes
from vad.mac import UNKNOWN_MAC

FRAME_CODE = 0xC1
INJECTED_MAC = 0x0016_EA12_3456
"""The constant address which the CSI Tool's injection puts into addr1 and addr2."""

_MAC_HEADER_BYTES = 24
_TWO_ADDRESSES_BYTES = 16
_BYTE_WEIGHTS = 1 << np.arange(40, -8, -8, dtype=np.int64)


def transmitters(buffer: Bytes, offsets: NDArray[np.int64], lengths: NDArray[np.int64]) -> NDArray[np.int64]:
    """The transmitter (vad.mac int) of each 0xC1 body at `offsets`, `lengths` bytes long; int64 (M,).

    UNKNOWN_MAC for frames that cannot have caused a CSI record: only HT frames do, and control frames,
    management frames and plain Null frames are sent at legacy rates (ACK and CTS have no addr2 at all).
    The frames of the CSI Tool's injection carry one constant address; there addr3 tells the sender,
    unless it is a group address.
    """
    mac = np.full(len(offsets), UNKNOWN_MAC, np.int64)
    whole = np.flatnonzero(lengths >= _MAC_HEADER_BYTES)
    if not len(whole):
        return mac
    data = np.frombuffer(buffer, np.uint8)
    windows = np.ndarray(
        (len(data) - _MAC_HEADER_BYTES + 1, _MAC_HEADER_BYTES), np.uint8, data, strides=(1, 1)
    )
    frame = windows[offsets[whole]]
    kind, subtype = frame[:, 0] >> 2 & 3, frame[:, 0] >> 4
    carries_csi = (kind == 2) & (subtype != 4)
    addr2 = frame[:, 10:16] @ _BYTE_WEIGHTS
    addr3 = frame[:, 16:22] @ _BYTE_WEIGHTS
    injected = (addr2 == INJECTED_MAC) & (frame[:, 16] & 1 == 0)
    mac[whole] = np.where(carries_csi, np.where(injected, addr3, addr2), UNKNOWN_MAC)
    return mac


@dataclass(frozen=True, slots=True)
class FrameFacts:
    """What F frames say of themselves, whatever they were sent for.

    sender: int64 (F,) addr2; UNKNOWN_MAC where there is none (ACK, CTS, frames that are cut short).
    is_data: bool (F,) a data frame with a payload; is_protected: bool (F,) its payload is encrypted.
    """

    sender: NDArray[np.int64]
    is_data: NDArray[np.bool_]
    is_protected: NDArray[np.bool_]


def frame_facts(buffer: Bytes, offsets: NDArray[np.int64], lengths: NDArray[np.int64]) -> FrameFacts:
    """Sender and kind of each 0xC1 body at `offsets`, `lengths` bytes long (F,)."""
    facts = FrameFacts(
        np.full(len(offsets), UNKNOWN_MAC, np.int64),
        np.zeros(len(offsets), np.bool_),
        np.zeros(len(offsets), np.bool_),
    )
    addressed = np.flatnonzero(lengths >= _TWO_ADDRESSES_BYTES)
    if not len(addressed):
        return facts
    data = np.frombuffer(buffer, np.uint8)
    windows = np.ndarray(
        (len(data) - _TWO_ADDRESSES_BYTES + 1, _TWO_ADDRESSES_BYTES), np.uint8, data, strides=(1, 1)
    )
    frame = windows[offsets[addressed]]
    kind, subtype = frame[:, 0] >> 2 & 3, frame[:, 0] >> 4
    without_sender = (kind == 3) | (kind == 1) & ((subtype < 8) | (subtype == 12) | (subtype == 13))
    facts.sender[addressed] = np.where(without_sender, UNKNOWN_MAC, frame[:, 10:16] @ _BYTE_WEIGHTS)
    facts.is_data[addressed] = (kind == 2) & (subtype & 4 == 0)
    facts.is_protected[addressed] = frame[:, 1] & 0x40 != 0
    return facts


def data_frame(transmitter: int, receiver: int, bssid: int, sequence: int, payload: bytes = b"") -> bytes:
    """A QoS data frame from a station to its AP, with FCS: the body of a 0xC1 record."""
    addresses = b"".join(mac.to_bytes(6, "big") for mac in (receiver, transmitter, bssid))
    header = struct.pack("<HH18sHH", 0x0188, 0, addresses, (sequence & 0xFFF) << 4, 0)
    return header + payload + zlib.crc32(header + payload).to_bytes(4, "little")
