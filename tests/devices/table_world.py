"""A device table, and a clock that goes on by a second an event."""

from __future__ import annotations

import time

from vad.devices.device import Change
from vad.devices.station import StationEvent
from vad.devices.table import DeviceTable


class Home:
    """A table, and a clock that goes on by a second an event."""

    def __init__(self, **arguments: object) -> None:
        self.measured: set[str] = set()
        self.table = DeviceTable(measured=self.measured.__contains__, **arguments)  # type: ignore[arg-type]
        self.now_ns = 0

    def _now(self) -> str:
        return time.strftime("%Y-%m-%dT%H:%M:%S.000Z", time.gmtime(1.7e9 + self.now_ns // 10**9))

    def _take(self, kind: str, mac: str, interface: str = "wlan0", **facts: str) -> list[Change]:
        self.now_ns += 10**9
        event = StationEvent(self.now_ns, kind, mac, interface, **facts)  # type: ignore[arg-type]
        return self.table.take(event, self._now())

    def join(self, mac: str, interface: str = "wlan0", **facts: str) -> list[Change]:
        return self._take("joined", mac, interface, **facts)

    def leave(self, mac: str, interface: str = "wlan0") -> list[Change]:
        return self._take("left", mac, interface)

    def tell(self, mac: str, **facts: str) -> list[Change]:
        return self._take("told", mac, "dhcp", **facts)

    def listed(self, mac: str, **facts: str) -> list[Change]:
        return self._take("listed", mac, "settings", **facts)

    def wait(self, nanoseconds: int) -> list[Change]:
        self.now_ns += nanoseconds
        return self.table.tick(self.now_ns, self._now())

    def known(self) -> list[tuple[str, ...]]:
        return [device.macs for device in self.table.all()]
