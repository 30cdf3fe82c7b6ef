"""The daemon's camera: frames -> people on the floor, and the robot -> where the camera is."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vad.camera.frame import Frame, FrameQueue
from vad.daemon.robot_motion import RobotMotion
from vad.daemon.walkers import PeopleSeen, Walkers
from vad.geometry import Intrinsics
from vad.health import Health
from vad.mapping.camera_calibration import CameraCalibration, Deviations
from vad.mapping.camera_keeper import LOOK_EVERY_NS, CameraKeeper
from vad.mapping.walk import WalkTrack
from vad.robot.pose import RobotPose
from vad.streams import DropOldestQueue
from vad.vision.movers import LoneMover
from vad.vision.people import PoseNetwork
from vad.vision.robot import CandidateFinder, RobotCandidate, RobotFinder

_log = logging.getLogger(__name__)

SOLVE_EVERY_NS = 3_000_000_000
STILL_FPS = 7.5
"""Pictures a second that are looked at while nothing moves: who comes in is seen 0.13 s later at most."""
_EARLY = 0.9
"""Of the time between two wanted pictures: stamps jitter."""


@dataclass(frozen=True, slots=True)
class _Seen:
    """What one frame showed; made in a worker thread."""

    people: PeopleSeen
    candidates: list[RobotCandidate]


def known_calibration(record: dict[str, Any]) -> CameraCalibration | None:
    """A stored calibration that may be used; None for another state, or what an older version wrote."""
    try:
        known = CameraCalibration.from_dict(record)
    except ValueError as error:
        _log.warning("the stored calibration of the camera is left out: %s", error)
        return None
    return known if known.status == "valid" else None


class Eyes:
    """Sees for the daemon. `calibration` and `tracks` are current after each frame.

    Args:
        network: finds people. max_fps: frames above this rate are left out. lens: a measured one, of any
            picture size of the same shape; focal_px: of a lens of which that alone is known.
        known: a calibration of the same map epoch from an earlier run.
        on_calibration: called on the loop when the calibration changed.
        finder: finds the robot; by its motion, if left out.
        fixed: only compare with the known calibration, never replace it.

    Attributes:
        last_image: the picture of the last frame seen, not to be changed.
        robot_pose: where the robot was last.
    """

    def __init__(
        self,
        network: PoseNetwork,
        *,
        max_fps: float,
        focal_px: float | None,
        lens: Intrinsics | None = None,
        known: CameraCalibration | None,
        on_calibration: Callable[[CameraCalibration], None],
        finder: CandidateFinder | None = None,
        fixed: bool = False,
    ) -> None:
        self.health = Health("vision")
        self.calibration = known or CameraCalibration("uncalibrated", 0, "no robot poses have come yet")
        self.frames = 0
        self.last_frame_ns = 0
        self.last_image: NDArray[np.uint8] | None = None
        self.robot_pose: RobotPose | None = None
        self._walkers = Walkers(network)
        self._focal_px = focal_px
        self._lens = lens
        self._fixed = fixed
        self._step_ns = int(_EARLY * 1e9 / max_fps)
        self._still_step_ns = int(_EARLY * 1e9 / min(max_fps, STILL_FPS))
        self._on_calibration = on_calibration
        self._finder = finder or RobotFinder()
        self._keeper: CameraKeeper | None = None
        self._looked_ns = -LOOK_EVERY_NS
        self._frame_listeners: list[Callable[[int], None]] = []
        self._poses: list[RobotPose] = []
        self._motion = RobotMotion()
        self._solved_ns = 0
        self._new_evidence = False

    @property
    def robot_moves(self) -> bool:
        """Whether the robot drove within the last seconds before the last frame."""
        return self._motion.moves(self.last_frame_ns)

    def deviations(self) -> Deviations | None:
        """Robot against camera over what has been collected; None while nothing valid stands."""
        return None if self._keeper is None else self._keeper.deviations()

    def listen(self, listener: Callable[[int], None]) -> Callable[[], None]:
        """Call `listener(t_ns)` for every frame seen; returns the way to stop that."""
        self._frame_listeners.append(listener)
        return lambda: self._frame_listeners.remove(listener)

    def others_moving(self, track_id: int, now_ns: int) -> int:
        """How many people besides this one move now."""
        return sum(mover != track_id for mover in self._walkers.movers(now_ns))

    def movers(self) -> tuple[int, ...]:
        """The ids of all who move in the last frame."""
        return self._walkers.movers(self.last_frame_ns)

    def lone_mover(self) -> LoneMover | None:
        """Who is most likely the one and only one who moves in the last frame, with its probability."""
        return self._walkers.lone_mover(self.last_frame_ns)

    def place_of(self, track_id: int) -> tuple[float, float] | None:
        """Where this person was seen last, map frame; None for an unknown track."""
        track = self._walkers.track(track_id)
        return None if track is None else (float(track.xy_m[-1, 0]), float(track.xy_m[-1, 1]))

    async def walk(self, track_id: int, from_ns: int, to_ns: int) -> WalkTrack | None:
        """The smoothed walk of one person within [from_ns, to_ns]; None when too short to be smoothed."""
        return await self._walkers.walk(track_id, from_ns, to_ns, self.calibration)

    def seen_last_ns(self, track_id: int) -> int:
        """When this person was last seen; 0 for an unknown track."""
        track = self._walkers.track(track_id)
        return 0 if track is None else int(track.t_ns[-1])

    def begin_anew(self, calibration: CameraCalibration) -> None:
        """The map changed: go on from this calibration, with nothing of what was seen on the old map."""
        self._keeper = None
        self._walkers.forget()
        self._poses.clear()
        self._take(calibration)

    async def follow_robot(self, poses: DropOldestQueue[RobotPose]) -> None:
        """Take robot poses until cancelled."""
        while True:
            pose = await poses.get()
            self._poses.append(pose)
            self.robot_pose = pose
            self._motion.add(pose)

    async def run(self, frames: FrameQueue) -> None:
        """See until cancelled; how often, `frames` is told."""
        frames.step_ns = self._step_ns
        while True:
            still = await self._look(await frames.get())
            frames.step_ns = self._still_step_ns if still else self._step_ns

    async def _look(self, frame: Frame) -> bool:
        """Take one picture; whether nothing moves."""
        robot_moves = self._motion.moves(frame.t_ns)
        seen = await asyncio.to_thread(self._see, frame, robot_moves)
        self.frames += 1
        self.last_frame_ns = frame.t_ns
        self.last_image = frame.image
        self.health.counters["frames"] += 1
        self.health.counters["people"] += len(seen.people.look.people)
        self.health.counters["people without a place"] += len(seen.people.refused)
        await self._keep_calibrated(frame, seen.candidates if robot_moves else [])
        self._walkers.take(frame.t_ns, seen.people)
        for listener in tuple(self._frame_listeners):
            listener(frame.t_ns)
        self.health.ok(str(seen.people))
        return seen.people.look.still and not robot_moves

    def _see(self, frame: Frame, robot_moves: bool) -> _Seen:
        people = self._walkers.see(frame, self.calibration)
        candidates: list[RobotCandidate] = []
        if robot_moves:
            candidates = self._finder.update(frame.image, np.array(people.look.boxes).reshape(-1, 4))
        return _Seen(people, candidates)

    async def _keep_calibrated(self, frame: Frame, candidates: list[RobotCandidate]) -> None:
        """Give the keeper what came, and take from it how the camera stands."""
        keeper = self._keeper_for(frame.image)
        for pose in self._poses:
            keeper.add_pose(pose.t_ns, pose.x_m, pose.y_m, pose.sigma_m)
        self._poses.clear()
        if candidates:
            places = np.array([[c.x_px, c.y_px] for c in candidates])
            boxes = np.array([c.box if c.from_box else (np.nan,) * 4 for c in candidates])
            keeper.add_candidates(frame.t_ns, places, np.array([c.sigma_px for c in candidates]), boxes)
            self._new_evidence = True
        before = keeper.calibration
        if frame.t_ns - self._looked_ns > LOOK_EVERY_NS:
            self._looked_ns = frame.t_ns
            if await asyncio.to_thread(keeper.look, frame.t_ns, frame.image):
                _log.warning("%s", keeper.calibration.reason)
        if self._new_evidence and not self._fixed and frame.t_ns - self._solved_ns > SOLVE_EVERY_NS:
            self._solved_ns = frame.t_ns
            self._new_evidence = False
            await asyncio.to_thread(keeper.solve, frame.t_ns)
        # Else the map changed meanwhile.
        if keeper is self._keeper and keeper.calibration is not before:
            self._take(keeper.calibration)

    def _keeper_for(self, image: NDArray[np.uint8]) -> CameraKeeper:
        if self._keeper is None:
            height, width = image.shape[:2]
            lens = None
            if self._lens is not None:
                lens = self._lens.scaled(width, height)
            elif self._focal_px is not None:
                centre = ((width - 1) / 2, (height - 1) / 2)
                lens = Intrinsics(width, height, self._focal_px, self._focal_px, *centre)
            self._keeper = CameraKeeper(width, height, lens, self.calibration)
            if self._keeper.calibration is not self.calibration:
                self._take(self._keeper.calibration)
        return self._keeper

    def _take(self, calibration: CameraCalibration) -> None:
        self.calibration = calibration
        self._on_calibration(calibration)
