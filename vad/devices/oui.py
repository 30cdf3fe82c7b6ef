"""Who made a device: the first bytes of its MAC in a list that the hub's system has (no list is shipped).

Read are IEEE's oui.txt (Debian: ieee-data), nmap's nmap-mac-prefixes and Wireshark's manuf.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from vad.mac import is_locally_administered, mac_from_text

PLACES = (
    Path("/usr/share/ieee-data/oui.txt"),
    Path("/var/lib/ieee-data/oui.txt"),
    Path("/usr/share/nmap/nmap-mac-prefixes"),
    Path("/usr/share/wireshark/manuf"),
    Path("/usr/share/misc/oui.txt"),
)
MAX_BYTES = 32 << 20
MAX_NAME = 64

_IEEE = re.compile(r"([0-9A-F]{2}-[0-9A-F]{2}-[0-9A-F]{2})\s+\(hex\)\s+(\S.*)", re.IGNORECASE)
_NMAP = re.compile(r"([0-9A-F]{6,9})\s+(?!\(base 16\))(\S.*)", re.IGNORECASE)
_MANUF = re.compile(
    r"((?:[0-9A-F]{2}:){2,5}[0-9A-F]{2})(?:/(\d\d))?\s+(\S[^\t]*)(?:\t+(\S.*))?", re.IGNORECASE
)

_HEX = frozenset("0123456789abcdefABCDEF")

Prefixes = dict[tuple[int, int], str]
"""(bits, value of the first so many bits) -> maker."""


def parse_makers(lines: Iterable[str]) -> Prefixes:
    """The makers in a list of one of the three kinds; lines of no kind are left out."""
    found: Prefixes = {}
    for line in lines:
        entry = _entry(line) if line[:1] in _HEX else None  # oui.txt's addresses of makers begin with tabs
        if entry is not None:
            bits, value, name = entry
            found[bits, value] = " ".join(name.split())[:MAX_NAME]
    return found


def _entry(line: str) -> tuple[int, int, str] | None:
    line = line.rstrip()
    if line[2:3] == "-":
        match = _IEEE.fullmatch(line)
        return None if match is None else (24, int(match[1].replace("-", ""), 16), match[2])
    if line[2:3] != ":":
        match = _NMAP.fullmatch(line)
        return None if match is None else (4 * len(match[1]), int(match[1], 16), match[2])
    match = _MANUF.fullmatch(line)
    if match is None:
        return None
    digits = match[1].replace(":", "")
    whole = 4 * len(digits)
    bits = int(match[2] or whole)
    return None if bits > whole else (bits, int(digits, 16) >> (whole - bits), match[4] or match[3])


class Makers:
    """Looks makers up by MAC; the longest prefix wins."""

    def __init__(self, prefixes: Prefixes) -> None:
        self._prefixes = prefixes
        self._bits = sorted({bits for bits, _ in prefixes}, reverse=True)

    def __len__(self) -> int:
        return len(self._prefixes)

    def of(self, mac: str) -> str | None:
        """The maker; None for a random address and where the list has none."""
        number = mac_from_text(mac)
        if is_locally_administered(number):
            return None
        names = (self._prefixes.get((bits, number >> (48 - bits))) for bits in self._bits)
        return next((name for name in names if name is not None), None)


def load_makers(places: Iterable[Path] = PLACES) -> Makers:
    """The first list that is there, an empty one where none is. Blocking: a tenth of a second."""
    for path in places:
        try:
            if path.stat().st_size > MAX_BYTES:
                continue
            with path.open(encoding="utf-8", errors="replace") as file:
                prefixes = parse_makers(file)
        except OSError:
            continue
        if prefixes:
            return Makers(prefixes)
    return Makers({})
