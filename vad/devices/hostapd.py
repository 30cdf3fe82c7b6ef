"""hostapd's control interface: datagrams <-> values, no I/O (formats.md, section 8).

Events are `<level>NAME words...`; newer versions append words, so they are recognised by their beginning.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from vad.errors import ProtocolError
from vad.mac import normal_mac

ATTACH = b"ATTACH"
DETACH = b"DETACH"
PING = b"PING"
STA_FIRST = b"STA-FIRST"

_EVENT = re.compile(r"(?:IFNAME=\S+ )?<\d+>(?P<name>[A-Z0-9-]+)(?: (?P<words>.*))?", re.DOTALL)
_MAC = re.compile(r"[0-9a-f]{2}(?::[0-9a-f]{2}){5}", re.IGNORECASE)
_KINDS: dict[str, Literal["joined", "left"]] = {
    "AP-STA-CONNECTED": "joined",
    "AP-STA-DISCONNECTED": "left",
}


@dataclass(frozen=True, slots=True)
class StationChange:
    """A station was let in (after the handshake) or went. mac: lower-case text."""

    kind: Literal["joined", "left"]
    mac: str


@dataclass(frozen=True, slots=True)
class Terminating:
    """hostapd says that it ends."""


@dataclass(frozen=True, slots=True)
class OtherEvent:
    """An event that says nothing about who is in the network."""


@dataclass(frozen=True, slots=True)
class Reply:
    """The answer to a command."""

    text: str


@dataclass(frozen=True, slots=True)
class Station:
    """An entry of hostapd's list; `authorized` is False before the handshake has ended."""

    mac: str
    authorized: bool


Message = StationChange | Terminating | OtherEvent | Reply


def parse_message(datagram: bytes) -> Message:
    """What hostapd sent; ProtocolError for a station event without an address."""
    text = datagram.decode("utf-8", "replace").rstrip("\n")
    event = _EVENT.match(text)
    if event is None:
        return Reply(text)
    name, words = event["name"], event["words"] or ""
    if name in _KINDS:
        return StationChange(_KINDS[name], _leading_mac(words))
    return Terminating() if name == "CTRL-EVENT-TERMINATING" else OtherEvent()


def sta_next(mac: str) -> bytes:
    """The command for the station after `mac` in hostapd's list."""
    return f"STA-NEXT {mac}".encode()


def parse_station(reply: Reply) -> Station | None:
    """The entry in the reply to STA-FIRST or STA-NEXT; None after the last one; ProtocolError for FAIL."""
    if not reply.text:
        return None
    lines = reply.text.splitlines()
    flags = next((line for line in lines if line.startswith("flags=")), None)
    # Versions without the line list only what they let in.
    return Station(_leading_mac(lines[0]), flags is None or "[AUTHORIZED]" in flags)


def _leading_mac(text: str) -> str:
    match = _MAC.match(text)
    if match is None:
        raise ProtocolError(
            f"no station address in {text[:80]!r}", remedy="Is this hostapd's control socket?"
        )
    return normal_mac(match[0])
