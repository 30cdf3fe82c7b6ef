"""dnsmasq's lease file: text -> values, no I/O (formats.md, section 8).

A line is `expiry mac ip name client-id`, a `*` for what is not known. Leases of IPv6 follow after a line
`duid ...` and hold no MAC. A MAC of another kind of network has the kind in front: `20-aa:bb:..`.
"""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass

from vad.errors import VadError
from vad.mac import normal_mac

MAX_LEASES = 4096
"""More than dnsmasq gives out (its dhcp-lease-max is 1000 where nobody raises it)."""


@dataclass(frozen=True, slots=True)
class Lease:
    """An address that was given out. host_name, client_id: None where the station told none."""

    mac: str
    ip: str
    host_name: str | None = None
    client_id: str | None = None


def parse_leases(text: str) -> tuple[dict[str, Lease], int]:
    """The IPv4 leases by MAC, the last of each, and how many lines cannot be read.

    A last line without its line feed is being written: it is left out, and no error.
    """
    leases: dict[str, Lease] = {}
    bad = 0
    lines = text.split("\n")
    for line in lines[:-1]:
        words = line.split()
        if words[:1] == ["duid"]:
            break
        if not words:
            continue
        lease = _lease(words)
        if lease is not None and len(leases) < MAX_LEASES:
            leases.pop(lease.mac, None)
            leases[lease.mac] = lease
        elif lease is None and not _is_of_another_network(words):
            bad += 1
    return leases, bad


def _lease(words: list[str]) -> Lease | None:
    if len(words) < 5 or not words[0].isdecimal():
        return None
    try:
        mac, ip = normal_mac(words[1]), str(ipaddress.IPv4Address(words[2]))
    except (VadError, ValueError):
        return None
    return Lease(mac, ip, _known(words[3]), _known(words[4].lower()))


def _known(word: str) -> str | None:
    return None if word == "*" or not word.isprintable() else word[:255]


def _is_of_another_network(words: list[str]) -> bool:
    return len(words) >= 5 and words[0].isdecimal() and words[1][2:3] == "-"
