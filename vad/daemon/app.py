"""The composition root: one TaskGroup, signals, status; everything else is somebody's room."""

from __future__ import annotations

import asyncio
import gc
import logging
import time
from collections.abc import Callable, Coroutine
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from vad import __version__
from vad.bus import messages as m
from vad.bus.grid import grid_to_png
from vad.bus.node import Bus, now_rfc3339
from vad.bus.plan import map_message
from vad.bus.session import BusSettings as NodeSettings
from vad.bus.session import local_endpoints
from vad.camera.frame import FrameQueue
from vad.camera.lens_file import camera_lens
from vad.config import Settings, resolve
from vad.csi.packets import CsiBatch
from vad.daemon.adapters import (
    camera_source,
    csi_source,
    home_assistant,
    join_sources,
    network_gate,
    robot_finder,
    robot_source,
)
from vad.daemon.agents import Agents
from vad.daemon.captures import Captures
from vad.daemon.checks import check_listen
from vad.daemon.ears import Ears
from vad.daemon.eyes import Eyes, known_calibration
from vad.daemon.floor import SAY_WAITING_S, Change, FloorKeeper, first_plan, follow_plans
from vad.daemon.metrics import MetricsServer, StatusCollector
from vad.daemon.notify import notify
from vad.daemon.page import page_access, web_page
from vad.daemon.parts import Parts
from vad.daemon.past import StoredPast
from vad.daemon.registry import Registry
from vad.daemon.service import Supervision
from vad.daemon.wishes import Wishes
from vad.devices.station import StationEvent
from vad.errors import VadError
from vad.health import Health
from vad.mapping.camera_calibration import CameraCalibration
from vad.mapping.camera_floor import floor_in_picture
from vad.mapping.reanchor import moved_calibration
from vad.robot.floor_plan import FloorPlan
from vad.robot.map_server import load_floor_plan, load_rooms
from vad.robot.pose import MapSource, PoseSource, RobotPose
from vad.store.records import CameraRecord, EpochRecord
from vad.store.worker import StoreWorker
from vad.streams import DropOldestQueue
from vad.vision.people import PoseNetwork

_log = logging.getLogger(__name__)

STATUS_EVERY_S = 0.5

T = TypeVar("T")


async def run_daemon(settings: Settings, config_file: Path, supervision: Supervision) -> None:
    """Run until cancelled; VadError where something without which nothing works is missing or breaks."""
    check_listen(settings, config_file)
    plan = None
    if settings.map.file is not None:
        plan = await asyncio.to_thread(
            load_floor_plan, resolve(settings.map.file, config_file), epoch=settings.map.epoch
        )
    model = resolve(settings.vision.model, config_file) if settings.vision.model else None
    network = await asyncio.to_thread(PoseNetwork, model, threads=settings.vision.threads)
    state_dir = resolve(settings.state_dir, config_file)
    store = StoreWorker(state_dir / "vad.sqlite")
    listen = local_endpoints(settings.bus.listen)
    bus = Bus(
        NodeSettings(hub=settings.hub, listen=listen, connect=settings.bus.connect), source=settings.source
    )
    bus.ask_past(StoredPast(store, settings.source))
    supervision.opening = True
    await store.open()
    try:
        await bus.open()
        supervision.opening = False
        try:
            daemon = Daemon(settings, config_file, state_dir, plan, network, bus, store, supervision)
            await daemon.run()
        finally:
            await bus.close()
    finally:
        await store.close()


