"""Settings of the radio that hears CSI."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from vad.config.kinds import MacText, Positive


class ConnectorCsi(msgspec.Struct, tag="connector", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Intel 5300 over netlink. group: 26 on every kernel since 2.6.3x; allow_user_space: take packets that do
    not come from the kernel (emulators only)."""

    group: Annotated[int, Meta(ge=1, le=1000)] = 26
    allow_user_space: bool = False


class FollowCsi(msgspec.Struct, tag="follow", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A CSI log that another program writes: a FIFO or a growing file in log_to_file's format."""

    path: str


class RadioSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The hub's CSI radio. antenna_offset_m: where its antennas are from the camera, along the map's axes.

    transmitter: whose all packets are, where the card is no access point (client mode: the AP's address);
    traffic_packets_per_s: echo requests to the device under measurement, if its IP is known; 0 = none.
    """

    source: ConnectorCsi | FollowCsi = ConnectorCsi()
    transmitter: MacText | None = None
    traffic_packets_per_s: Annotated[float, Meta(ge=0, le=2000)] = 400.0
    carrier_hz: Positive = 5.24e9
    bandwidth_mhz: Literal[20, 40] = 20
    antenna_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
