"""Every device the daemon knows: its record, its posterior, its messages. One owner, on the event loop."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vad.bus import messages as m
from vad.bus.node import Bus, now_rfc3339
from vad.config import Settings
from vad.daemon.device_message import device_message
from vad.daemon.floor import moved_estimate
from vad.daemon.posteriors import estimate_of, moved_terms, stored_terms, terms_of
from vad.daemon.roster import Roster
from vad.daemon.verdict import another_walk, verdict
from vad.devices.device import Device
from vad.devices.station import StationEvent
from vad.errors import VadError
from vad.mac import normal_mac
from vad.mapping.device_stage import PlaceEstimate, place_from_posterior
from vad.mapping.evidence import Terms
from vad.mapping.plan_match import IDENTITY, PlanTransform
from vad.mapping.posterior import Grid, Posterior
from vad.robot.floor_plan import FloorPlan
from vad.solve import on_plan, plan_prior
from vad.store.records import DeviceRecord, PosteriorRecord
from vad.store.worker import StoreWorker

AWAY_NS = 30_000_000_000
"""A device that was out of the network for so long may have been carried elsewhere."""
PARTED = "two devices were taken for one, and its walks may be the other's: it is measured again"
DOUBTED = "its last walk says that it is elsewhere: it is measured again"


class Registry:
    """Devices by MAC. What is known is published on change and stored before it is called known."""

    def __init__(self, settings: Settings, plan: FloorPlan, bus: Bus, store: StoreWorker) -> None:
        self._settings = settings
        self._plan = plan
        self._priors: dict[Grid, NDArray[np.float64]] = {}  # of the present plan
        self._bus = bus
        self._store = store
        self._devices: dict[str, DeviceRecord] = {}
        self._left_ns: dict[str, int] = {}
        self.roster = Roster(settings.devices, store, self._measured)

    def _measured(self, mac: str) -> bool:
        return mac in self._devices and self._devices[mac].walks > 0

    async def load(self) -> None:
        """What earlier runs knew; coordinates of another map epoch are stale, a cut-off capture waits.

        Ignored devices stay in the store and are nowhere to be seen.
        """
        await self.roster.load()
        for record in await self._store.devices():
            device = self.roster.table.find(record.mac)
            if device is None:
                await self.roster.adopt(record.mac, record.name, record.discovered_at)
            elif device.mac != record.mac:
                await self._store.forget_device(record.mac)  # cut off while two became one
                continue
            if self.roster.ignores(record.mac):
                continue
            known = replace(record, name=self.roster.name(record.mac))
            if stale := self._stale(record):
                known = replace(record, state="stale", reason=stale)
            elif record.state == "capturing":
                known = replace(record, state="waiting", reason="the daemon stopped during a capture")
            self._devices[record.mac] = known
            if known != record:
                await self._store.save_device(known)
            self._publish(known)
            posterior = await self._store.posterior(record.mac)
            if posterior is not None:
                self._publish_heatmap(posterior)

    def knows(self, mac: str) -> bool:
        """Whether the device is there: any may be forgotten, ignored or found to be another at any time."""
        return mac in self._devices

    def get(self, mac: str) -> DeviceRecord:
        """The record of a known device."""
        return self._devices[mac]

    def waiting(self) -> list[DeviceRecord]:
        """Devices that want to be measured, those with the fewest walks first."""
        wanted = [d for d in self._devices.values() if d.state in ("discovered", "waiting", "stale")]
        return sorted(wanted, key=lambda d: (d.walks, d.discovered_at))

    def all(self) -> list[DeviceRecord]:
        """Every device, in order of discovery."""
        return list(self._devices.values())

    async def joined(self, mac: str, host_name: str | None) -> None:
        """A station joined and told its name."""
        event = StationEvent(time.monotonic_ns(), "joined", normal_mac(mac), "", host_name=host_name)
        await self.take([event])

    async def take(self, events: Sequence[StationEvent]) -> list[str]:
        """What join sources tell; the devices that are new or came back, by `mac`.

        A known device keeps what is known of it, under whatever address it comes.
        """
        changed: dict[str, Device] = {}
        for change in await self.roster.take(events):
            mac = change.device.mac
            changed.pop(mac, None)
            if change.kind == "gone":
                self._drop(mac)
            elif not self.roster.ignores(mac):
                changed[mac] = change.device
        fresh = [mac for mac in changed if mac not in self._devices]
        await self._describe(changed.values())
        return list(dict.fromkeys([*fresh, *self._back(events)]))

    def _back(self, events: Sequence[StationEvent]) -> list[str]:
        """Devices that were away long enough to have been carried elsewhere."""
        back = []
        for event in events:
            device = self.roster.table.find(event.mac)
            if device is None or device.mac not in self._devices:
                continue
            if event.kind == "left":
                self._left_ns[device.mac] = event.t_ns
            elif event.kind == "joined":
                left_ns = self._left_ns.pop(device.mac, event.t_ns)
                back += [device.mac] if event.t_ns - left_ns >= AWAY_NS else []
        return back

    async def _describe(self, devices: Iterable[Device]) -> None:
        """Tell what the table says of devices; a new one is discovered."""
        told = [self._described(device) for device in devices]
        if news := [record for record in told if record != self._devices.get(record.mac)]:
            await self._store.save_devices(news)
        for record in told:
            new = record.mac not in self._devices
            self._devices[record.mac] = record
            self._publish(record)
            if new and record.state == "discovered":
                self._event("joined", record.mac, f"{record.name or record.mac} joined the network")

    def _described(self, device: Device) -> DeviceRecord:
        mac, name = device.mac, self.roster.name(device.mac)
        known = self._devices.get(mac)
        if known is None:
            now = now_rfc3339()
            return DeviceRecord(mac, "discovered", now, now, name=name, epoch=self._plan.epoch)
        if device.moved and known.state == "mapped" and known.reason != DOUBTED:
            return replace(known, name=name, state="waiting", reason=PARTED)
        return known if known.name == name else replace(known, name=name)

    async def ignore(self, mac: str, *, on: bool) -> None:
        """Leave a known device alone, or no more; VadError where that cannot be."""
        device = self.roster.known(mac)
        if not on and self.roster.table.in_settings(device):
            raise VadError(f"the settings ignore {mac}", remedy="Take it out of devices.ignore there")
        await self._heed(await self.roster.change(device.mac, ignored=on))

    async def _heed(self, device: Device) -> None:
        """Show the device or not, as it is ignored or no more; its name may have changed."""
        if self.roster.ignores(device.mac):
            if self._devices.pop(device.mac, None) is not None:
                self._bus.forget_device(device.mac)
            return
        if device.mac not in self._devices and (record := await self._store.device(device.mac)) is not None:
            self._devices[device.mac] = record
        await self._describe([device])

    async def use_settings(self, settings: Settings) -> None:
        """Go on with other limits, names and ignored devices."""
        self._settings = settings
        self.roster.use_lists(settings.devices)
        for device in self.roster.table.all():
            await self._heed(device)

    async def rename(self, mac: str, name: str) -> None:
        """Give a known device a name, an empty one takes it away; VadError where that cannot be."""
        device = self.roster.known(mac)
        if listed := self.roster.table.listed_name(device):
            raise VadError(f"{mac} is called {listed!r} in the settings", remedy="Change it there")
        device = await self.roster.change(device.mac, name=name)
        if device.mac in self._devices:
            await self._describe([device])

    async def forget(self, mac: str) -> None:
        """Drop a known device and all its walks; when it joins again it is new."""
        device = await self.roster.forget(self.roster.known(mac).mac)
        self._drop(device.mac)

    def _drop(self, mac: str) -> None:
        self._devices.pop(mac, None)
        self._left_ns.pop(mac, None)
        self._bus.forget_device(mac)

    async def use_plan(self, plan: FloorPlan, transform: PlanTransform | None, reason: str) -> None:
        """Go on with another floor plan.

        What was measured on the plan before is moved with `transform`, old frame to new; without one it is
        stale for `reason`.
        """
        before, self._plan = self._plan, plan
        self._priors.clear()
        for record in self.all():
            if record.epoch != before.epoch:
                continue
            if transform is None:
                if record.estimate is not None:
                    await self._keep(replace(record, state="stale", reason=reason))
                continue
            place = record.estimate and moved_estimate(record.estimate, transform, plan)
            moved = replace(record, epoch=plan.epoch, estimate=place)
            stored = await self._store.posterior(record.mac) if plan.epoch != before.epoch else None
            if stored is None or stored.epoch != before.epoch:
                if moved != record:
                    await self._keep(moved)
                continue
            terms = moved_terms(terms_of(stored), transform, Grid.over(plan.bounds_m, stored.step_m))
            stored = stored_terms(record.mac, plan.epoch, terms, stored.updated_at)
            await self._keep(moved, stored)
            self._publish_heatmap(stored)

    async def wait(self, mac: str, reason: str) -> None:
        """Say what the device waits for; nothing happens when that was said already."""
        known = self._devices[mac]
        if stale := self._stale(known):
            state, reason = "stale", f"{stale}; {reason}"
        else:
            state = "waiting"
        if (known.state, known.reason) != (state, reason):
            await self._keep(replace(known, state=state, reason=reason))

    def wish(self, mac: str) -> str:
        """What would tell more of a device that is heard."""
        known = self._devices[mac]
        if known.estimate is None or self._stale(known):
            return "waiting for somebody to walk through the picture"
        return another_walk(known.estimate.radius90_m, known.walks)

    async def capturing(self, mac: str) -> None:
        """A capture of this device has begun."""
        await self._keep(replace(self._devices[mac], state="capturing", reason=""))

    def sends_as(self, mac: str) -> str:
        """The address that the device sends with."""
        return device.current_mac if (device := self.roster.table.find(mac)) else mac

    def away(self, mac: str) -> bool:
        """Whether the device was seen to leave the network and is not back."""
        device = self.roster.table.find(mac)
        return mac in self._left_ns and device is not None and not self.roster.table.in_network(device)

    def ip_of(self, mac: str) -> str | None:
        """The device's IPv4 address, where it is known."""
        return device.ip if (device := self.roster.table.find(mac)) else None

    async def known_posterior(self, mac: str, grid: Grid) -> Posterior | None:
        """What all walks so far say together; None where nothing of this map epoch is known."""
        before = await self._terms_of(self._devices[mac], grid)
        return None if before is None else before.posterior(grid)

    async def doubt(self, mac: str, *, on: bool) -> None:
        """Say, or say no more, that the last walk contradicts the map."""
        known = self._devices[mac]
        device = self.roster.table.find(mac)
        if device is not None and device.moved != on:
            await self.roster.change(mac, moved=on)
            self._publish(known)
        if on and known.state == "mapped":
            await self._keep(replace(known, reason=DOUBTED))
        elif not on and known.reason == DOUBTED:
            await self._keep(replace(known, reason=""))

    async def unchanged(self, before: DeviceRecord) -> None:
        """A capture told nothing: state and reason are again what they were `before` it."""
        known = self._devices[before.mac]
        if (known.state, known.reason) != (before.state, before.reason):
            await self._keep(replace(known, state=before.state, reason=before.reason))

    def say_moved(self, mac: str, text: str) -> None:
        """Tell subscribers that the device was carried elsewhere."""
        self._event("moved", mac, text)

    def room_at(self, x_m: float, y_m: float) -> str | None:
        """The room of a place of the present map."""
        return self._plan.room_at(x_m, y_m)

    def _joint(self, total: Terms) -> Posterior:
        """All walks and the floor plan together."""
        if total.grid not in self._priors:
            self._priors[total.grid] = plan_prior(self._plan, total.grid)
        return on_plan(total.posterior(total.grid), self._priors[total.grid])

    async def would_be_mapped(self, mac: str, evidence: Terms) -> bool:
        """Whether this much of a walk would make the device a mapped one."""
        before = await self._terms_of(self._devices[mac], evidence.grid)
        total = evidence if before is None else before.plus(evidence)
        place = place_from_posterior(self._joint(total))
        enough = place.status == "located" and place.radius90_m <= self._settings.capture.mapped_radius_m
        return enough and total.walks >= self._settings.capture.min_walks

    async def add_evidence(
        self, mac: str, evidence: Terms, packets: int, walk_s: float, *, anew: bool = False
    ) -> PlaceEstimate:
        """Add one walk's (compact) terms to what is known; decide whether that makes a mapped device.

        anew: what was known before is dropped.
        """
        known = self._devices[mac]
        before = None if anew else await self._terms_of(known, evidence.grid)
        total = evidence if before is None else before.plus(evidence)
        walks = total.walks
        posterior = self._joint(total)
        place = place_from_posterior(posterior)
        was_mapped = not anew and known.state == "mapped"
        state, reason = verdict(
            self._settings.capture, self._plan, place, walks, posterior, was_mapped=was_mapped
        )
        counts, now = {} if before is None else known.evidence, now_rfc3339()
        record = replace(
            known,
            state=state,
            reason=reason,
            epoch=self._plan.epoch,
            walks=walks,
            evidence={
                "packets": counts.get("packets", 0.0) + packets,
                "walk_s": round(counts.get("walk_s", 0.0) + walk_s, 1),
            },
            estimate=estimate_of(place, self._plan, total.height_range_m()),
            updated_at=now,
        )
        stored = stored_terms(mac, self._plan.epoch, total, now)
        await self._keep(record, stored)
        self._publish_heatmap(stored, posterior)
        if state == "mapped" and known.state != "mapped":
            where = f" in {record.estimate.room}" if record.estimate and record.estimate.room else ""
            self._event("mapped", mac, f"{known.name or mac} is mapped{where}, ±{place.radius90_m:.1f} m")
        return place

    def _stale(self, record: DeviceRecord) -> str:
        """Why the coordinates of a record no longer hold; empty when they do."""
        if record.estimate is None or record.epoch == self._plan.epoch:
            return ""
        return f"measured on map epoch {record.epoch}, the map is now epoch {self._plan.epoch}"

    async def _terms_of(self, known: DeviceRecord, grid: Grid) -> Terms | None:
        """What earlier walks said, where it is of the same map epoch; on `grid`."""
        stored = await self._store.posterior(known.mac)
        if stored is None or stored.epoch != self._plan.epoch:
            return None
        before = terms_of(stored)
        same = (before.grid.rows, before.grid.columns) == (grid.rows, grid.columns)
        if not same or not np.allclose(before.grid.bounds_m, grid.bounds_m):
            return moved_terms(before, IDENTITY, grid)  # the plan has grown since
        return replace(before, grid=grid)

    async def _keep(self, record: DeviceRecord, posterior: PosteriorRecord | None = None) -> None:
        if record.mac not in self._devices:
            return  # it was forgotten meanwhile, and is not to come back by this
        await self._store.save_device(record, posterior)
        if record.mac in self._devices:
            self._devices[record.mac] = record
            self._publish(record)

    def _publish(self, record: DeviceRecord) -> None:
        table = self.roster.table
        device = table.find(record.mac)
        here = device is not None and table.in_network(device)
        self._bus.publish_device(
            device_message(record, device, in_network=here, source=self._settings.source)
        )

    def _publish_heatmap(self, stored: PosteriorRecord, posterior: Posterior | None = None) -> None:
        """posterior: what `stored` makes with the floor plan, where that is at hand."""
        p = (posterior or self._joint(terms_of(stored))).probability
        self._bus.publish_heatmap(
            m.heatmap_message(
                p,
                source=self._settings.source,
                mac=stored.mac,
                epoch=stored.epoch,
                bounds_m=stored.bounds_m,
                step_m=stored.step_m,
            )
        )

    def _event(self, kind: m.EventKind, mac: str, text: str) -> None:
        self._bus.publish_event(m.EventMessage(source=self._settings.source, kind=kind, mac=mac, text=text))
