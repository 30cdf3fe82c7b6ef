"""Which topics there are, and the ids that may stand in them."""

from __future__ import annotations

import re
from dataclasses import dataclass

from vad.mac import normal_mac

_UNSAFE = re.compile("[^A-Za-z0-9_-]")


def safe_id(text: str) -> str:
    """`text` with an underscore for whatever Home Assistant's discovery topics, or MQTT, do not allow."""
    return _UNSAFE.sub("_", text)


@dataclass(frozen=True, slots=True)
class Topics:
    """The topics of one hub.

    base: where the daemon's own begin; discovery: Home Assistant's discovery prefix; hub: its name.
    """

    base: str
    discovery: str
    hub: str

    @property
    def node(self) -> str:
        """Names the hub in discovery topics and ids."""
        return f"vad_{safe_id(self.hub)}"

    @property
    def availability(self) -> str:
        """`online` or, as the last will, `offline`."""
        return self._own("availability")

    @property
    def status(self) -> str:
        """Health and what is going on, JSON."""
        return self._own("status")

    @property
    def map(self) -> str:
        """The floor plan with everything on it, PNG."""
        return self._own("map")

    def device(self, mac: str) -> str:
        """Where a device is, JSON."""
        return self._own("devices", self.device_id(mac))

    def camera(self, camera: str) -> str:
        """A camera's state, JSON."""
        return self._own("cameras", safe_id(camera))

    @staticmethod
    def device_id(mac: str) -> str:
        """A MAC address without colons, which not every topic may hold."""
        return normal_mac(mac).replace(":", "")

    @property
    def hub_config(self) -> str:
        """Where the hub itself is announced."""
        return self._config("hub")

    def device_config(self, mac: str) -> str:
        """Where a device is announced."""
        return self._config(self.device_id(mac))

    @property
    def birth(self) -> str:
        """Where Home Assistant says `online` when it has started."""
        return f"{self.discovery}/status"

    @property
    def retained(self) -> tuple[str, ...]:
        """Filters for what an earlier run may have left of devices and cameras that are no more."""
        own = (self._own(kind, "+") for kind in ("devices", "cameras"))
        return f"{self.discovery}/device/{self.node}/+/config", *own

    def _own(self, *parts: str) -> str:
        return "/".join((self.base, safe_id(self.hub), *parts))

    def _config(self, what: str) -> str:
        return f"{self.discovery}/device/{self.node}/{what}/config"
