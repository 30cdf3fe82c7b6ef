"""agent.yaml: the settings of a remote node with a CSI card."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from vad.config.kinds import Id, Interface, MacText, Positive
from vad.config.radio import ConnectorCsi, FollowCsi


class AgentSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """agent.yaml: the settings of a remote node with a CSI card, whose own place is wanted.

    hub: the hub's endpoint; its vad.yaml listens there
    id: this agent's name in every key; left out: the host's name
    hub_name: the hub's name in every key
    credentials: the folder that `vad pki issue agent ID` made on the hub
    name: what people call it
    mac: the card's; left out: the only wireless one's
    interface: the card; left out: the only wireless one
    source: where CSI comes from
    transmitter: the access point's MAC: frames known to be of others are left out
    carrier_hz: centre of the Wi-Fi channel: 5.18e9 + 5e6 * (channel - 36), or 2.412e9 + 5e6 * (channel - 1)
    bandwidth_mhz: of the Wi-Fi channel
    batch_ms: packets of so long travel together
    buffer_mb: what waits at most while the network is gone: 32 MB hold 80 s of 1000 packets/s (3x2)
    """

    hub: Annotated[str, Meta(examples=["tls/192.168.1.10:7448"])]
    id: Id
    hub_name: Id = "home"
    credentials: Annotated[str, Meta(examples=["/var/lib/vad-agent/credentials"])] | None = None
    name: Annotated[str, Meta(max_length=64, examples=["Attic laptop"])] | None = None
    mac: MacText | None = None
    interface: Interface | None = None
    source: ConnectorCsi | FollowCsi = ConnectorCsi()
    transmitter: MacText | None = None
    carrier_hz: Positive = 5.24e9
    bandwidth_mhz: Literal[20, 40] = 20
    batch_ms: Annotated[float, Meta(ge=20, le=100)] = 50.0
    buffer_mb: Annotated[float, Meta(ge=1, le=4096)] = 32.0
