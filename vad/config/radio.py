"""Settings of the radio that hears CSI."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from vad.config.kinds import MacText, Positive


class ConnectorCsi(msgspec.Struct, tag="connector", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Intel 5300 with the Linux 802.11n CSI Tool, over netlink.

    group: of the netlink connector; 26 on every kernel since 2.6.3x
    allow_user_space: take packets, too, that do not come from the kernel (emulators only)
    """

    group: Annotated[int, Meta(ge=1, le=1000)] = 26
    allow_user_space: bool = False


class FollowCsi(msgspec.Struct, tag="follow", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A CSI log that another program writes: a FIFO or a growing file in log_to_file's format.

    path: of the FIFO or file
    """

    path: Annotated[str, Meta(examples=["/run/csi/csi.fifo"])]


class RadioSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The hub's CSI radio.

    source: where CSI comes from
    transmitter: MAC of whom every packet is from, where the card is no access point (client mode: the access
        point's)
    traffic_packets_per_s: echo requests to the device under measurement, if its IP address is known; 0 = none
    carrier_hz: centre of the Wi-Fi channel: 5.18e9 + 5e6 * (channel - 36), or 2.412e9 + 5e6 * (channel - 1)
    bandwidth_mhz: of the Wi-Fi channel
    antenna_offset_m: where its antennas are from the camera, along the map's x, y, z
    """

    source: ConnectorCsi | FollowCsi = ConnectorCsi()
    transmitter: MacText | None = None
    traffic_packets_per_s: Annotated[float, Meta(ge=0, le=2000)] = 400.0
    carrier_hz: Positive = 5.24e9
    bandwidth_mhz: Literal[20, 40] = 20
    antenna_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
