"""The daemon's people: pictures -> who is where on the floor, who walks, and along which path."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

import numpy as np

from vad.camera.frame import Frame
from vad.geometry import project
from vad.mapping.camera_calibration import CameraCalibration
from vad.mapping.walk import WalkTrack
from vad.vision.body import Camera
from vad.vision.ground import Refusal
from vad.vision.movers import LoneMover, lone_mover, moving
from vad.vision.path import smooth
from vad.vision.people import PoseNetwork
from vad.vision.standing import Standing, standing
from vad.vision.tracks import Track, Tracker
from vad.vision.watch import Look, PeopleWatch

MIN_FRAMES = 20
"""Fewer frames of a walker are no walk."""
MOVES = 0.5
"""Who is more likely to move than this counts as moving."""


@dataclass(frozen=True, slots=True)
class PeopleSeen:
    """What one frame showed of people. placed: whether the camera knows its place, so that they have one."""

    look: Look
    placed: bool
    places: list[Standing]
    refused: list[Refusal]

    def __str__(self) -> str:
        """One sentence for people."""
        count = len(self.look.boxes)
        said = f"{count or 'no'} people in the last frame"
        why = sorted({refusal.reason for refusal in self.refused})
        return f"{said}; {len(self.refused)} without a place: {', '.join(why)}" if why else said


class Walkers:
    """Follows people through a camera's frames."""

    def __init__(self, network: PoseNetwork) -> None:
        self._watch = PeopleWatch(network)
        self._tracker = Tracker()
        self._unplaced = 0

    def see(self, frame: Frame, calibration: CameraCalibration) -> PeopleSeen:
        """Look at the next frame. Blocks for 1-50 ms: for a worker thread, one frame after the other."""
        look = self._watch.look(frame.image, frame.t_ns)
        camera = _camera(calibration)
        if camera is None:
            return PeopleSeen(look, False, [], [])
        found = [standing(person, frame.image, camera) for person in look.people]
        places = [place for place in found if isinstance(place, Standing)]
        return PeopleSeen(look, True, places, [place for place in found if isinstance(place, Refusal)])

    def take(self, t_ns: int, seen: PeopleSeen) -> None:
        """Go on with what the frame of t_ns showed."""
        if not (seen.placed and seen.look.looked):
            return
        self._unplaced = len(seen.refused)
        self._tracker.update(t_ns, seen.places)

    def forget(self) -> None:
        """Begin anew: the map or the camera's place changed."""
        self._tracker = Tracker()

    def movers(self, t_ns: int) -> tuple[int, ...]:
        """The ids of all who move at t_ns."""
        return tuple(track for track, p in moving(self._tracker.tracks(), t_ns).items() if p > MOVES)

    def lone_mover(self, t_ns: int) -> LoneMover | None:
        """Who is most likely the one and only one who moves at t_ns, with its probability."""
        return lone_mover(self._tracker.tracks(), t_ns, unplaced=self._unplaced)

    def track(self, track_id: int) -> Track | None:
        """A person's track as measured; None for an unknown or long ended one."""
        return next((track for track in self._tracker.tracks() if track.id == track_id), None)

    async def walk(
        self, track_id: int, from_ns: int, to_ns: int, calibration: CameraCalibration
    ) -> WalkTrack | None:
        """The smoothed walk of one person within [from_ns, to_ns]; None when too short to be smoothed."""
        track, camera = self.track(track_id), _camera(calibration)
        if track is None or camera is None:
            return None
        part = track.within(from_ns, to_ns)
        if sum(body is not None for body in part.bodies) < MIN_FRAMES:
            return None
        return await asyncio.to_thread(_smoothed, part, camera, calibration)


def _smoothed(track: Track, camera: Camera, calibration: CameraCalibration) -> WalkTrack:
    """The walk's path; its sigma holds the camera's own uncertainty, too."""
    path = smooth(track, camera)
    on_floor = np.column_stack([path.xy_m, np.zeros(len(path.xy_m))])
    pixels = project(on_floor, camera.intrinsics, camera.camera_from_map)
    _, covariance = calibration.floor_point(pixels, 0.0)
    path = path.widened(np.where(np.isfinite(covariance), covariance, 0.0))
    sigma_m = np.sqrt(np.trace(path.covariance_m2, axis1=1, axis2=2) / 2)
    return WalkTrack(path.t_ns, path.xy_m, np.asarray(sigma_m, dtype=np.float64))


def _camera(calibration: CameraCalibration) -> Camera | None:
    """The camera of a valid calibration."""
    lens, pose = calibration.intrinsics, calibration.camera_from_map
    if calibration.status != "valid" or lens is None or pose is None:
        return None
    return Camera(lens, pose)
