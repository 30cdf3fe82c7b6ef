"""Who is or was in the network: the device table, kept in the store."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

from vad.config import DeviceSettings
from vad.devices.device import Change, Device
from vad.devices.oui import PLACES, Makers, load_makers
from vad.devices.station import StationEvent
from vad.devices.table import DeviceTable
from vad.errors import VadError
from vad.health import Health
from vad.mac import normal_mac
from vad.store.worker import StoreWorker
from vad.wall import now_rfc3339


class Roster:
    """The device table and what is kept of it: a change is stored before anybody hears of it.

    Args:
        measured: whether a device has walks that must not be lost.
    """

    def __init__(self, settings: DeviceSettings, store: StoreWorker, measured: Callable[[str], bool]) -> None:
        self.health = Health("devices")
        self._settings = settings
        self._store = store
        self._measured = measured
        self.table = self._table(Makers({}))

    def _table(self, makers: Makers) -> DeviceTable:
        return DeviceTable(
            names={device.mac: device.name for device in self._settings.static},
            ignore=self._settings.ignore,
            vendor_of=makers.of,
            measured=self._measured,
        )

    async def load(self) -> None:
        """What earlier runs knew."""
        file = self._settings.makers
        makers = await asyncio.to_thread(_makers, PLACES if file is None else (Path(file),))
        self.table = self._table(makers)
        for device in await self._store.identities():
            self.table.restore(device)
        for listed in self._settings.static:  # what people wrote counts until a lease says otherwise
            self._tell(normal_mac(listed.mac), listed.ip)
        self._say()

    def _tell(self, mac: str, ip: str | None) -> None:
        if ip is not None:
            self.table.take(StationEvent(time.monotonic_ns(), "told", mac, "settings", ip=ip), now_rfc3339())

    def use_lists(self, settings: DeviceSettings) -> None:
        """Other names, addresses and ignored devices in the settings than before."""
        self._settings = settings
        self.table.use_lists({device.mac: device.name for device in settings.static}, settings.ignore)
        for listed in settings.static:
            self._tell(normal_mac(listed.mac), listed.ip)

    async def adopt(self, mac: str, name: str | None, since: str) -> None:
        """Take in a device that was stored before there was a table."""
        device = Device(mac, (mac,), since, since, host_name=name)
        self.table.restore(device)
        await self._store.save_identities([device])

    async def take(self, events: Sequence[StationEvent]) -> list[Change]:
        """What these events change, in order; kept when this returns."""
        now, changes = now_rfc3339(), []
        for event in events:
            changes += self.table.take(event, now)
        changes += self.table.tick(time.monotonic_ns(), now)
        await self._keep(changes)
        return changes

    @property
    def patience_s(self) -> float | None:
        """How long until `take` has something to decide even without events; None: for ever."""
        due_ns = self.table.due_ns
        return None if due_ns is None else max(0.0, (due_ns - time.monotonic_ns()) / 1e9)

    async def change(
        self,
        mac: str,
        *,
        name: str | None = None,
        ignored: bool | None = None,
        moved: bool | None = None,
    ) -> Device:
        """See DeviceTable.change."""
        device = self.table.change(mac, name=name, ignored=ignored, moved=moved)
        await self._store.save_identities([device])
        return device

    async def forget(self, mac: str) -> Device:
        """See DeviceTable.forget."""
        device = self.table.forget(mac)
        await self._store.save_identities([], [device.mac])
        return device

    def known(self, mac: str) -> Device:
        """The device that has or had this address, an ignored one too; VadError where there is none."""
        device = self.table.find(normal_mac(mac))
        if device is None:
            raise VadError(f"no device with the address {mac} is known", remedy="`vad devices` lists them")
        return device

    def ignores(self, mac: str) -> bool:
        """Whether the device is to be left alone."""
        device = self.table.find(mac)
        return device is not None and self.table.ignores(device)

    def name(self, mac: str) -> str | None:
        """What the device is called."""
        return self.table.name_of(device) if (device := self.table.find(mac)) else None

    async def _keep(self, changes: Sequence[Change]) -> None:
        if not changes:
            return
        last = {change.device.mac: change for change in changes}
        kept = [change.device for change in last.values() if change.kind != "gone"]
        gone = [mac for mac, change in last.items() if change.kind == "gone"]
        await self._store.save_identities(kept, gone)
        self._say()

    def _say(self) -> None:
        devices = self.table.all()
        here = sum(map(self.table.in_network, devices))
        refused = self.table.refused
        full = f"; {refused} newcomers had no room" if refused else ""
        self.health.ok(f"{len(devices)} devices known, {here} in the network{full}")


@cache
def _makers(places: tuple[Path, ...]) -> Makers:
    return load_makers(places)