class Daemon:
    """Owns every task of the running daemon."""

    def __init__(
        self,
        settings: Settings,
        config_file: Path,
        state_dir: Path,
        plan: FloorPlan | None,
        network: PoseNetwork,
        bus: Bus,
        store: StoreWorker,
        supervision: Supervision,
    ) -> None:
        self._supervision = supervision
        self._settings = settings
        self._base = config_file.parent
        self._state_dir = state_dir
        self._plan_of_file = plan
        self._rooms_file = settings.map.rooms and resolve(settings.map.rooms, config_file)
        self._network = network
        self._bus = bus
        self._store = store
        self._gate = network_gate(settings, config_file)
        self._access = page_access(settings, config_file.parent)
        self._started = time.monotonic()
        self._parts = Parts()
        self._calibrations: DropOldestQueue[CameraCalibration] = DropOldestQueue(1)

    async def run(self) -> None:
        """Run everything until cancelled; re-raises what breaks a task, a VadError as itself."""
        try:
            async with asyncio.TaskGroup() as group:
                await self._start(group)
                gc.unfreeze()  # what an earlier core has left
                gc.collect()
                gc.freeze()  # what is known by now is never looked through again: no pauses amid answers
                self._supervision.up()
        except ExceptionGroup as broken:
            known, unknown = broken.split(VadError)
            if unknown is not None or known is None:
                raise
            raise _first(known) from None

    async def _start(self, group: asyncio.TaskGroup) -> None:
        settings = self._settings
        if self._gate is not None:
            group.create_task(self._gate.run(), name="gate")
        robot = robot_source(settings, self._bus.session)
        camera = camera_source(settings.camera, self._base)
        csi = csi_source(settings.radio, self._base)
        joins = join_sources(settings, self._base, self._bus.session)
        poses: DropOldestQueue[RobotPose] = DropOldestQueue(256)
        group.create_task(robot.run(poses), name="robot")
        rooms = await asyncio.to_thread(load_rooms, self._rooms_file) if self._rooms_file else ()
        keeper = FloorKeeper(self._state_dir / "plans", rooms)
        self._plan, changed = await first_plan(keeper, self._plan_of_file, robot, self._say_waiting)
        robot.epoch = self._plan.epoch
        known = await self._patiently(self._known_camera(), robot)
        eyes = Eyes(
            self._network,
            max_fps=settings.vision.max_fps,
            focal_px=settings.camera.focal_px,
            lens=await asyncio.to_thread(camera_lens, settings.camera, self._base),
            known=known,
            on_calibration=self._calibrations.put,
            finder=await asyncio.to_thread(robot_finder, settings.vision, self._base),
        )
        ears = Ears()
        registry = Registry(settings, self._plan, self._bus, self._store)
        await self._patiently(registry.load(), robot)
        agents = Agents(self._bus.keys)
        captures = Captures(settings, self._state_dir, self._plan, eyes, ears, registry, self._bus, agents)
        self._publish_map()
        self._publish_camera(eyes.calibration)

        frames = FrameQueue(2)
        batches: DropOldestQueue[CsiBatch] = DropOldestQueue(256)
        stations: DropOldestQueue[StationEvent] = DropOldestQueue(1024)
        group.create_task(camera.run(frames), name="camera")
        group.create_task(csi.run(batches), name="csi")
        for source in joins:
            group.create_task(source.run(stations), name="joins")
        group.create_task(eyes.follow_robot(poses), name="robot poses")
        group.create_task(eyes.run(frames), name="vision")
        group.create_task(ears.run(batches), name="ears")
        group.create_task(agents.run(self._bus.session), name="agents")
        group.create_task(_register(stations, registry, captures.joined), name="stations")
        wishes = Wishes(self._bus.keys, registry, settings.source)
        group.create_task(wishes.run(self._bus.session), name="wishes")
        group.create_task(captures.run(), name="captures")
        group.create_task(self._keep_calibrations(), name="calibrations")
        follow = partial(self._use_plan, robot, eyes, registry, captures)
        if changed is not None:
            await follow(changed)
        if self._plan_of_file is None and isinstance(robot, MapSource):
            group.create_task(follow_plans(keeper, robot.plans, follow), name="floor plan")
        parts = [
            robot.health,
            camera.health,
            eyes.health,
            csi.health,
            agents.health,
            *captures.parts,
            registry.roster.health,
            self._bus.health,
            self._store.health,
            *([self._gate.health] if self._gate is not None else []),
        ]
        if settings.metrics.port is not None:
            collector = StatusCollector(lambda: self._bus.status, self._bus.device_states)
            metrics = MetricsServer(settings.metrics.port, collector)
            group.create_task(metrics.run(), name="metrics")
            parts.append(metrics.health)
        if (mqtt := home_assistant(settings, self._base, self._state_dir, self._bus)) is not None:
            group.create_task(mqtt.run(), name="home assistant")
            parts.append(mqtt.health)
        if self._access is not None:
            page = web_page(settings, self._access, self._bus, wishes, robot, eyes)
            group.create_task(page.run(), name="web")
            parts.append(page.health)
        queues: dict[str, DropOldestQueue[Any]] = {"poses": poses, "frames": frames, "csi": batches}
        self._supervision.attend(queues, stations, captures, registry, self._store.health)
        group.create_task(
            self._tell_status([*parts, *(s.health for s in joins)], queues, captures), name="status"
        )

    async def _use_plan(
        self, robot: PoseSource, eyes: Eyes, registry: Registry, captures: Captures, change: Change
    ) -> None:
        """Put another plan in force everywhere; what hangs on the old one is moved, or called stale."""
        self._plan = change.plan
        robot.epoch = change.plan.epoch
        captures.use_plan(change.plan)
        await registry.use_plan(change.plan, change.transform, change.reason)
        if change.new_epoch:
            await self._save_epoch()
            if change.transform is None:
                eyes.begin_anew(CameraCalibration("uncalibrated", 0, change.reason))
            else:
                eyes.begin_anew(moved_calibration(eyes.calibration, change.transform))
        self._publish_map()

    def _say_waiting(self, robot: PoseSource, step: str = "waiting for the robot's map") -> None:
        """The status while nothing else can begin: there is no floor plan, or the disk takes nothing."""
        self._supervision.up(step)
        healths = [robot.health, self._bus.health, self._store.health]
        self._publish_status(step, self._parts.tell(healths, time.monotonic()))

    async def _patiently(self, work: Coroutine[Any, Any, T], robot: PoseSource) -> T:
        """Wait for `work` at the store; where the disk is full that is said, and who asks is answered."""
        task = asyncio.create_task(work, name="store at start")
        try:
            while not (await asyncio.wait({task}, timeout=SAY_WAITING_S))[0]:
                self._say_waiting(robot, f"waiting for the store: {self._store.health.detail}")
            return task.result()
        finally:
            if not task.done():
                task.cancel()
                await asyncio.wait({task})

    def _publish_status(self, step: str, parts: tuple[m.Part, ...]) -> None:
        self._bus.publish_status(
            m.StatusMessage(
                source=self._settings.source,
                version=__version__,
                uptime_s=round(time.monotonic() - self._started, 1),
                step=step,
                parts=parts,
            )
        )

    async def _save_epoch(self) -> None:
        plan = self._plan
        await self._store.save_epoch(EpochRecord(plan.epoch, str(plan.bounds_m), now_rfc3339()))

    async def _known_camera(self) -> CameraCalibration | None:
        """The calibration of an earlier run, if the map is still the same."""
        epoch = self._plan.epoch
        await self._save_epoch()
        for record in await self._store.cameras(epoch):
            if record.id == self._settings.camera.id:
                return known_calibration(record.calibration)
        return None

    async def _keep_calibrations(self) -> None:
        """Store and publish each new calibration, until cancelled."""
        while True:
            calibration = await self._calibrations.get()
            if calibration.status == "valid":
                record = CameraRecord(
                    self._settings.camera.id, self._plan.epoch, calibration.to_dict(), now_rfc3339()
                )
                await self._store.save_camera(record)
            self._publish_camera(calibration)

    async def _tell_status(
        self, parts: list[Health], queues: dict[str, DropOldestQueue[Any]], captures: Captures
    ) -> None:
        """Publish the status until cancelled."""
        said = ""
        daemon = Health("daemon")
        while True:
            if not self._supervision.refused:
                daemon.ok(captures.step)
            else:
                daemon.trouble(self._supervision.refused)
            for name, queue in queues.items():
                daemon.counters |= {name: queue.accepted, f"dropped_{name}": queue.dropped}
            self._publish_status(captures.step, self._parts.tell([daemon, *parts], time.monotonic()))
            if captures.step != said:
                said = captures.step
                notify(f"STATUS={said}")
                _log.info("%s", said)
            slept_s = time.monotonic()
            await asyncio.sleep(STATUS_EVERY_S)
            daemon.took("loop_lag", max(0.0, time.monotonic() - slept_s - STATUS_EVERY_S))

    def _publish_map(self) -> None:
        self._bus.publish_map(map_message(self._plan, self._settings.source))
        self._bus.publish_grid(grid_to_png(self._plan.cells))

    def _publish_camera(self, calibration: CameraCalibration) -> None:
        position, pose = calibration.position_m, calibration.camera_from_map
        offset_s = calibration.time_offset_s
        self._bus.publish_camera(
            m.CameraMessage(
                source=self._settings.source,
                id=self._settings.camera.id,
                state=calibration.status,
                percent=float(calibration.percent),
                reason=calibration.reason,
                position_m=None if position is None else _vector3(position),
                map_from_camera=None if pose is None else _matrix3(pose.inverse().rotation),
                map_from_image=_matrix3(calibration.map_from_image),
                deviation_m=_plain(calibration.deviation_m),
                time_offset_ms=None if offset_s is None else float(offset_s) * 1e3,
                epoch=self._plan.epoch,
                pairs=int(calibration.pairs),
                floor_m=floor_in_picture(calibration, self._plan.bounds_m),
            )
        )


def _first(errors: ExceptionGroup[VadError]) -> VadError:
    """The first error of a group of groups."""
    error = errors.exceptions[0]
    return _first(error) if isinstance(error, ExceptionGroup) else error


async def _register(
    stations: DropOldestQueue[StationEvent], registry: Registry, joined: Callable[[str], None]
) -> None:
    """Take in what the join sources tell, until cancelled; `joined` hears of who is new or came back."""
    while True:
        events: list[StationEvent] = []
        with suppress(TimeoutError):
            async with asyncio.timeout(registry.roster.patience_s):
                events = [await stations.get()]
        for mac in await registry.take([*events, *stations.drain()]):
            joined(mac)


def _matrix3(matrix: np.ndarray[Any, np.dtype[np.float64]] | None) -> m.Matrix3 | None:
    if matrix is None:
        return None
    a, b, c = (_vector3(row) for row in matrix)
    return a, b, c


def _vector3(values: np.ndarray[Any, np.dtype[np.float64]]) -> m.Vector3:
    return float(values[0]), float(values[1]), float(values[2])


def _plain(value: float | None) -> float | None:
    return None if value is None else float(value)
