"""Settings that change while the daemon runs: capture limits, devices' names, who is ignored."""

from __future__ import annotations

import logging
import time

import msgspec

from vad.config import Settings
from vad.daemon.captures import Captures
from vad.daemon.registry import Registry
from vad.devices.station import StationEvent
from vad.mac import normal_mac
from vad.streams import DropOldestQueue

_log = logging.getLogger(__name__)

_FIXED_LIMITS = ("together", "recheck_h", "airtime_percent")
"""Of capture: the schedule and the budget are begun with them."""


class Live:
    """Gives changed settings to the parts of a running core. stations: where newly listed devices join."""

    def __init__(
        self, registry: Registry, captures: Captures, stations: DropOldestQueue[StationEvent]
    ) -> None:
        self._registry = registry
        self._captures = captures
        self._stations = stations

    async def use(self, old: Settings, new: Settings) -> bool:
        """Put `new` in force; False, and nothing is changed, where more differs or nothing at all does.

        A reload without any change begins anew, too: the floor plan's file, say, may hold something else.
        """
        if new == old or not only_live(old, new):
            return False
        self._captures.use_settings(new)
        await self._registry.use_settings(new)
        known = {normal_mac(device.mac) for device in old.devices.static}
        for device in new.devices.static:
            if (mac := normal_mac(device.mac)) not in known:
                self._stations.put(StationEvent(time.monotonic_ns(), "listed", mac, "settings"))
        _log.info("capture limits, names and ignored devices are as the settings file says now")
        return True


def only_live(old: Settings, new: Settings) -> bool:
    """Whether they differ only in what can change while the daemon runs."""
    replace = msgspec.structs.replace
    fixed = {name: getattr(new.capture, name) for name in _FIXED_LIMITS}
    devices = replace(old.devices, static=new.devices.static, ignore=new.devices.ignore)
    return replace(old, capture=new.capture, devices=devices) == new and all(
        getattr(old.capture, name) == value for name, value in fixed.items()
    )
