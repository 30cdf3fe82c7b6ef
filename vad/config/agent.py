"""agent.yaml: the settings of a remote node with a CSI card."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from vad.config.kinds import Id, MacText, Positive
from vad.config.radio import ConnectorCsi, FollowCsi


class AgentSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """agent.yaml: a remote node with a CSI card, whose own place is wanted.

    hub: the hub's endpoint, e.g. tls/192.168.1.10:7448; hub_name: its name in every key; credentials: the
    folder that `vad pki issue agent ID` made there. id: this agent's; mac, interface: the card (the only
    wireless one if both are left out). transmitter: the access point's address: frames known to be of others
    are left out. batch_ms: packets of so long travel together; buffer_mb: what waits at most while the
    network is gone.
    """

    hub: str
    id: Id
    hub_name: Id = "home"
    credentials: str | None = None
    name: Annotated[str, Meta(max_length=64)] | None = None
    mac: MacText | None = None
    interface: str | None = None
    source: ConnectorCsi | FollowCsi = ConnectorCsi()
    transmitter: MacText | None = None
    carrier_hz: Positive = 5.24e9
    bandwidth_mhz: Literal[20, 40] = 20
    batch_ms: Annotated[float, Meta(ge=20, le=100)] = 50.0
    buffer_mb: Annotated[float, Meta(ge=1, le=4096)] = 32.0
