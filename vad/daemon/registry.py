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

    async def add_evidence(self, mac: str, evidence: Posterior, packets: int, walk_s: float) -> PlaceEstimate:
        """Multiply one walk's posterior into what is known; decide whether that makes a mapped device."""
        known = self._devices[mac]
        before = await self._posterior_of(known, evidence.grid)
        fresh = before is None
        total = evidence if before is None else before.fused(evidence)
        walks = 1 if fresh else known.walks + 1
        place = place_from_posterior(joint_posterior(total, walks))
        state, reason = self._verdict(place, walks)
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

    def _verdict(self, place: PlaceEstimate, walks: int) -> tuple[str, str]:
        capture = self._settings.capture
        sharp = place.status == "located" and place.radius90_m <= capture.mapped_radius_m
        if sharp and walks >= capture.min_walks:
            return "mapped", ""
        if walks >= capture.max_walks:
            size = _size(place.radius90_m, walks)
            return "failed", f"{size}: more walks of this kind do not tell; walk elsewhere in the picture"
        return "waiting", _another_walk(place.radius90_m, walks)

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
