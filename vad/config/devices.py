"""Settings of who may appear on the map."""

from __future__ import annotations

import msgspec

from vad.config.kinds import AbsolutePath, Ipv4Text, MacText


class StaticDevice(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A device that is known without a join event. ip: where echo requests make it send."""

    mac: MacText
    name: str | None = None
    ip: Ipv4Text | None = None


class DeviceSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Who may appear on the map.

    hostapd: control sockets, e.g. /run/hostapd/wlan0. nl80211: access point interfaces that the kernel tells
    of, for those without a control socket. leases: dnsmasq's lease files, for names and addresses; where
    neither of the others is given, a lease lets its device join. agents: remote CSI nodes join, too. makers:
    a list of makers (absolute path of IEEE's oui.txt, nmap's or Wireshark's); left out: the system's.
    """

    hostapd: tuple[str, ...] = ()
    nl80211: tuple[str, ...] = ()
    leases: tuple[str, ...] = ()
    agents: bool = True
    makers: AbsolutePath | None = None
    static: tuple[StaticDevice, ...] = ()
    ignore: tuple[MacText, ...] = ()
