"""The daemon's camera: frames -> people on the floor, and the robot -> where the camera is."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vad.camera.frame import Frame
from vad.geometry import Intrinsics
from vad.health import Health
from vad.mapping.camera_calibration import CameraCalibration
from vad.mapping.camera_stage import CameraMapper
from vad.robot.pose import RobotPose
from vad.streams import DropOldestQueue
from vad.vision.ground import GroundPoint, ground_point
from vad.vision.people import MotionGate, PoseNetwork
from vad.vision.robot import RobotCandidate, RobotFinder
from vad.vision.tracks import Track, Tracker, movers

_log = logging.getLogger(__name__)

SOLVE_EVERY_NS = 3_000_000_000
ROBOT_MOVING_M = 0.03
MIN_FRAMES = 20
"""Fewer frames of a walker are no walk."""

ROBOT_RESTS_AFTER_NS = 3_000_000_000


@dataclass(frozen=True, slots=True)
class _Seen:
    """What one frame showed; made in a worker thread."""

    grounds: list[GroundPoint]
    people: int
    candidates: list[RobotCandidate]


class Eyes:
    """Sees for the daemon. `calibration` and `tracks` are current after each frame.

    Args:
        network: finds people. max_fps: frames above this rate are left out. focal_px: of a known lens.
        known: a calibration of the same map epoch from an earlier run.
        on_calibration: called on the loop when the calibration changed.

    Attributes:
        last_image: the picture of the last frame seen, not to be changed.
    """

    def __init__(
        self,
        network: PoseNetwork,
        *,
        max_fps: float,
        focal_px: float | None,
        known: CameraCalibration | None,
        on_calibration: Callable[[CameraCalibration], None],
    ) -> None:
        self.health = Health("vision")
        self.calibration = known or CameraCalibration("uncalibrated", 0, "no robot poses have come yet")
        self.frames = 0
        self.last_frame_ns = 0
        self.last_image: NDArray[np.uint8] | None = None
        self._network = network
        self._focal_px = focal_px
        self._step_ns = int(0.9e9 / max_fps)
        self._on_calibration = on_calibration
        self._gate = MotionGate()
        self._finder = RobotFinder()
        self._mapper: CameraMapper | None = None
        self._tracker = Tracker()
        self._frame_listeners: list[Callable[[int], None]] = []
        self._poses: list[RobotPose] = []
        self._rest_xy = np.full(2, np.inf)
        self._robot_moved_ns = -ROBOT_RESTS_AFTER_NS
        self._solved_ns = 0
        self._new_evidence = False

    def listen(self, listener: Callable[[int], None]) -> Callable[[], None]:
        """Call `listener(t_ns)` for every frame seen; returns the way to stop that."""
        self._frame_listeners.append(listener)
        return lambda: self._frame_listeners.remove(listener)

    def others_moving(self, track_id: int, now_ns: int) -> int:
        """How many people besides this one move now."""
        return sum(mover != track_id for mover in movers(self._tracker.tracks(), now_ns))

    def movers(self) -> tuple[int, ...]:
        """The ids of all who move in the last frame."""
        return tuple(movers(self._tracker.tracks(), self.last_frame_ns))

    def place_of(self, track_id: int) -> tuple[float, float] | None:
        """Where this person was seen last, map frame; None for an unknown track."""
        found = (t.xy_m[-1] for t in self._tracker.tracks() if t.id == track_id)
        place = next(found, None)
        return None if place is None else (float(place[0]), float(place[1]))

    def track(self, track_id: int, from_ns: int, to_ns: int) -> Track | None:
        """The track of one person within [from_ns, to_ns]; None when too short to be smoothed."""
        for track in self._tracker.tracks():
            if track.id == track_id:
                inside = (track.t_ns >= from_ns) & (track.t_ns <= to_ns)
                part = Track(
                    track.id, track.t_ns[inside], track.xy_m[inside], track.covariance_m2[inside], True
                )
                return part if inside.sum() >= MIN_FRAMES else None
        return None

    def seen_last_ns(self, track_id: int) -> int:
        """When this person was last seen; 0 for an unknown track."""
        return next((int(t.t_ns[-1]) for t in self._tracker.tracks() if t.id == track_id), 0)

    def begin_anew(self, calibration: CameraCalibration) -> None:
        """The map changed: go on from this calibration, with nothing of what was seen on the old map."""
        self._mapper = None
        self._tracker = Tracker()
        self._poses.clear()
        self._take(calibration)

    async def follow_robot(self, poses: DropOldestQueue[RobotPose]) -> None:
        """Take robot poses until cancelled."""
        while True:
            pose = await poses.get()
            self._poses.append(pose)
            xy = np.array([pose.x_m, pose.y_m])
            if np.linalg.norm(xy - self._rest_xy) > ROBOT_MOVING_M:
                self._rest_xy = xy
                self._robot_moved_ns = pose.t_ns

    async def run(self, frames: DropOldestQueue[Frame]) -> None:
        """See until cancelled."""
        while True:
            frame = await frames.get()
            if frame.t_ns - self.last_frame_ns < self._step_ns:
                continue
            await self._look(frame)

    async def _look(self, frame: Frame) -> None:
        robot_moves = frame.t_ns - self._robot_moved_ns < ROBOT_RESTS_AFTER_NS
        seen = await asyncio.to_thread(self._see, frame.image, robot_moves)
        self.frames += 1
        self.last_frame_ns = frame.t_ns
        self.last_image = frame.image
        self.health.counters["frames"] += 1
        self.health.counters["people"] += seen.people
        mapper = self._mapper_for(frame.image)
        for pose in self._poses:
            mapper.add_pose(pose.t_ns, pose.x_m, pose.y_m, pose.sigma_m)
        self._poses.clear()
        if seen.candidates and robot_moves:
            places = np.array([[c.x_px, c.y_px] for c in seen.candidates])
            mapper.add_candidates(frame.t_ns, places, np.array([c.sigma_px for c in seen.candidates]))
            self._new_evidence = True
        if self._new_evidence and frame.t_ns - self._solved_ns > SOLVE_EVERY_NS:
            self._solved_ns = frame.t_ns
            self._new_evidence = False
            found = await asyncio.to_thread(mapper.solve)
            if mapper is self._mapper:  # else the map changed meanwhile
                self._take_calibration(found)
        if self.calibration.status == "valid":
            self._track_people(frame.t_ns, seen.grounds)
        for listener in tuple(self._frame_listeners):
            listener(frame.t_ns)
        self.health.ok(f"{seen.people} people in the last frame")

    def _see(self, image: NDArray[np.uint8], robot_moves: bool) -> _Seen:
        people = self._network.infer(image) if self._gate.update(image) else []
        height, width = image.shape[:2]
        found = (ground_point(person, (width, height)) for person in people)
        grounds = [ground for ground in found if isinstance(ground, GroundPoint)]
        candidates: list[RobotCandidate] = []
        if robot_moves:
            boxes = np.array([p.box for p in people]).reshape(-1, 4)
            candidates = self._finder.update(image, boxes)
        return _Seen(grounds, len(people), candidates)

    def _mapper_for(self, image: NDArray[np.uint8]) -> CameraMapper:
        if self._mapper is None:
            height, width = image.shape[:2]
            lens = None
            if self._focal_px is not None:
                centre = ((width - 1) / 2, (height - 1) / 2)
                lens = Intrinsics(width, height, self._focal_px, self._focal_px, *centre)
            self._mapper = CameraMapper(width, height, lens)
        return self._mapper

    def _take_calibration(self, found: CameraCalibration) -> None:
        """A valid calibration is only replaced by a valid one: a new drive starts with few pairs."""
        if self.calibration.status == "valid" and found.status != "valid":
            return
        self._take(found)

    def _take(self, calibration: CameraCalibration) -> None:
        self.calibration = calibration
        self._on_calibration(calibration)

    def _track_people(self, t_ns: int, grounds: list[GroundPoint]) -> None:
        if not grounds:
            self._tracker.update(t_ns, np.empty((0, 2)), np.empty((0, 2, 2)))
            return
        pixels = np.array([[g.x_px, g.y_px] for g in grounds])
        spread = np.array([g.covariance_px2 for g in grounds])
        xy_m, covariance = self.calibration.floor_points_with(pixels, spread)
        self._tracker.update(t_ns, xy_m, covariance)
