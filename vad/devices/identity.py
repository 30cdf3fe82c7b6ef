"""What outlives a random MAC address: client identifiers and host names, as far as they tell one device."""

from __future__ import annotations

import re

from vad.mac import is_locally_administered, mac_from_text

_HEX_BYTES = re.compile(r"[0-9a-f]{2}(:[0-9a-f]{2})*")
_HARDWARE_ADDRESS, _IAID_AND_DUID = 0x01, 0xFF
_MIN_ID_BYTES = 6
"""Shorter identifiers are counters and types, not names."""

GENERIC_NAMES = frozenset(
    (
        "android",
        "espressif",
        "esp",
        "esp32",
        "esp8266",
        "galaxy",
        "host",
        "ipad",
        "iphone",
        "ipod",
        "kindle",
        "laptop",
        "linux",
        "localhost",
        "macbook",
        "none",
        "nas",
        "node",
        "null",
        "openwrt",
        "pc",
        "phone",
        "printer",
        "raspberrypi",
        "router",
        "tablet",
        "tv",
        "udhcp",
        "unknown",
        "wlan0",
        "windows",
    )
)
"""Host names that whole product lines carry; they tell no device from another."""


def is_random(mac: str) -> bool:
    """True for an address that its owner made up (locally administered)."""
    return is_locally_administered(mac_from_text(mac))


def stable_client_id(client_id: str | None, mac: str) -> str | None:
    """The part of a DHCP client identifier that stays when the MAC changes; None where nothing does.

    RFC 2132, 9.14 and RFC 4361: type 1 is a hardware address, type 255 four bytes of interface and the DUID
    of the whole machine. What contains the station's present MAC is made of it and changes with it.
    """
    text = (client_id or "").lower()
    if not _HEX_BYTES.fullmatch(text):
        return None
    raw, own = bytes.fromhex(text.replace(":", "")), bytes.fromhex(mac.replace(":", ""))
    if raw[0] == _IAID_AND_DUID:
        raw = raw[:1] + raw[5:]
    elif raw[0] == _HARDWARE_ADDRESS and len(raw) == 7 and is_locally_administered(int.from_bytes(raw[1:])):
        return None  # some other random address: gone tomorrow
    if len(raw) < 1 + _MIN_ID_BYTES or own in raw or own.hex().encode() in raw.lower():
        return None
    return raw.hex(":")


def telling_host_name(host_name: str | None) -> str | None:
    """A host name as an identity, lower-case; None where it tells nothing."""
    name = (host_name or "").strip().lower().partition(".")[0]
    return None if len(name) < 3 or name in GENERIC_NAMES else name
