"""Rows of the table `identities`: who the devices are, apart from where they are."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable
from typing import Any

from vad.devices.device import Device

COLUMNS = (
    "mac, macs, first_seen, last_seen, name, host_name, client_id, ip, vendor, agent, ignored, moved, shared"
)


def write_identities(db: sqlite3.Connection, kept: Iterable[Device], gone: Iterable[str]) -> None:
    """Write devices as they are now; delete all that is known of those (by MAC) that are none any more."""
    forgotten = [(mac,) for mac in gone]
    db.executemany("DELETE FROM identities WHERE mac = ?", forgotten)
    db.executemany("DELETE FROM devices WHERE mac = ?", forgotten)
    marks = ", ".join("?" * len(COLUMNS.split(", ")))
    db.executemany(
        f"INSERT OR REPLACE INTO identities ({COLUMNS}) VALUES ({marks})",
        [
            (
                one.mac,
                json.dumps(one.macs),
                one.first_seen,
                one.last_seen,
                one.name,
                one.host_name,
                one.client_id,
                one.ip,
                one.vendor,
                one.agent,
                one.ignored,
                one.moved,
                one.shared,
            )
            for one in kept
        ],
    )


def read_identity(row: tuple[Any, ...]) -> Device:
    """A row of COLUMNS; ValueError where it is damaged."""
    mac, macs, first, last, name, host_name, client_id, ip, vendor, agent, *flags = row
    known = json.loads(macs)
    if not isinstance(known, list) or mac not in known or not all(isinstance(one, str) for one in known):
        raise ValueError(f"the addresses of {mac} are damaged")
    ignored, moved, shared = map(bool, flags)
    return Device(
        mac, tuple(known), first, last, name, host_name, client_id, ip, vendor, agent, ignored, moved, shared
    )
