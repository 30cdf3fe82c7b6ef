"""The keys of design.md: `vad/<hub>/...`.

A MAC address keeps its colons (zenoh forbids only `*`, `$`, `?`, `#` and empty chunks). An id that comes from
elsewhere must be one plain chunk; `chunk` says so before zenoh does.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from vad.errors import VadError
from vad.mac import normal_mac

ROOT = "vad"
ANY = "*"

_FORBIDDEN = re.compile(r"[/*$?#\x00-\x20\x7f]")


def chunk(text: str) -> str:
    """`text` unchanged where it is one legal chunk of a key; VadError otherwise."""
    if not text or _FORBIDDEN.search(text) or text.startswith("@"):
        raise VadError(
            f"{text!r} cannot be part of a zenoh key",
            remedy="Use letters, digits, '-', '_', '.' or ':'; no blank, none of / * $ ? #, no @ in front",
        )
    return text


@dataclass(frozen=True, slots=True)
class HubKeys:
    """The keys of one hub. `hub` may be `*` (any hub) on the asking side."""

    hub: str

    def __post_init__(self) -> None:
        if self.hub != ANY:
            chunk(self.hub)

    def _key(self, *parts: str) -> str:
        return "/".join((ROOT, self.hub, *parts))

    @property
    def alive(self) -> str:
        """The liveliness token of the daemon."""
        return self._key("alive")

    @property
    def status(self) -> str:
        """StatusMessage."""
        return self._key("status")

    @property
    def map(self) -> str:
        """MapMessage."""
        return self._key("map")

    @property
    def grid(self) -> str:
        """The occupancy grid, PNG."""
        return self._key("map", "grid")

    @property
    def events(self) -> str:
        """EventMessage as it happens; a query is answered with the last ones in an EventsMessage."""
        return self._key("events")

    def schema(self, name: str = ANY) -> str:
        """The JSON Schema of one schema id, or the pattern of all."""
        return self._key("schema", ANY if name == ANY else chunk(name))

    @property
    def devices(self) -> str:
        """All devices in one DevicesMessage (or GeoJSON FeatureCollection), on request only."""
        return self._key("devices")

    @property
    def wishes(self) -> str:
        """Asked with a DeviceWish, answered with a WishReply: what people want of the devices."""
        return self._key("wishes")

    def camera(self, camera: str = ANY) -> str:
        """CameraMessage of one camera, or the pattern of all."""
        return self._key("cameras", ANY if camera == ANY else chunk(camera))

    def device(self, mac: str = ANY) -> str:
        """DeviceMessage of one device, or the pattern of all."""
        return self._key("devices", ANY if mac == ANY else normal_mac(mac))

    def heatmap(self, mac: str = ANY) -> str:
        """HeatmapMessage of one device, or the pattern of all."""
        return self.device(mac) + "/heatmap"

    def history(self, mac: str = ANY) -> str:
        """HistoryMessage of one device, on request only, or the pattern of all."""
        return self.device(mac) + "/history"

    def capture(self, session: str = ANY) -> str:
        """CaptureMessage of one capture session, or the pattern of all."""
        return self._key("capture", ANY if session == ANY else chunk(session))

    def agent_alive(self, agent: str = ANY) -> str:
        """The liveliness token of a remote CSI node; a query on this key is answered with its AgentInfo."""
        return self._agent(agent, "alive")

    def agent_clock(self, agent: str = ANY) -> str:
        """Where an agent asks the hub for its clock."""
        return self._agent(agent, "clock")

    def agent_cmd(self, agent: str = ANY) -> str:
        """What the hub tells an agent: the handshake, what has arrived."""
        return self._agent(agent, "cmd")

    def agent_csi(self, agent: str = ANY) -> str:
        """An agent's stream: CSI in batches, and its answers in the handshake."""
        return self._agent(agent, "csi")

    def _agent(self, agent: str, what: str) -> str:
        return self._key("agents", ANY if agent == ANY else chunk(agent), what)


@dataclass(frozen=True, slots=True)
class ParsedKey:
    """A concrete key taken apart: kind is `device`, `camera` ...; name the MAC, id or session, else empty."""

    hub: str
    kind: str
    name: str = ""


_FIXED = {
    ("alive",): "alive",
    ("status",): "status",
    ("map",): "map",
    ("map", "grid"): "grid",
    ("events",): "events",
    ("devices",): "devices",
    ("wishes",): "wishes",
}
_NAMED = {"cameras": "camera", "devices": "device", "capture": "capture", "schema": "schema"}
_OF_DEVICES = ("heatmap", "history")
_OF_AGENTS = ("alive", "clock", "cmd", "csi")


def parse_key(key: str) -> ParsedKey | None:
    """A key taken apart; None where it is not one of ours."""
    root, _, rest = key.partition("/")
    hub, _, tail = rest.partition("/")
    if root != ROOT or not hub or not tail:
        return None
    parts = tuple(tail.split("/"))
    if parts in _FIXED:
        return ParsedKey(hub, _FIXED[parts])
    if len(parts) == 2 and parts[0] in _NAMED and parts[1]:
        return ParsedKey(hub, _NAMED[parts[0]], parts[1])
    if len(parts) == 3 and parts[0] == "devices" and parts[1] and parts[2] in _OF_DEVICES:
        return ParsedKey(hub, parts[2], parts[1])
    if len(parts) == 3 and parts[0] == "agents" and parts[1] and parts[2] in _OF_AGENTS:
        return ParsedKey(hub, f"agent_{parts[2]}", parts[1])
    return None
