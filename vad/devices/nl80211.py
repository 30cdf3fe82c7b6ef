"""The kernel's Wi-Fi stations: generic netlink <-> values, no I/O (formats.md, section 8).

NEW_STATION comes at association, before a WPA handshake has ended, and without the station's flags: whether
it was let in, an answer to GET_STATION tells. pyroute2 knows the attributes.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from pyroute2.netlink import GENL_ID_CTRL, NLM_F_DUMP, NLM_F_REQUEST, ctrlmsg
from pyroute2.netlink.exceptions import NetlinkDecodeError
from pyroute2.netlink.nl80211 import nl80211cmd

from vad.errors import ProtocolError, VadError
from vad.mac import normal_mac

FAMILY = "nl80211"
GROUPS = ("mlme", "config")
"""mlme tells of stations, config of interfaces."""

GET_INTERFACE, NEW_INTERFACE, DEL_INTERFACE = 5, 7, 8
START_AP, STOP_AP = 15, 16
GET_STATION, NEW_STATION, DEL_STATION = 17, 19, 20

_CTRL_GETFAMILY = 3
_NLMSG_ERROR, _NLMSG_DONE = 2, 3
_HEADER = struct.Struct("=IHHII")
_ACCESS_POINT_TYPES = {3, 4}  # AP, AP_VLAN


@dataclass(frozen=True, slots=True)
class Family:
    """The number of a generic netlink family, and of its multicast groups."""

    id: int
    groups: dict[str, int]


@dataclass(frozen=True, slots=True)
class Interface:
    """A wireless interface. present: False where it was removed; access_point: whether stations join it."""

    seq: int
    index: int
    name: str
    access_point: bool
    present: bool = True


@dataclass(frozen=True, slots=True)
class StationSeen:
    """A station of an interface. seq: of the request that this answers, 0 for an event.

    authorized: None where the message does not tell; present: False where it went.
    """

    seq: int
    index: int
    mac: str
    authorized: bool | None
    present: bool = True


@dataclass(frozen=True, slots=True)
class Finished:
    """The answer to a request has ended. error: errno, 0 where all went well."""

    seq: int
    error: int


Message = Family | Interface | StationSeen | Finished


def family_request(seq: int) -> bytes:
    """Ask for the number of the family nl80211."""
    return _encoded(
        ctrlmsg(), GENL_ID_CTRL, NLM_F_REQUEST, seq, _CTRL_GETFAMILY, CTRL_ATTR_FAMILY_NAME=FAMILY
    )


def interfaces_request(family: int, seq: int) -> bytes:
    """Ask for all wireless interfaces."""
    return _encoded(nl80211cmd(), family, NLM_F_REQUEST | NLM_F_DUMP, seq, GET_INTERFACE)


def stations_request(family: int, seq: int, index: int) -> bytes:
    """Ask for all stations of one interface."""
    flags = NLM_F_REQUEST | NLM_F_DUMP
    return _encoded(nl80211cmd(), family, flags, seq, GET_STATION, NL80211_ATTR_IFINDEX=index)


def parse_datagram(data: bytes, family: int | None) -> Iterator[Message]:
    """The messages of one datagram that say something to us; ProtocolError where it is no netlink.

    family: the number of nl80211, None as long as it is not known.
    """
    at = 0
    while at < len(data):
        if at + _HEADER.size > len(data):
            raise ProtocolError("a netlink message breaks off")
        length, kind, _, seq, _ = _HEADER.unpack_from(data, at)
        if length < _HEADER.size or at + length > len(data):
            raise ProtocolError("a netlink message has an impossible length")
        message = _message(data[at : at + length], kind, seq, family)
        if message is not None:
            yield message
        at += (length + 3) & ~3


def _message(data: bytes, kind: int, seq: int, family: int | None) -> Message | None:
    if kind in (_NLMSG_ERROR, _NLMSG_DONE):
        (code,) = struct.unpack_from("=i", data, _HEADER.size) if len(data) >= _HEADER.size + 4 else (0,)
        return Finished(seq, -code)
    if kind not in (GENL_ID_CTRL, family):
        return None
    try:
        # pyroute2 decodes an attribute when it is asked for, and raises what its bytes lead it to
        if kind == GENL_ID_CTRL:
            return _family(_decoded(ctrlmsg(data)))
        return _of_nl80211(_decoded(nl80211cmd(data)), seq)
    except (NetlinkDecodeError, struct.error, LookupError, ValueError, TypeError, AttributeError) as error:
        raise ProtocolError(f"an nl80211 message cannot be read ({error})") from error
    except VadError as error:
        raise ProtocolError(error.what) from error


def _family(message: Any) -> Family | None:
    if message.get_attr("CTRL_ATTR_FAMILY_NAME") != FAMILY:
        return None
    groups = {
        group.get_attr("CTRL_ATTR_MCAST_GRP_NAME"): group.get_attr("CTRL_ATTR_MCAST_GRP_ID")
        for group in message.get_attr("CTRL_ATTR_MCAST_GROUPS") or ()
    }
    return Family(message.get_attr("CTRL_ATTR_FAMILY_ID"), groups)


def _of_nl80211(message: Any, seq: int) -> Interface | StationSeen | None:
    command, index = message["cmd"], message.get_attr("NL80211_ATTR_IFINDEX")
    if index is None:
        return None
    if command in (NEW_INTERFACE, DEL_INTERFACE, START_AP, STOP_AP):
        access_point = message.get_attr("NL80211_ATTR_IFTYPE") in _ACCESS_POINT_TYPES
        name = message.get_attr("NL80211_ATTR_IFNAME") or ""
        return Interface(seq, index, name, access_point, command != DEL_INTERFACE)
    mac = message.get_attr("NL80211_ATTR_MAC")
    if command not in (NEW_STATION, DEL_STATION) or mac is None:
        return None
    info = message.get_attr("NL80211_ATTR_STA_INFO")
    flags = None if info is None else info.get_attr("NL80211_STA_INFO_STA_FLAGS")
    authorized = None if flags is None else bool(flags["AUTHORIZED"])
    return StationSeen(seq, index, normal_mac(mac), authorized, command == NEW_STATION)


def _decoded(message: Any) -> Any:
    message.decode()
    return message


def _encoded(message: Any, kind: int, flags: int, seq: int, command: int, **attributes: object) -> bytes:
    message["cmd"] = command
    message["version"] = 1
    message["attrs"] = list(attributes.items())
    message["header"].update({"type": kind, "flags": flags, "sequence_number": seq, "pid": 0})
    message.encode()
    return bytes(message.data)
