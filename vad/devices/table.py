"""The one table of devices: who was ever in the network, under which addresses. Pure; times are arguments.

A phone that makes up a new MAC address stays one device. Two addresses are one device only where they carry
the same telling client id or host name, at least one of them is random, the newer one was not measured yet,
and they are not in the network at the same time; what turns out to be two after all is taken apart again.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace

from vad.devices.device import Change, Device, bounded
from vad.devices.identity import is_random, stable_client_id
from vad.devices.station import StationEvent
from vad.mac import normal_mac

MAX_DEVICES = 1000
MAX_TOLD = 4096
"""Addresses of which a name or IP is kept, whether they are in the table or may join later."""
APART_NS = 600_000_000_000
"""Two addresses in the network together for so long are two devices: an access point lists a station that
went without a word for five minutes at most."""


@dataclass(frozen=True, slots=True)
class _Facts:
    host_name: str | None = None
    client_id: str | None = None
    ip: str | None = None


class DeviceTable:
    """Devices by address; every change is told to the caller, who keeps and publishes it.

    Args:
        names: MAC -> name (or None) of the devices that the settings list; they are never joined with each
            other and never dropped.
        ignore: MACs that the settings ignore.
        vendor_of: who made the device with this address, None where it is not known.
        measured: whether a device (by its `mac`) has evidence that must not be lost.
        limit: how many devices are kept; then the one that is missed least goes: not in the network, not
            measured, named or ignored; random addresses before real ones, the longest unseen first.

    Attributes:
        refused: newcomers that found the table full of devices worth keeping.
    """

    def __init__(
        self,
        *,
        names: Mapping[str, str | None] | None = None,
        ignore: Collection[str] = (),
        vendor_of: Callable[[str], str | None] = lambda _mac: None,
        measured: Callable[[str], bool] = lambda _mac: False,
        limit: int = MAX_DEVICES,
    ) -> None:
        self.refused = 0
        self.use_lists(names or {}, ignore)
        self._vendor_of = vendor_of
        self._measured = measured
        self._limit = limit
        self._devices: dict[str, Device] = {}
        self._key_of: dict[str, str] = {}
        self._by_ip: dict[str, str] = {}
        self._by_identity: dict[str, set[str]] = {}
        self._told: OrderedDict[str, _Facts] = OrderedDict()
        self._present: dict[str, set[str]] = {}  # MAC -> interfaces
        self._together: dict[frozenset[str], int] = {}  # two MACs that may be one device, both in: since
        self._changes: dict[str, Change] = {}

    def use_lists(self, names: Mapping[str, str | None], ignore: Collection[str]) -> None:
        """What the settings say of names and of whom to ignore, from now on."""
        self._names = {normal_mac(mac): name for mac, name in names.items()}
        self._ignore = {normal_mac(mac) for mac in ignore}

    def __len__(self) -> int:
        return len(self._devices)

    def all(self) -> list[Device]:
        """Every device, the ignored ones too, in order of discovery."""
        return list(self._devices.values())

    def find(self, mac: str) -> Device | None:
        """The device that has or had this address."""
        key = self._key_of.get(mac)
        return None if key is None else self._devices[key]

    def in_network(self, device: Device) -> bool:
        """Whether a source says that it is in now."""
        return any(mac in self._present for mac in device.macs)

    def ignores(self, device: Device) -> bool:
        """Whether it is to be left alone, by the settings or at run time."""
        return device.ignored or not self._ignore.isdisjoint(device.macs)

    def in_settings(self, device: Device) -> bool:
        """Whether the settings ignore it, which nothing at run time can change."""
        return not self._ignore.isdisjoint(device.macs)

    def listed_name(self, device: Device) -> str | None:
        """The name the settings give it."""
        return next((name for mac in device.macs if (name := self._names.get(mac))), None)

    def name_of(self, device: Device) -> str | None:
        """The settings' name, else the one given at run time, else what it calls itself."""
        return self.listed_name(device) or device.name or device.host_name or device.agent

    @property
    def due_ns(self) -> int | None:
        """When `tick` has something to decide; None: not before the next event."""
        return min(self._together.values()) + APART_NS if self._together else None

    def restore(self, device: Device) -> None:
        """Put back what an earlier run knew; an address that another device has already stays there."""
        macs = tuple(mac for mac in device.macs if mac not in self._key_of)
        if device.mac in macs:
            self._put(replace(device, macs=macs, vendor=self._vendor(macs) or device.vendor))
            self._changes.clear()

    def change(
        self,
        mac: str,
        *,
        name: str | None = None,
        ignored: bool | None = None,
        moved: bool | None = None,
    ) -> Device:
        """Change what people and measurements say of a known device; an empty name takes the name away."""
        device = self._devices[self._key_of[mac]]
        if name is not None:
            device = replace(device, name=name or None)
        if ignored is not None:
            device = replace(device, ignored=ignored)
        if moved is not None:
            device = replace(device, moved=moved)
        self._put(device)
        self._changes.clear()
        return device

    def forget(self, mac: str) -> Device:
        """Drop a known device and all that was told of its addresses; when it joins again it is new."""
        device = self._devices[self._key_of[mac]]
        self._drop(device)
        for one in device.macs:
            self._told.pop(one, None)
        self._changes.clear()
        return device

    def take(self, event: StationEvent, now: str) -> list[Change]:
        """What an event changes, nothing where all was known. now: wall time, RFC 3339."""
        match event.kind:
            case "told":
                self._remember(event)
                self._apply_told(event.mac)
            case "left":
                self._leave(event, now)
            case "joined" | "listed":
                self._join(event, now)
        if event.kind != "left":
            self._meet(event.mac, event.t_ns)
        self._unite(event.mac)
        return self._told_changes()

    def tick(self, t_ns: int, now: str) -> list[Change]:
        """Decide what time has decided (see `due_ns`)."""
        for pair, since_ns in list(self._together.items()):
            if t_ns - since_ns >= APART_NS:
                del self._together[pair]
                self._part(pair, now)
        return self._told_changes()

    def _told_changes(self) -> list[Change]:
        changes, self._changes = self._changes, {}
        return list(changes.values())

    def _remember(self, event: StationEvent) -> None:
        """Keep what is told of an address, whether it is in the table or not."""
        if event.host_name is None and event.client_id is None and event.ip is None:
            return
        known = self._told.pop(event.mac, _Facts())
        self._told[event.mac] = _Facts(
            event.host_name or known.host_name,
            stable_client_id(event.client_id, event.mac) or known.client_id,
            event.ip or known.ip,
        )
        while len(self._told) > MAX_TOLD:
            self._told.popitem(last=False)

    def _apply_told(self, mac: str) -> None:
        """What is told of the address that a device has now is told of the device."""
        device, facts = self.find(mac), self._told.get(mac)
        if device is None or facts is None or device.current_mac != mac:
            return
        self._put(
            replace(
                device,
                host_name=facts.host_name or device.host_name,
                client_id=facts.client_id or device.client_id,
                ip=facts.ip or device.ip,
            )
        )

    def _join(self, event: StationEvent, now: str) -> None:
        self._remember(event)
        mac, device = event.mac, self.find(event.mac)
        if device is None:
            if not self._make_room():
                self.refused += 1
                return
            device = Device(mac, (mac,), now, now, vendor=self._vendor((mac,)))
        if event.kind == "joined":
            if mac not in self._present:
                others = tuple(one for one in device.macs if one != mac)
                device = replace(device, macs=(*others, mac), last_seen=now)
            self._present.setdefault(mac, set()).add(event.interface)
        self._put(replace(device, agent=event.agent or device.agent))
        self._apply_told(mac)

    def _leave(self, event: StationEvent, now: str) -> None:
        interfaces = self._present.get(event.mac)
        if interfaces is None:
            return
        interfaces.discard(event.interface)
        if interfaces:
            return
        del self._present[event.mac]
        for pair, since_ns in list(self._together.items()):
            if event.mac in pair:
                del self._together[pair]
                if event.t_ns - since_ns >= APART_NS:
                    self._part(pair, now)
        device = self.find(event.mac)
        if device is not None:
            self._put(replace(device, last_seen=now))

    def _meet(self, mac: str, t_ns: int) -> None:
        """Note since when this address is in together with another that may be the same device."""
        device = self.find(mac)
        if device is None or mac not in self._present:
            return
        same = set(device.macs)
        if not device.shared:
            for identity in device.identities:
                keys = self._by_identity[identity]
                # what three carry joins nothing, and pairs of a whole product line would be many
                for key in keys if len(keys) == 2 else ():
                    same.update(self._devices[key].macs)
        for other in same & self._present.keys() - {mac}:
            self._together.setdefault(frozenset((mac, other)), t_ns)

    def _unite(self, mac: str) -> None:
        """Join the device of this address with the one other that it is, where that is sure enough."""
        device = self.find(mac)
        if device is None or device.shared:
            return
        for identity in device.identities:
            others = self._by_identity[identity] - {device.mac}
            if len(others) > 1:
                return  # a name of several devices tells nothing
            if others:
                other = self._devices[others.pop()]
                older, newer = sorted((other, device), key=lambda one: one.first_seen)
                if self._one(older, newer):
                    self._merge(older, newer)
                return

    def _one(self, older: Device, newer: Device) -> bool:
        """Whether two devices of one identity are one; in doubt they are not."""
        both = (older, newer)
        at_once = self.in_network(older) and self.in_network(newer)
        by_hand = all(map(self._is_listed, both)) or len({one.name for one in both} - {None}) > 1
        contradict = len({one.client_id for one in both} - {None}) > 1
        hides = self.ignores(newer) and not self.ignores(older)  # a device that people see must not vanish
        return (
            any(one.random_mac for one in both)
            and not any(one.shared or one.agent for one in both)
            and not (at_once or by_hand or contradict or hides or self._measured(newer.mac))
        )

    def _merge(self, older: Device, newer: Device) -> None:
        latest, before = (newer, older) if newer.last_seen >= older.last_seen else (older, newer)
        if self.in_network(before):
            latest, before = before, latest
        self._drop(newer, into=older.mac)
        self._put(
            replace(
                older,
                macs=bounded((*before.macs, *latest.macs), older.mac),
                last_seen=latest.last_seen,
                name=older.name or newer.name,
                host_name=latest.host_name or before.host_name,
                client_id=latest.client_id or before.client_id,
                ip=latest.ip or before.ip,
                vendor=older.vendor or newer.vendor,
                agent=older.agent or newer.agent,
            )
        )

    def _part(self, pair: frozenset[str], now: str) -> None:
        """Two addresses turned out to be two devices; nothing they share joins addresses any more."""
        first, second = (self.find(mac) for mac in pair)
        if first is None or second is None:
            return
        if first is second:
            whole = first
            out = next(mac for mac in whole.macs if mac in pair and mac != whole.mac)
            macs = tuple(mac for mac in whole.macs if mac != out)
            moved = whole.moved or self._measured(whole.mac)  # walks of both may have gone into its place
            facts = self._told.get(macs[-1], _Facts())
            self._put(replace(whole, macs=macs, ip=facts.ip, shared=True, moved=moved))
            if self._make_room():
                self._put(Device(out, (out,), now, now, vendor=self._vendor((out,)), shared=True))
                self._apply_told(out)
            return
        for device in (first, second):
            self._put(replace(device, shared=True))

    def _is_listed(self, device: Device) -> bool:
        return not self._names.keys().isdisjoint(device.macs)

    def _vendor(self, macs: tuple[str, ...]) -> str | None:
        return next((self._vendor_of(mac) for mac in macs if not is_random(mac)), None)

    def _make_room(self) -> bool:
        """Whether one more device fits; drops the one that is missed least where that makes it fit."""
        if len(self._devices) < self._limit:
            return True
        idle = [
            device
            for device in self._devices.values()
            if not (
                device.name
                or self.in_network(device)
                or self.ignores(device)
                or self._is_listed(device)
                or self._measured(device.mac)
            )
        ]
        if not idle:
            return False
        self._drop(min(idle, key=lambda device: (not device.random_mac, device.last_seen)))
        return True

    def _put(self, device: Device) -> None:
        before = self._devices.get(device.mac)
        if device == before:
            return
        if before is not None:
            self._unindex(before)
        self._devices[device.mac] = device
        self._key_of.update(dict.fromkeys(device.macs, device.mac))
        for identity in device.identities:
            self._by_identity.setdefault(identity, set()).add(device.mac)
        if device.ip is not None:
            had = self._by_ip.get(device.ip, device.mac)
            if had != device.mac:
                self._put(replace(self._devices[had], ip=None))
            self._by_ip[device.ip] = device.mac
        new = before is None or (device.mac in self._changes and self._changes[device.mac].kind == "new")
        self._changes[device.mac] = Change("new" if new else "changed", device)

    def _drop(self, device: Device, into: str | None = None) -> None:
        self._unindex(device)
        del self._devices[device.mac]
        said = self._changes.pop(device.mac, None)
        if said is None or said.kind != "new":  # else nobody has heard of it
            self._changes[device.mac] = Change("gone", device, into)

    def _unindex(self, device: Device) -> None:
        for mac in device.macs:
            del self._key_of[mac]
        for identity in device.identities:
            self._by_identity[identity].discard(device.mac)
            if not self._by_identity[identity]:
                del self._by_identity[identity]
        if device.ip is not None:
            del self._by_ip[device.ip]
