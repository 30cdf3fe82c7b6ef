"""Who is measured when: waits for a walker, leads the handshake, writes the session, has it solved."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from dataclasses import dataclass
from datetime import UTC, datetime
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
        self._settings = settings
        self._plan = plan
        self._eyes = eyes
        self._ears = ears
        self._registry = registry
        self._bus = bus
        self._sessions = state_dir / "sessions"

    async def run(self) -> None:
        """Measure devices until cancelled."""
        while True:
            await asyncio.sleep(TICK_S)
            ready = await self._ready(time.monotonic_ns())
            if ready is not None:
                await self._capture(*ready)

    async def _ready(self, now_ns: int) -> tuple[DeviceRecord, int] | None:
        """The device to measure now and the track of its walker; else says what is waited for."""
        calibration = self._eyes.calibration
        waiting = self._registry.waiting()
        if calibration.status != "valid":
            self.step = f"calibrating the camera: {calibration.percent} %, {calibration.reason}"
            for device in waiting:
                await self._registry.wait(device.mac, "the camera does not know yet where it is")
            return None
        if not waiting:
            self.step = "watching: no device waits to be measured"
            return None
        heard = [d for d in waiting if self._ears.heard_per_s(d.mac, now_ns) >= MIN_PACKETS_PER_S]
        for device in waiting:
            if device not in heard:
                rate = self._ears.heard_per_s(device.mac, now_ns)
                # A reason that changed with every packet would be published with every packet.
                said = "no CSI packet of it is heard" if rate == 0 else "too few CSI packets of it are heard"
                await self._registry.wait(device.mac, said)
        if not heard:
            self.step = "waiting for CSI packets of a device"
            return None
        self.step = "waiting for somebody to walk through the picture"
        for device in heard:
            if device.walks == 0:
                await self._registry.wait(device.mac, "waiting for somebody to walk through the picture")
        walker = self._eyes.lone_mover(self._eyes.last_frame_ns)
        return None if walker is None else (heard[0], walker)

    async def _capture(self, device: DeviceRecord, track: int) -> None:
        capture = await self._begin(device, track)
        finished = False
        try:
            await self._registry.capturing(device.mac)
            await self._record(capture)
            finished = True
        finally:
            self._ears.stop_recording()
            if not finished:
                # Cancelled: the folder must not look like one that is still being recorded.
                capture.wifi.abort("the daemon stopped")
                capture.writer.abort("the daemon stopped")
        if capture.wifi.state == "solving":
            await self._solve(capture)
        if capture.wifi.state == "aborted":
            _log.info("capture %s aborted: %s", capture.session, capture.wifi.reason)
            await self._registry.wait(device.mac, capture.wifi.reason)
            self._publish(capture)

    async def _begin(self, device: DeviceRecord, track: int) -> _Capture:
        now_ns = time.monotonic_ns()
        stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%f")[:-3]
        session = f"{stamp}-{device.mac.replace(':', '')}"
        header = self._header(session, device)
        writer = await asyncio.to_thread(SessionWriter, self._sessions / session, header)
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
                "intel5300", self._settings.radio.carrier_hz, self._settings.radio.bandwidth_mhz
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
            await asyncio.to_thread(capture.writer.abort, capture.wifi.reason)

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
            await asyncio.to_thread(capture.writer.abort, capture.wifi.reason)
            return
        await asyncio.to_thread(capture.writer.close, walk.t_ns, walk.xy_m, _sigma_m(walk), capture.track)

    async def _solve(self, capture: _Capture) -> None:
        self.step = f"working out where {capture.mac} is"
        self._publish(capture)
        try:
            solved = await _in_thread(capture.writer.folder)
        except SessionError as error:
            capture.wifi.abort(str(error))
            return
        if solved.evidence.posterior is None or solved.evidence.status == "refused":
            capture.wifi.abort(solved.evidence.reason)
            return
        walk_s = (solved.session.walk_t_ns[-1] - solved.session.walk_t_ns[0]) / 1e9
        place = await self._registry.add_evidence(
            capture.mac, solved.evidence.posterior, len(solved.session.t_ns), float(walk_s)
        )
        capture.wifi.solved()
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
