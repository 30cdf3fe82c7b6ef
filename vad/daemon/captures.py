"""Who is measured when: waits for a walker, leads the handshake, writes the session, has it solved."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np

from vad.bus import messages as m
from vad.bus.node import Bus
from vad.capture.handshake import CameraSide, Message, WifiSide
from vad.capture.session import (
    SCHEMA,
    SessionAnchor,
    SessionDevice,
    SessionHeader,
    SessionMap,
    SessionRadio,
)
from vad.capture.session_writer import SessionWriter
from vad.config import Settings
from vad.daemon.ears import Ears
from vad.daemon.eyes import Eyes
from vad.daemon.registry import Registry
from vad.daemon.threads import to_the_end
from vad.daemon.traffic import Traffic
from vad.errors import SessionError
from vad.robot.floor_plan import FloorPlan
from vad.solve import Solved, solve_session
from vad.store.records import DeviceRecord
from vad.vision.tracks import SmoothTrack

_log = logging.getLogger(__name__)

TICK_S = 0.1
MIN_PACKETS_PER_S = 60.0
WALKER_GONE_NS = 1_500_000_000
CAMERA_GIVES_UP_NS = 60_000_000_000
UNWRITABLE_PAUSE_S = 5.0
"""Before the next try where no session folder can be made."""


@dataclass(slots=True)
class _Capture:
    """One capture under way."""

    session: str
    mac: str
    track: int
    wifi: WifiSide
    camera: CameraSide
    writer: SessionWriter
    begun_ns: int
    to_wifi: list[Message]

    def seconds(self, now_ns: int) -> float:
        return (now_ns - self.begun_ns) / 1e9


class Captures:
    """The capture loop; `step` is one sentence for people about what is going on."""

    def __init__(
        self,
        settings: Settings,
        state_dir: Path,
        plan: FloorPlan,
        eyes: Eyes,
        ears: Ears,
        registry: Registry,
        bus: Bus,
    ) -> None:
        self.step = "starting"
        self.traffic = Traffic(settings)
        self._settings = settings
        self._plan = plan
        self._eyes = eyes
        self._ears = ears
        self._registry = registry
        self._bus = bus
        self._sessions = state_dir / "sessions"
        self._failed: dict[str, str] = {}  # why the last walk of a device could not be used

    def use_plan(self, plan: FloorPlan) -> None:
        """Go on with another floor plan; a walk that began on another epoch is not used."""
        self._plan = plan

    async def run(self) -> None:
        """Measure devices until cancelled."""
        try:
            while True:
                await asyncio.sleep(TICK_S)
                ready = await self._ready(time.monotonic_ns())
                if ready is not None:
                    await self._capture(*ready)
        finally:
            await self.traffic.stop()

    async def _ready(self, now_ns: int) -> tuple[DeviceRecord, int] | None:
        """The device to measure now and the track of its walker; else says what is waited for."""
        calibration = self._eyes.calibration
        waiting = self._registry.waiting()
        if calibration.status != "valid":
            self.step = f"calibrating the camera: {calibration.percent} %, {calibration.reason}"
            for device in waiting:
                await self._registry.wait(device.mac, "the camera does not know yet where it is")
            return None
        walker = self._eyes.lone_mover(self._eyes.last_frame_ns)
        if not waiting:
            await self.traffic.stop()
            self.step = "watching: no device waits to be measured"
            return None
        await self._provoke(waiting, now_ns, somebody_walks=walker is not None)
        heard = [d for d in waiting if self._ears.heard_per_s(d.mac, now_ns) >= MIN_PACKETS_PER_S]
        for device in waiting:
            if device not in heard and not self.traffic.reaches(device.mac):
                # A reason that changed with every packet would be published with every packet.
                why = self._ears.why_unheard(device.mac, now_ns)
                await self._registry.wait(device.mac, why or "too few CSI packets of it are heard")
        within_reach = [d for d in waiting if d in heard or self.traffic.reaches(d.mac)]
        if not within_reach:
            self.step = "waiting for CSI packets of a device"
            return None
        self.step = "waiting for somebody to walk through the picture"
        for device in within_reach:
            await self._registry.wait(device.mac, self._wish(device.mac))
        return None if walker is None or not heard else (heard[0], walker)

    def _wish(self, mac: str) -> str:
        """What would tell more of the device, and why its last walk told nothing."""
        wish = self._registry.wish(mac)
        return f"{self._failed[mac]}; {wish}" if mac in self._failed else wish

    async def _provoke(self, waiting: list[DeviceRecord], now_ns: int, *, somebody_walks: bool) -> None:
        """While somebody walks, make the first device send that does not do so by itself."""
        for device in waiting if somebody_walks else ():
            if self.traffic.reaches(device.mac):
                await self.traffic.towards(device.mac)
                return
            if self._ears.heard_per_s(device.mac, now_ns) >= MIN_PACKETS_PER_S:
                break
        await self.traffic.stop()

    async def _capture(self, device: DeviceRecord, track: int) -> None:
        try:
            capture = await self._begin(device, track)
        except OSError as error:
            await self._give_up(device.mac, _unwritable(error))
            await asyncio.sleep(UNWRITABLE_PAUSE_S)
            return
        unfinished = "the daemon stopped"
        try:
            await self._registry.capturing(device.mac)
            await self._record(capture)
            unfinished = ""
        except OSError as error:
            unfinished = _unwritable(error)
        finally:
            self._ears.stop_recording()
            if unfinished:
                # The folder must not look like one that is still being recorded.
                capture.wifi.abort(unfinished)
                with contextlib.suppress(OSError):
                    capture.writer.abort(unfinished)
            await self.traffic.stop()
        if capture.wifi.state == "solving":
            await self._solve(capture)
        if capture.wifi.state == "aborted":
            await self._give_up(device.mac, capture.wifi.reason)
            self._publish(capture)

    async def _give_up(self, mac: str, reason: str) -> None:
        _log.info("capture of %s aborted: %s", mac, reason)
        self._failed[mac] = reason
        await self._registry.wait(mac, self._wish(mac))

    async def _begin(self, device: DeviceRecord, track: int) -> _Capture:
        now_ns = time.monotonic_ns()
        stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%f")[:-3]
        session = f"{stamp}-{device.mac.replace(':', '')}"
        header = self._header(session, device)
        opening = asyncio.get_running_loop().run_in_executor(
            None, SessionWriter, self._sessions / session, header
        )
        try:
            writer = await asyncio.shield(opening)
        except asyncio.CancelledError:
            await asyncio.wait({opening})
            if opening.exception() is None:
                opening.result().abort("the daemon stopped")
            raise
        camera = CameraSide(session, max_record_ns=CAMERA_GIVES_UP_NS)
        return _Capture(session, device.mac, track, WifiSide(session), camera, writer, now_ns, [])

    def _header(self, session: str, device: DeviceRecord) -> SessionHeader:
        position = self._eyes.calibration.position_m
        assert position is not None  # only a valid calibration gets here
        anchor = position + np.array(self._settings.radio.antenna_offset_m)
        return SessionHeader(
            schema=SCHEMA,
            id=session,
            source=self._settings.source,
            device=SessionDevice(device.mac, device.name),
            anchor=SessionAnchor(float(anchor[0]), float(anchor[1]), float(anchor[2])),
            radio=SessionRadio(
                "intel5300", self._settings.radio.carrier_hz, self._settings.radio.bandwidth_mhz, "anchor"
            ),
            map=SessionMap(self._plan.epoch, self._plan.bounds_m),
        )

    async def _record(self, capture: _Capture) -> None:
        """From arming to the complete folder, or to an aborted handshake."""

        def frame_seen(t_ns: int) -> None:
            capture.to_wifi += capture.camera.frame(t_ns, time.monotonic_ns())

        self._ears.start_recording()
        forget = self._eyes.listen(frame_seen)
        try:
            self._to_camera(capture, capture.wifi.arm(time.monotonic_ns()))
            while capture.wifi.state in ("armed", "recording", "stopping"):
                await asyncio.sleep(TICK_S)
                self._exchange(capture)
                await self._ears.drain(capture.writer)
                self._say(capture)
        finally:
            forget()
        if capture.wifi.state == "solving":
            await self._write_walk(capture)
        else:
            await to_the_end(partial(capture.writer.abort, capture.wifi.reason))

    def _exchange(self, capture: _Capture) -> None:
        """One round of the handshake: deliver, let time pass, decide whether the record is long enough."""
        now_ns = time.monotonic_ns()
        arrived, capture.to_wifi = capture.to_wifi, []
        for message in arrived:
            self._to_camera(capture, capture.wifi.receive(message, now_ns))
        self._to_camera(capture, capture.wifi.tick(now_ns))
        capture.to_wifi += capture.camera.tick(now_ns)
        if capture.wifi.state != "recording":
            return
        limits = self._settings.capture
        gone = self._eyes.last_frame_ns - self._eyes.seen_last_ns(capture.track) > WALKER_GONE_NS
        alone = self._eyes.others_moving(capture.track, self._eyes.last_frame_ns) == 0
        if not alone:
            self._to_camera(capture, capture.wifi.abort("somebody else moved in the picture"))
        elif capture.seconds(now_ns) >= limits.max_s or (gone and capture.seconds(now_ns) >= limits.min_s):
            self._to_camera(capture, capture.wifi.finish(now_ns))
        elif gone:
            self._to_camera(capture, capture.wifi.abort("the walker left after a few seconds"))

    def _to_camera(self, capture: _Capture, messages: list[Message]) -> None:
        for message in messages:
            capture.to_wifi += capture.camera.receive(message, time.monotonic_ns())

    async def _write_walk(self, capture: _Capture) -> None:
        assert capture.wifi.first_frame_ns is not None
        assert capture.wifi.last_frame_ns is not None
        walk = await asyncio.to_thread(
            self._eyes.track, capture.track, capture.wifi.first_frame_ns, capture.wifi.last_frame_ns
        )
        if walk is None:
            capture.wifi.abort("the walker was seen in too few frames")
            await to_the_end(partial(capture.writer.abort, capture.wifi.reason))
            return
        close = partial(capture.writer.close, walk.t_ns, walk.xy_m, _sigma_m(walk), capture.track)
        await to_the_end(close)

    async def _solve(self, capture: _Capture) -> None:
        self.step = f"working out where {capture.mac} is"
        self._publish(capture)
        try:
            solved = await _in_thread(capture.writer.folder)
        except SessionError as error:
            capture.wifi.abort(str(error))
            return
        if solved.session.header.map.epoch != self._plan.epoch:
            capture.wifi.abort("the robot's map changed during the walk")
            return
        if solved.evidence.posterior is None or solved.evidence.status == "refused":
            capture.wifi.abort(solved.evidence.reason)
            return
        walk_s = (solved.session.walk_t_ns[-1] - solved.session.walk_t_ns[0]) / 1e9
        place = await self._registry.add_evidence(
            capture.mac, solved.evidence.posterior, len(solved.session.t_ns), float(walk_s)
        )
        capture.wifi.solved()
        self._failed.pop(capture.mac, None)
        result = m.CaptureResult(
            x_m=float(place.xy_m[0]), y_m=float(place.xy_m[1]), radius90_m=place.radius90_m
        )
        self._publish(capture, result)

    def _say(self, capture: _Capture) -> None:
        walk_s = capture.seconds(time.monotonic_ns())
        self.step = f"recording a walk for {capture.mac}: {walk_s:.0f} s, {capture.writer.packets} packets"
        self._publish(capture)

    def _publish(self, capture: _Capture, result: m.CaptureResult | None = None) -> None:
        walk_s = round(capture.seconds(time.monotonic_ns()))
        self._bus.publish_capture(
            m.CaptureMessage(
                source=self._settings.source,
                session=capture.session,
                mac=capture.mac,
                state=capture.wifi.state,
                reason=capture.wifi.reason,
                packets=capture.writer.packets // 100 * 100,
                walk_s=walk_s,
                progress=1.0 if capture.wifi.over else min(0.95, walk_s / self._settings.capture.max_s),
                result=result,
            )
        )


def _unwritable(error: OSError) -> str:
    return f"the session folder cannot be written ({error.strerror})"


def _sigma_m(walk: SmoothTrack) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """One standard deviation per axis from the covariances (M, 2, 2)."""
    return np.asarray(np.sqrt(np.trace(walk.covariance_m2, axis1=1, axis2=2) / 2), dtype=np.float64)


async def _in_thread(folder: Path) -> Solved:
    """Solve in a thread that gives up soon after this task is cancelled."""
    stop = threading.Event()
    try:
        return await asyncio.to_thread(solve_session, folder, None, stop.is_set)
    finally:
        stop.set()
