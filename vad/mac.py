"""MAC addresses: text `aa:bb:cc:dd:ee:ff` for people, int64 for arrays."""

from __future__ import annotations

import re

from vad.errors import VadError

UNKNOWN_MAC = -1
"""The int for a packet whose transmitter is not known."""

_TEXT = re.compile(r"[0-9a-f]{2}(:[0-9a-f]{2}){5}", re.IGNORECASE)


def mac_from_text(text: str) -> int:
    """`aa:bb:cc:dd:ee:ff` (any case) as an int; VadError for anything else."""
    if not _TEXT.fullmatch(text):
        raise VadError(f"{text!r} is not a MAC address", remedy="Write it as aa:bb:cc:dd:ee:ff")
    return int(text.replace(":", ""), 16)


def mac_to_text(mac: int) -> str:
    """An int from `mac_from_text` as lower-case text."""
    if not 0 <= mac < 1 << 48:
        raise ValueError(f"{mac} is no 48-bit address")
    return ":".join(f"{mac >> shift & 0xFF:02x}" for shift in range(40, -8, -8))


def normal_mac(text: str) -> str:
    """The lower-case form of a MAC address."""
    return mac_to_text(mac_from_text(text))


def is_locally_administered(mac: int) -> bool:
    """True for an address a phone made up for privacy (bit 0x02 of the first byte)."""
    return bool(mac >> 40 & 0x02)
