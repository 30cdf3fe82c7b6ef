"""What an agent says of itself: its answer to a query on `vad/<hub>/agents/<id>/alive`."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from vad.errors import ProtocolError, VadError
from vad.limits import UNREADABLE
from vad.mac import normal_mac

SCHEMA = "vad.agent/1"
ENCODING = "application/json;vad.agent.v1"
MAX_BYTES = 4096


class AgentInfo(msgspec.Struct, frozen=True, kw_only=True):
    """mac: of the card whose place is the unknown, lower case; it is the device on the hub.

    carrier_hz, bandwidth_mhz: of the channel it listens to. Fields that a newer version added are ignored.
    """

    id: Annotated[str, Meta(pattern="^[A-Za-z0-9_-]{1,64}$")]
    mac: str
    name: Annotated[str, Meta(max_length=64)] | None = None
    csi: str = "intel5300"
    carrier_hz: Annotated[float, Meta(gt=0)] = 5.24e9
    bandwidth_mhz: Literal[20, 40] = 20
    version: Annotated[str, Meta(max_length=64)] = ""
    schema: str = SCHEMA


def encode_info(info: AgentInfo) -> bytes:
    """JSON."""
    return msgspec.json.encode(info)


def decode_info(payload: bytes) -> AgentInfo:
    """The inverse; ProtocolError for anything else. The MAC comes out in lower case."""
    if len(payload) > MAX_BYTES:
        raise ProtocolError("an agent's description is too long")
    try:
        info = msgspec.json.decode(payload, type=AgentInfo)
    except UNREADABLE as error:
        raise ProtocolError(f"not an agent's description ({error})") from error
    if info.schema != SCHEMA:
        raise ProtocolError(f"unknown schema {info.schema!r}")
    try:
        return msgspec.structs.replace(info, mac=normal_mac(info.mac))
    except VadError as error:
        raise ProtocolError(error.what) from error
