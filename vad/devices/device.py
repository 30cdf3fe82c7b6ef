"""A device as the network knows it, and what may become of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vad.devices.identity import is_random, telling_host_name

MAX_MACS = 16
"""Addresses that are kept of one device: the first and the latest."""


@dataclass(frozen=True, slots=True)
class Device:
    """A device as the network knows it.

    Attributes:
        mac: the address it was first seen with: its name everywhere, for good.
        macs: every address it had (MAX_MACS at most), the present one last; `mac` among them.
        first_seen, last_seen: RFC 3339 UTC; last_seen: when it last came or went.
        name: given by a person at run time. host_name: what it calls itself.
        client_id: the part of its DHCP client identifier that does not depend on the MAC.
        ip: the IPv4 address it was last given; no other device has it.
        vendor: who made it, by the first of its addresses that is not random.
        agent: its id where it is a remote CSI node.
        ignored: a person asked at run time to leave it alone (see also DeviceTable.ignores).
        moved: new evidence contradicts its place on the map.
        shared: its host name or client id turned out to belong to another device, too: it joins no addresses.
    """

    mac: str
    macs: tuple[str, ...]
    first_seen: str
    last_seen: str
    name: str | None = None
    host_name: str | None = None
    client_id: str | None = None
    ip: str | None = None
    vendor: str | None = None
    agent: str | None = None
    ignored: bool = False
    moved: bool = False
    shared: bool = False

    @property
    def current_mac(self) -> str:
        """The address it sends with."""
        return self.macs[-1]

    @property
    def random_mac(self) -> bool:
        """Whether its present address is made up."""
        return is_random(self.current_mac)

    @property
    def identities(self) -> tuple[str, ...]:
        """What tells this device from others whatever its address is, the surest first."""
        name = telling_host_name(self.host_name)
        return tuple(
            f"{kind} {text}" for kind, text in (("id", self.client_id), ("name", name)) if text is not None
        )


@dataclass(frozen=True, slots=True)
class Change:
    """What an event did to the table. gone: `device` was dropped, or became part of the device `into`."""

    kind: Literal["new", "changed", "gone"]
    device: Device
    into: str | None = None


def bounded(macs: tuple[str, ...], first: str) -> tuple[str, ...]:
    """The addresses, at most MAX_MACS: the latest, and the first one for good."""
    if len(macs) <= MAX_MACS:
        return macs
    latest = macs[-MAX_MACS:]
    return latest if first in latest else (first, *latest[1:])
