"""Every device the daemon knows: its record, its posterior, its messages. One owner, on the event loop."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from vad.bus import messages as m
from vad.bus.node import Bus, now_rfc3339
from vad.config import Settings
from vad.daemon.floor import moved_estimate
from vad.mac import normal_mac
from vad.mapping.device_stage import PlaceEstimate, place_from_posterior
from vad.mapping.evidence import joint_posterior
from vad.mapping.plan_match import IDENTITY, PlanTransform
from vad.mapping.posterior import Grid, Posterior
from vad.mapping.reanchor import moved_posterior
from vad.robot.floor_plan import FloorPlan
from vad.store.records import DeviceRecord, Estimate, PosteriorRecord
from vad.store.worker import StoreWorker

METHOD = "spectrogram-likelihood"
STAYS_MAPPED = 1.5
"""A mapped device is one until its region is this much larger than what made it one."""
SURE_OF_ROOM = 0.9
NEGLIGIBLE = 1e-6
"""Cells below this share do not decide a room."""
DOUBTED = "its last walk says that it is elsewhere: it is measured again"


class Registry:
    """Devices by MAC. What is known is published on change and stored before it is called known."""

    def __init__(self, settings: Settings, plan: FloorPlan, bus: Bus, store: StoreWorker) -> None:
        self._settings = settings
        self._plan = plan
        self._bus = bus
        self._store = store
        self._devices: dict[str, DeviceRecord] = {}
        self._ignored = {normal_mac(mac) for mac in settings.devices.ignore}
        self._names = {normal_mac(d.mac): d.name for d in settings.devices.static}
        self._addresses = {normal_mac(d.mac): d.ip for d in settings.devices.static}

    async def load(self) -> None:
        """What earlier runs knew; coordinates of another map epoch are stale, a cut-off capture waits."""
        for record in await self._store.devices():
            known = record
            if stale := self._stale(record):
                known = replace(record, state="stale", reason=stale)
            elif record.state == "capturing":
                known = replace(record, state="waiting", reason="the daemon stopped during a capture")
            self._devices[record.mac] = known
            if known is not record:
                await self._store.save_device(known)
            self._publish(known)
            posterior = await self._store.posterior(record.mac)
            if posterior is not None:
                self._publish_heatmap(posterior)

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

    async def joined(self, mac: str, name: str | None) -> None:
        """A station joined; a known one keeps what is known of it."""
        if mac in self._ignored:
            return
        known = self._devices.get(mac)
        name = self._names.get(mac) or name
        if known is None:
            now = now_rfc3339()
            record = DeviceRecord(mac, "discovered", now, now, name=name, epoch=self._plan.epoch)
            await self._keep(record)
            self._event("joined", mac, f"{name or mac} joined the network")
        elif name and known.name != name:
            await self._keep(replace(known, name=name))

    async def use_plan(self, plan: FloorPlan, transform: PlanTransform | None, reason: str) -> None:
        """Go on with another floor plan.

        What was measured on the plan before is moved with `transform`, old frame to new; without one it is
        stale for `reason`.
        """
        before, self._plan = self._plan, plan
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
            grid = Grid.over(plan.bounds_m, stored.step_m)
            density = moved_posterior(_posterior(stored), transform, grid).log_density.astype(np.float32)
            stored = replace(stored, epoch=plan.epoch, bounds_m=_outer_edges(grid), log_posterior=density)
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
        return _another_walk(known.estimate.radius90_m, known.walks)

    async def capturing(self, mac: str) -> None:
        """A capture of this device has begun."""
        await self._keep(replace(self._devices[mac], state="capturing", reason=""))

    def sends_as(self, mac: str) -> str:
        """The address that the device sends with."""
        return self._devices[mac].mac

    def ip_of(self, mac: str) -> str | None:
        """The device's IPv4 address, where it is known."""
        return self._addresses.get(mac)

    async def known_posterior(self, mac: str, grid: Grid) -> Posterior | None:
        """What all walks so far say together; None where nothing of this map epoch is known."""
        known = self._devices[mac]
        before = await self._posterior_of(known, grid)
        return None if before is None else joint_posterior(before, known.walks)

    async def doubt(self, mac: str, *, on: bool) -> None:
        """Say, or say no more, that the last walk contradicts the map."""
        known = self._devices[mac]
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

    async def would_be_mapped(self, mac: str, evidence: Posterior) -> bool:
        """Whether this much of a walk would make the device a mapped one."""
        known = self._devices[mac]
        before = await self._posterior_of(known, evidence.grid)
        total = evidence if before is None else before.fused(evidence)
        walks = 1 if before is None else known.walks + 1
        place = place_from_posterior(joint_posterior(total, walks))
        enough = place.status == "located" and place.radius90_m <= self._settings.capture.mapped_radius_m
        return enough and walks >= self._settings.capture.min_walks

    async def add_evidence(
        self, mac: str, evidence: Posterior, packets: int, walk_s: float, *, anew: bool = False
    ) -> PlaceEstimate:
        """Multiply one walk's posterior into what is known; decide whether that makes a mapped device.

        anew: what was known before is dropped.
        """
        known = self._devices[mac]
        before = None if anew else await self._posterior_of(known, evidence.grid)
        fresh = before is None
        total = evidence if before is None else before.fused(evidence)
        walks = 1 if fresh else known.walks + 1
        place = place_from_posterior(joint_posterior(total, walks))
        was_mapped = not anew and known.state == "mapped"
        state, reason = self._verdict(place, walks, was_mapped, joint_posterior(total, walks))
        counts = {} if fresh else known.evidence
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
            estimate=self._estimate(place),
            updated_at=now_rfc3339(),
        )
        stored = PosteriorRecord(
            mac,
            self._plan.epoch,
            _outer_edges(total.grid),
            total.grid.step_m,
            walks,
            total.log_density.astype(np.float32),
            record.updated_at,
        )
        await self._keep(record, stored)
        self._publish_heatmap(stored)
        if state == "mapped" and known.state != "mapped":
            where = f" in {record.estimate.room}" if record.estimate and record.estimate.room else ""
            self._event("mapped", mac, f"{known.name or mac} is mapped{where}, ±{place.radius90_m:.1f} m")
        return place

    def _verdict(
        self, place: PlaceEstimate, walks: int, was_mapped: bool, posterior: Posterior
    ) -> tuple[str, str]:
        """State and reason after `walks` walks. Where walks of this kind do not make it sharp, a sure room is
        an answer, too."""
        capture = self._settings.capture
        enough_m = capture.mapped_radius_m * (STAYS_MAPPED if was_mapped else 1.0)
        located = place.status == "located"
        if located and place.radius90_m <= enough_m and walks >= capture.min_walks:
            return "mapped", ""
        if walks < capture.max_walks:
            return "waiting", _another_walk(place.radius90_m, walks)
        size = _size(place.radius90_m, walks)
        room, share = self._likeliest_room(posterior)
        if located and room == self._plan.room_at(*place.xy_m.tolist()) and share >= SURE_OF_ROOM:
            return (
                "mapped",
                f"{size}: the room is sure to {share:.0%}, more walks of this kind do not tell",
            )
        return "failed", f"{size}: more walks of this kind do not tell; walk elsewhere in the picture"

    def _likeliest_room(self, posterior: Posterior) -> tuple[str | None, float]:
        """The room with the largest share of the posterior, and that share."""
        shares: dict[str, float] = {}
        for (x_m, y_m), p in zip(posterior.grid.points_m, posterior.probability.ravel(), strict=True):
            if p > NEGLIGIBLE and (room := self._plan.room_at(x_m, y_m)) is not None:
                shares[room] = shares.get(room, 0.0) + float(p)
        return max(shares.items(), key=lambda item: item[1], default=(None, 0.0))

    def _stale(self, record: DeviceRecord) -> str:
        """Why the coordinates of a record no longer hold; empty when they do."""
        if record.estimate is None or record.epoch == self._plan.epoch:
            return ""
        return f"measured on map epoch {record.epoch}, the map is now epoch {self._plan.epoch}"

    async def _posterior_of(self, known: DeviceRecord, grid: Grid) -> Posterior | None:
        """What earlier walks said, where it is of the same map epoch."""
        stored = await self._store.posterior(known.mac)
        if stored is None or stored.epoch != self._plan.epoch:
            return None
        before = _posterior(stored)
        same = (before.grid.rows, before.grid.columns) == (grid.rows, grid.columns)
        if not same or not np.allclose(before.grid.bounds_m, grid.bounds_m):
            return moved_posterior(before, IDENTITY, grid)  # the plan has grown since
        return Posterior(grid, before.log_density)

    def _estimate(self, place: PlaceEstimate) -> Estimate:
        (a, b), (_, c) = place.covariance_m2.tolist()
        outline = place.region90_m[0] if place.region90_m else np.empty((0, 2))
        return Estimate(
            float(place.xy_m[0]),
            float(place.xy_m[1]),
            ((a, b), (b, c)),
            place.radius90_m,
            tuple((float(x), float(y)) for x, y in outline),
            self._plan.room_at(float(place.xy_m[0]), float(place.xy_m[1])),
            METHOD,
        )

    async def _keep(self, record: DeviceRecord, posterior: PosteriorRecord | None = None) -> None:
        await self._store.save_device(record, posterior)
        self._devices[record.mac] = record
        self._publish(record)

    def _publish(self, record: DeviceRecord) -> None:
        place = record.estimate
        located: dict[str, Any] = {}
        if place is not None:
            located = {
                "x_m": place.x_m,
                "y_m": place.y_m,
                "covariance_m2": place.covariance_m2,
                "radius90_m": place.radius90_m,
                "region90": place.region90,
                "room": place.room,
                "method": place.method,
            }
        self._bus.publish_device(
            m.DeviceMessage(
                source=self._settings.source,
                mac=record.mac,
                name=record.name,
                state=record.state,  # type: ignore[arg-type]  # the store keeps text
                reason=record.reason,
                epoch=record.epoch,
                walks=record.walks,
                evidence=record.evidence,
                updated_at=record.updated_at,
                **located,
            )
        )

    def _publish_heatmap(self, stored: PosteriorRecord) -> None:
        p = joint_posterior(_posterior(stored), stored.walks).probability
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


def _size(radius90_m: float, walks: int) -> str:
    return f"±{radius90_m:.1f} m after {walks} walk{'s' if walks > 1 else ''}"


def _another_walk(radius90_m: float, walks: int) -> str:
    return f"{_size(radius90_m, walks)}; another walk through the picture makes it sharper"


def _posterior(stored: PosteriorRecord) -> Posterior:
    rows, columns = stored.log_posterior.shape
    half = stored.step_m / 2
    grid = Grid(stored.bounds_m[0] + half, stored.bounds_m[1] + half, stored.step_m, columns, rows)
    return Posterior(grid, stored.log_posterior.astype(np.float64))


def _outer_edges(grid: Grid) -> tuple[float, float, float, float]:
    x0, y0, x1, y1 = grid.bounds_m
    half = grid.step_m / 2
    return x0 - half, y0 - half, x1 + half, y1 + half
