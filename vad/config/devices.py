"""Settings of who may appear on the map."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from vad.config.kinds import AbsolutePath, Interface, Ipv4Text, MacText


class StaticDevice(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A device that is known without a join event.

    mac: its address
    name: what people call it
    ip: where echo requests make it send
    """

    mac: MacText
    name: Annotated[str, Meta(examples=["Lamp by the window"])] | None = None
    ip: Ipv4Text | None = None


class DeviceSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Who may appear on the map.

    hostapd: control sockets, one for each interface
    nl80211: access point interfaces that the kernel tells of, for those without a control socket
    leases: dnsmasq's lease files, for names and addresses; where neither of the two above is given, a lease
        lets its device join
    agents: remote CSI nodes (vad agent) join, too
    makers: a list of makers (IEEE's oui.txt, nmap's or Wireshark's); left out: the system's
    static: devices that are known without joining
    ignore: MACs that never appear
    """

    hostapd: Annotated[tuple[str, ...], Meta(examples=[["/run/hostapd/wlan0"]])] = ()
    nl80211: tuple[Interface, ...] = ()
    leases: Annotated[tuple[str, ...], Meta(examples=[["/var/lib/misc/dnsmasq.leases"]])] = ()
    agents: bool = True
    makers: Annotated[AbsolutePath, Meta(examples=["/usr/share/nmap/nmap-mac-prefixes"])] | None = None
    static: tuple[StaticDevice, ...] = ()
    ignore: tuple[MacText, ...] = ()
