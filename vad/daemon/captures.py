"""Who is measured when: asks the schedule, has walks recorded and solved, tells what became of them."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np

from vad.bus import messages as m
from vad.bus.node import Bus
from vad.capture.archive import CaptureResult, close_cut_off, note_result, session_id
from vad.capture.quota import enforce
from vad.capture.schedule import MIN_PACKETS_PER_S, Decision, View
from vad.capture.session import (
    SCHEMA,
    SessionAnchor,
    SessionDevice,
    SessionHeader,
    SessionMap,
    SessionRadio,
)
from vad.capture.walk_writer import OWN_CARD, WalkWriter
from vad.config import Settings
from vad.daemon.agents import Agents, RemoteCard
from vad.daemon.decisions import DecisionLog
from vad.daemon.ears import Ears
from vad.daemon.eyes import Eyes
from vad.daemon.measuring import Hearing, Measuring
from vad.daemon.registry import Registry
from vad.daemon.solver import Solver
from vad.daemon.traffic import Traffic
from vad.daemon.walk import Recorded, WalkRecorder
from vad.errors import SessionError
from vad.finish import to_the_end
from vad.health import Health
from vad.robot.floor_plan import FloorPlan
from vad.store.records import DeviceRecord

_log = logging.getLogger(__name__)

TICK_S = 0.1
IDLE_TICK_S = 0.5
"""While nobody moves; who begins to move ends the wait."""
UNWRITABLE_PAUSE_S = 5.0
"""Before the next try where no session folder can be made."""
STOPPED = "the daemon stopped"


class Captures:
    """The capture loop; `step` is one sentence about what is going on, `turns` grows while it goes on."""

    def __init__(
        self,
        settings: Settings,
        state_dir: Path,
        plan: FloorPlan,
        eyes: Eyes,
        ears: Ears,
        registry: Registry,
        bus: Bus,
        agents: Agents | None = None,
    ) -> None:
        self.step = "starting"
        self.turns = 0
        self._stirred = asyncio.Event()
        self._settings = settings
        self._plan = plan
        self._eyes = eyes
        self._ears = ears
        self._registry = registry
        self._bus = bus
        self._agents = agents or Agents(bus.keys)
        self._archive = state_dir / "sessions"
        self._decisions = DecisionLog(state_dir)
        self._traffic = Traffic(settings.radio.traffic_packets_per_s, registry.ip_of)
        self._solver = Solver()
        self._measuring = Measuring(
            settings.capture,
            registry,
            self._decisions,
            provoked_per_s=settings.radio.traffic_packets_per_s,
            now_ns=time.monotonic_ns(),
        )

    @property
    def parts(self) -> Sequence[Health]:
        """The health of what this owns."""
        return self._decisions.health, self._traffic.health, self._solver.health

    def use_plan(self, plan: FloorPlan) -> None:
        """Go on with another floor plan; a walk that began on another epoch is not used."""
        self._plan = plan

    def use_settings(self, settings: Settings) -> None:
        """Go on with other limits, those of the schedule apart; a walk that began keeps its own."""
        self._settings = settings
        self._measuring.use_limits(settings.capture)

    def joined(self, mac: str) -> None:
        """The device joined the network, for the first time or again."""
        self._measuring.joined(mac, time.monotonic_ns())
        self._stirred.set()

    async def run(self) -> None:
        """Measure devices until cancelled."""
        unlisten = self._eyes.listen(self._look_up)
        provoking = False
        try:
            await self._tidy_up()
            while True:
                await self._next_turn(busy=provoking or bool(self._eyes.movers()))
                self.turns += 1
                decision = await self._decide(time.monotonic_ns())
                provoking = bool(decision.provoke)
                await self._traffic.towards(decision.provoke)
                if decision.record and decision.track is not None:
                    await self._capture(decision.record, decision.track)
                await self._decisions.flush()
        finally:
            unlisten()
            await self._traffic.stop()
            await self._solver.close()
            await self._decisions.close()

    def _look_up(self, _t_ns: int) -> None:
        if self._eyes.movers():
            self._stirred.set()

    async def _next_turn(self, *, busy: bool) -> None:
        if busy:
            await asyncio.sleep(TICK_S)
        else:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(IDLE_TICK_S):
                    await self._stirred.wait()
        self._stirred.clear()

    async def _decide(self, now_ns: int) -> Decision:
        calibration = self._eyes.calibration
        calibrating = ""
        if calibration.status != "valid":
            calibrating = f"{calibration.percent} %, {calibration.reason}"
        self._measuring.airtime.spend(now_ns, self._traffic.sent())
        view = View(calibrating, self._eyes.movers())
        decision = await self._measuring.decide(now_ns, view, partial(self._hearing, now_ns))
        self.step = decision.step
        return decision

    def _hearing(self, now_ns: int, mac: str) -> Hearing:
        address = self._registry.sends_as(mac)
        card = self._agents.card_of(address)
        if card is not None:
            return Hearing(card.heard_per_s(now_ns), self._traffic.reaches(mac), card.trouble)
        per_s = self._ears.heard_per_s(address, now_ns)
        why = ""
        if per_s < MIN_PACKETS_PER_S:
            why = self._agents.why_away(address) or self._ears.why_unheard(address, now_ns)
        return Hearing(per_s, self._traffic.reaches(mac), why)

    async def _capture(self, macs: tuple[str, ...], track: int) -> None:
        macs = tuple(filter(self._registry.knows, macs))
        if not macs:
            return
        try:
            walk = await self._begin([self._registry.get(mac) for mac in macs], track)
        except OSError as error:
            await self._measuring.void(time.monotonic_ns(), macs, _unwritable(error), its_fault=False)
            await self._keep_quota()
            await asyncio.sleep(UNWRITABLE_PAUSE_S)
            return
        unfinished = STOPPED
        try:
            await self._measuring.capturing(macs)
            recorded = await walk.record(partial(self._say, walk))
            unfinished = ""
        except OSError as error:
            unfinished = _unwritable(error)
        finally:
            if unfinished:
                # The folders must not look like ones that are still being recorded.
                walk.wifi.abort(unfinished)
                with contextlib.suppress(OSError):
                    walk.writer.abort(unfinished)
            await self._traffic.stop()
        if unfinished:
            recorded = Recorded(False, unfinished)
        for agent, lost in walk.lost.items():
            if lost:
                self._decisions.tell(f"agent {agent}: {lost} packets of this walk never came: the network")
        if recorded.complete:
            self._decisions.tell(f"{walk.seconds:.0f} s walked: {recorded.reason}")
            await self._solve(walk)
        else:
            now_ns = time.monotonic_ns()
            await self._measuring.void(now_ns, macs, recorded.reason, its_fault=recorded.its_fault)
            for mac in macs:
                self._publish(walk, mac, "aborted", recorded.reason)
        await self._keep_quota()

    async def _begin(self, records: list[DeviceRecord], track: int) -> WalkRecorder:
        now = datetime.now(UTC)
        cards: dict[str, RemoteCard] = {}
        sessions: list[tuple[str, SessionHeader]] = []
        for record in records:
            card = self._agents.card_of(self._registry.sends_as(record.mac))
            if card is not None:
                cards[record.mac] = card
            sessions.append((OWN_CARD if card is None else card.id, self._header(now, record, card)))
        opening = asyncio.get_running_loop().run_in_executor(None, WalkWriter, self._archive, sessions)
        try:
            writer = await asyncio.shield(opening)
        except asyncio.CancelledError:
            await asyncio.wait({opening})
            if opening.exception() is None:
                opening.result().abort(STOPPED)
            raise
        return WalkRecorder(
            self._settings.capture,
            self._eyes,
            self._ears,
            self._registry,
            self._measuring.findings,
            self._solver,
            self._agents,
            session=sessions[0][1].id,
            macs=tuple(record.mac for record in records),
            cards=cards,
            track=track,
            writer=writer,
        )

    def _header(self, now: datetime, record: DeviceRecord, card: RemoteCard | None) -> SessionHeader:
        position = self._eyes.calibration.position_m
        assert position is not None  # only a valid calibration gets here
        radio = self._settings.radio
        anchor = position + np.array(radio.antenna_offset_m)
        address = self._registry.sends_as(record.mac)
        heard = SessionRadio("intel5300", radio.carrier_hz, radio.bandwidth_mhz, "anchor")
        if card is not None:  # the antennas are the device's, the anchor's end sends
            heard = SessionRadio("intel5300", card.carrier_hz, card.bandwidth_mhz, "device")
        return SessionHeader(
            schema=SCHEMA,
            id=session_id(now, address),
            source=self._settings.source,
            device=SessionDevice(address, record.name),
            anchor=SessionAnchor(float(anchor[0]), float(anchor[1]), float(anchor[2])),
            radio=heard,
            map=SessionMap(self._plan.epoch, self._plan.bounds_m),
        )

    async def _solve(self, walk: WalkRecorder) -> None:
        """Solve the walk for each of its devices; it is done where it told something of one of them."""
        self._say_solving(walk)
        told, useless = False, ""
        for mac, folder in zip(walk.macs, walk.writer.folders, strict=True):
            self.turns += 1
            self.step = f"working out where {self._measuring.name(mac)} is"
            finding = None
            try:
                solved = await self._solver.solve(folder)
                now_ns = time.monotonic_ns()
                finding, reason = await self._measuring.take(now_ns, mac, solved, self._plan.epoch)
            except SessionError as error:
                reason = str(error)
                await self._measuring.void(time.monotonic_ns(), (mac,), reason, its_fault=False)
            if finding is None:
                useless = useless or reason
                await self._note(folder, CaptureResult(note=reason))
                self._publish(walk, mac, "aborted", reason)
                continue
            told = True
            x_m, y_m = (float(v) for v in finding.place.xy_m)
            radius_m = finding.place.radius90_m
            await self._note(folder, CaptureResult(x_m, y_m, radius_m, finding.text))
            self._publish(walk, mac, "done", result=m.CaptureResult(x_m=x_m, y_m=y_m, radius90_m=radius_m))
        if told:
            walk.wifi.solved()
        else:
            walk.wifi.abort(useless)

    async def _note(self, folder: Path, result: CaptureResult) -> None:
        try:
            await to_the_end(partial(note_result, folder, result))
        except OSError as error:
            _log.warning("%s: %s", folder, _unwritable(error))

    async def _tidy_up(self) -> None:
        """What a crash and a smaller quota leave to do."""
        try:
            cut_off = await to_the_end(partial(close_cut_off, self._archive))
        except (OSError, SessionError) as error:
            _log.warning("the sessions of earlier runs cannot be read: %s", error)
            return
        for folder in cut_off:
            self._decisions.tell(f"{folder.name} was cut off: the daemon ended without warning")
        await self._keep_quota()

    async def _keep_quota(self) -> None:
        limits = self._settings.capture
        free = partial(
            enforce,
            self._archive,
            quota_bytes=limits.quota_mb * 1_000_000,
            keep_free_bytes=limits.keep_free_mb * 1_000_000,
        )
        try:
            gone = await to_the_end(free)
        except SessionError as error:
            _log.warning("%s", error)
            return
        if gone:
            self._decisions.tell(f"{len(gone)} old sessions deleted to keep the quota, up to {gone[-1]}")

    def _say(self, walk: WalkRecorder) -> None:
        self.turns += 1
        names = ", ".join(self._measuring.name(mac) for mac in walk.macs)
        self.step = f"recording a walk for {names}: {walk.seconds:.0f} s, {walk.writer.packets} packets"
        for mac in walk.macs:
            self._publish(walk, mac, walk.wifi.state, walk.wifi.reason)

    def _say_solving(self, walk: WalkRecorder) -> None:
        for mac in walk.macs:
            self._publish(walk, mac, "solving")

    def _publish(
        self,
        walk: WalkRecorder,
        mac: str,
        state: m.CaptureState,
        reason: str = "",
        result: m.CaptureResult | None = None,
    ) -> None:
        folder = walk.writer.folders[walk.macs.index(mac)]
        walk_s = round(walk.seconds)
        over = state in ("done", "aborted")
        self._bus.publish_capture(
            m.CaptureMessage(
                source=self._settings.source,
                session=folder.name,
                mac=mac,
                state=state,
                reason=reason,
                packets=walk.writer.packets_of(folder) // 100 * 100,
                walk_s=walk_s,
                progress=1.0 if over else min(0.95, walk_s / self._settings.capture.max_s),
                result=result,
            )
        )


def _unwritable(error: OSError) -> str:
    return f"the session folder cannot be written ({error.strerror})"
