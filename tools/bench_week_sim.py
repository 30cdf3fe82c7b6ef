"""Plays a household's days: visits, radio and camera simulated, everything that decides the daemon's own."""

from __future__ import annotations

import asyncio
import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

import msgspec
import numpy as np

from vad.bus import messages as m
from vad.bus.node import Bus
from vad.bus.session import BusSettings
from vad.capture.archive import session_id
from vad.capture.enough import LATE_S, Ground, Progress, judge
from vad.capture.quota import enforce
from vad.capture.schedule import View
from vad.capture.session import (
    SCHEMA,
    SessionAnchor,
    SessionDevice,
    SessionHeader,
    SessionMap,
    SessionRadio,
)
from vad.capture.session_writer import SessionWriter
from vad.config import Settings, parse_settings
from vad.csi.heard import NOT_HEARD
from vad.csi.packets import CsiBatch
from vad.daemon.decisions import Decision, DecisionLog
from vad.daemon.measuring import Hearing, Measuring
from vad.daemon.registry import Registry
from vad.daemon.solver import Solver
from vad.errors import SessionError
from vad.mapping.bound import TrackNoise
from vad.sim.household import DAY_S, HomeDevice, Household, Visit, hear, make_household
from vad.sim.scenario import CARRIER_HZ
from vad.sim.track_error import seen_walk
from vad.store.worker import StoreWorker

MONDAY = datetime(2026, 3, 2, tzinfo=UTC)
NOISE = TrackNoise(0.03, 0.03)
BUSY_PER_S = 150.0
"""Packets of a device that sends by itself."""
ANSWERS_AFTER_S = 0.6
IN_PICTURE_AFTER_S = 1.5
"""A walker comes through the door before the camera sees who walks."""
STEP_S = 0.5
LOOK_EVERY_S = 1800.0
"""Between the walks: how often it is decided that nobody walks."""
TRACK = 1


@dataclass
class Week:
    """What happened. events: when, in seconds since Monday, and what was told on the bus; airtime_s: of
    provoked packets; removed: sessions that the quota took; walks, solved, void: walks recorded, their
    sessions, walks of which nothing could be made; unused: crossings that nobody was measured in."""

    house: Household
    days: int
    events: list[tuple[float, m.EventMessage]] = field(default_factory=list)
    walks: int = 0
    solved: int = 0
    void: int = 0
    unused: int = 0
    removed: int = 0
    airtime_s: float = 0.0
    decisions: list[Decision] = field(default_factory=list)
    records: dict[str, m.DeviceMessage] = field(default_factory=dict)

    def first(self, kind: str, mac: str) -> float | None:
        """When this was first told of the device, seconds since Monday."""
        return next((t for t, e in self.events if e.kind == kind and e.mac == mac), None)


class _Bus(Bus):
    """A bus without a network: it keeps what would be published."""

    def __init__(self, week: Week) -> None:
        super().__init__(BusSettings())
        self.now_s = 0.0
        self._week = week

    def publish_event(self, message: m.EventMessage) -> None:
        self._week.events.append((self.now_s, message))

    def publish_device(self, message: m.DeviceMessage) -> None:
        self._week.records[message.mac] = message


class Simulation:
    """Plays a household's days, one visit after the other."""

    def __init__(
        self,
        house: Household,
        days: int,
        folder: Path,
        settings: Settings,
        make_bus: Callable[[Week], _Bus] | None = None,
    ) -> None:
        self.week = Week(house, days)
        self._house = house
        self._settings = settings
        self._bus = (make_bus or _Bus)(self.week)
        self._store = StoreWorker(folder / "vad.sqlite")
        self._archive = folder / "sessions"
        self._registry = Registry(settings, house.plan, self._bus, self._store)
        self._log = DecisionLog(folder, self._wall)
        self._folder = folder
        self._solver = Solver()
        self._rng = np.random.default_rng([house.home.seed, 0x3EE4])
        self._measuring = Measuring(
            settings.capture,
            self._registry,
            self._log,
            provoked_per_s=settings.radio.traffic_packets_per_s,
            now_ns=0,
        )

    async def run(self) -> Week:
        """The whole time, as fast as the estimator goes."""
        async with self._store:
            await self._registry.load()
            try:
                await self._play()
            finally:
                await self._solver.close()
        self.week.decisions = [
            msgspec.json.decode(line, type=Decision)
            for line in (self._folder / "decisions.jsonl").read_bytes().splitlines()
        ]
        return self.week

    async def _play(self) -> None:
        visits = [v for v in self._house.visits if v.walk.start_s < self.week.days * DAY_S]
        at_s = 0.0
        for visit in visits:
            while at_s < visit.walk.start_s:
                await self._nobody(at_s)
                at_s += LOOK_EVERY_S
            await self._visit(visit)
            at_s = max(at_s, visit.walk.end_s)
            await self._log.flush()
        await self._nobody(self.week.days * DAY_S)
        await self._log.flush()

    async def _nobody(self, t_s: float) -> None:
        self._bus.now_s = t_s
        for device in self._house.devices:
            if device.joined_s <= t_s and device.mac not in self.week.records:
                await self._registry.joined(device.mac, device.name)
                self._measuring.joined(device.mac, _ns(t_s))
                self._log.tell(f"{device.name} joined the network", device.mac)
        await self._measuring.decide(_ns(t_s), View(""), partial(self._hearing, ()))

    async def _visit(self, visit: Visit) -> None:
        """Somebody crosses the room: half a second after half a second."""
        t_s, since_s = visit.walk.start_s + IN_PICTURE_AFTER_S, 0.0
        provoked: tuple[str, ...] = ()
        recorded_any = False
        while t_s < visit.walk.end_s:
            self._bus.now_s = t_s
            answering = provoked if t_s - since_s >= ANSWERS_AFTER_S else ()
            view = View("", (TRACK, TRACK + 1) if self._accompanied(visit, t_s) else (TRACK,))
            hearing = partial(self._hearing, answering)
            decision = await self._measuring.decide(_ns(t_s), view, hearing)
            if decision.record:
                t_s = await self._record(visit, t_s, decision.record, decision.provoke)
                recorded_any = True
                provoked = ()
                continue
            if decision.provoke != provoked:
                provoked, since_s = decision.provoke, t_s
            self._spend(t_s, bool(provoked) * STEP_S)
            t_s += STEP_S
        if not recorded_any:
            self.week.unused += 1

    def _accompanied(self, visit: Visit, t_s: float) -> bool:
        return visit.with_visitor and t_s >= visit.walk.start_s + visit.visitor_after_s

    def _hearing(self, answering: tuple[str, ...], mac: str) -> Hearing:
        device = self._device(mac)
        reaches = not device.sends_by_itself
        per_s = BUSY_PER_S if device.sends_by_itself else 0.0
        if mac in answering and device.answers:
            per_s = self._settings.radio.traffic_packets_per_s / len(answering)
        return Hearing(per_s, reaches, "" if per_s else NOT_HEARD)

    async def _record(
        self, visit: Visit, from_s: float, macs: tuple[str, ...], provoked: tuple[str, ...]
    ) -> float:
        """Record for these devices until it is enough, and solve; when that is over."""
        await self._measuring.capturing(macs)
        limits = self._settings.capture
        ground, t_s, last_s = Ground(), from_s, from_s
        while True:
            t_s += STEP_S
            state = visit.walk.state(t_s)
            if state is not None:
                last_s = t_s
                ground.add(_ns(t_s), state.x_m, state.y_m)
            alone = not self._accompanied(visit, t_s)
            judgement = judge(
                Progress(t_s - from_s, t_s - last_s, alone, covered=ground.covered(_ns(t_s))),
                min_s=limits.min_s,
                max_s=limits.max_s,
            )
            if judgement.act != "go on":
                break
        self._spend(t_s, (t_s - from_s) * bool(provoked))
        self._bus.now_s = t_s
        if judgement.act == "abort":
            self.week.void += 1
            await self._measuring.void(_ns(t_s), macs, judgement.reason, its_fault=judgement.its_fault)
            return t_s
        self._log.tell(f"{t_s - from_s:.0f} s walked: {judgement.reason}")
        to_s = min(last_s, t_s if alone else t_s - LATE_S)
        self.week.walks += 1
        folders = await asyncio.to_thread(self._write, visit, macs, provoked, from_s, to_s)
        for mac, folder in zip(macs, folders, strict=True):
            try:
                solved = await self._solver.solve(folder)
                await self._measuring.take(_ns(t_s), mac, solved, self._house.plan.epoch)
                self.week.solved += 1
            except SessionError as error:
                await self._measuring.void(_ns(t_s), (mac,), str(error), its_fault=False)
        self.week.removed += len(
            enforce(self._archive, quota_bytes=limits.quota_mb * 1_000_000, keep_free_bytes=0)
        )
        return t_s

    def _write(
        self, visit: Visit, macs: tuple[str, ...], provoked: tuple[str, ...], from_s: float, to_s: float
    ) -> tuple[Path, ...]:
        """The session folders of a walk, as the daemon writes them."""
        shared = self._settings.radio.traffic_packets_per_s / max(1, len(provoked))
        rates = {mac: shared if mac in provoked else BUSY_PER_S for mac in macs}
        headers = [self._header(self._device(mac), from_s) for mac in macs]
        writer = SessionWriter(self._archive / headers[0].id, headers[0], headers[1:])
        writer.append(self._hear(visit, rates, from_s, to_s))
        seen = seen_walk(visit.walk, NOISE, self._rng)
        inside = (seen.t_ns >= _ns(from_s)) & (seen.t_ns <= _ns(to_s))
        writer.close(seen.t_ns[inside], seen.xy_m[inside], seen.sigma_m[inside], TRACK)
        return writer.folders

    def _hear(self, visit: Visit, rates: dict[str, float], from_s: float, to_s: float) -> CsiBatch:
        return hear(self._house, visit, rates, from_s, to_s)

    def _header(self, device: HomeDevice, t_s: float) -> SessionHeader:
        return SessionHeader(
            schema=SCHEMA,
            id=session_id(MONDAY + timedelta(seconds=t_s), device.mac),
            source="simulated",
            device=SessionDevice(device.mac, device.name),
            anchor=SessionAnchor(*self._house.home.anchor_m),
            radio=SessionRadio(carrier_hz=CARRIER_HZ, array_end="anchor"),
            map=SessionMap(self._house.plan.epoch, self._house.plan.bounds_m),
        )

    def _spend(self, t_s: float, seconds: float) -> None:
        if seconds:
            packets = round(seconds * self._settings.radio.traffic_packets_per_s)
            before = self._measuring.airtime.left_s(_ns(t_s))
            self._measuring.airtime.spend(_ns(t_s), packets)
            self.week.airtime_s += before - self._measuring.airtime.left_s(_ns(t_s))

    def _device(self, mac: str) -> HomeDevice:
        return next(d for d in self._house.devices if d.mac == mac)

    def _wall(self) -> str:
        moment = MONDAY + timedelta(seconds=self._bus.now_s)
        return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _ns(t_s: float) -> int:
    return round(t_s * 1e9)


def settings_for(folder: Path, quota_mb: int) -> Settings:
    """The daemon's defaults, but for the quota."""
    text = json.dumps(
        {
            "source": "simulated",
            "state_dir": str(folder),
            "map": {"file": "floor.yaml"},
            "robot": {"type": "neato", "port": "none"},
            "camera": {"source": {"type": "mjpeg", "url": "http://127.0.0.1:9/"}},
            "radio": {},
            "devices": {},
            "capture": {"quota_mb": quota_mb},
        }
    )
    return parse_settings(text, where="bench")


def simulate(
    seed: int,
    *,
    days: int = 7,
    devices: int = 12,
    quota_mb: int = 200,
    moved_after_s: float = DAY_S,
    joined_within_s: float = 1.5 * DAY_S,
) -> Week:
    """Days of a household with the daemon's default settings."""
    house = make_household(
        seed, days=days, devices=devices, moved_after_s=moved_after_s, joined_within_s=joined_within_s
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        return asyncio.run(Simulation(house, days, folder, settings_for(folder, quota_mb)).run())
