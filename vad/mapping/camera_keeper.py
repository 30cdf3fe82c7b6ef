"""A camera under one map epoch: calibrated, watched, and calibrated anew once it was moved. Pure.

That it was moved is said by the still background, which is elsewhere in the picture, and by the robot, which
is seen to move elsewhere than the calibration says. Where the background stands still and the robot alone
disagrees, it is the robot that is lost: it gets time to find itself before the camera is doubted.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vad.geometry import Intrinsics
from vad.mapping.camera_calibration import CameraCalibration, Deviations
from vad.mapping.camera_consensus import Candidates, consensus, sightings_of
from vad.mapping.camera_contact import recontacted
from vad.mapping.camera_fit import Start, surprise
from vad.mapping.camera_spread import best_of_each
from vad.mapping.camera_stage import CameraMapper
from vad.mapping.camera_track import PoseTrack
from vad.mapping.camera_view import CameraView

LOOK_EVERY_NS = 5_000_000_000
"""How often the background should be shown to `look`."""

_S_NS = 1_000_000_000
# So many looks in a row say the same before it counts; a shake of the camera is over sooner.
_MOVED_LOOKS, _OTHER_LOOKS = 2, 4
# Two pictures of one stable view share at least so many corners; those of noise in the dark none.
_STABLE_CORNERS = 30
_STILL_KNOWN_NS = 3 * LOOK_EVERY_NS

# The robot's evidence: what of the last half minute agrees with the calibration, and what with another one.
_WINDOW_NS = 30 * _S_NS
_MIN_FRAMES = 40
_DISAGREEING = 0.25
_ELSEWHERE = 0.6
_MAX_SURPRISE = 5.0
_LOST_ROBOT_NS = 120 * _S_NS

NO_POSES = CameraCalibration("uncalibrated", 0, "no robot poses have come yet")


class CameraKeeper:
    """Feed poses, candidates and now and then a picture as they come; `solve` says how the camera stands.

    Args:
        width_px, height_px: of the picture. lens: of a calibrated one, else it is estimated.
        known: how the camera stands from before, under this map epoch; a valid calibration holds until
            something speaks against it.
    """

    def __init__(
        self, width_px: int, height_px: int, lens: Intrinsics | None, known: CameraCalibration | None
    ) -> None:
        self._size = width_px, height_px
        lens_known = None if known is None else known.intrinsics
        if lens_known is not None and (lens_known.width_px, lens_known.height_px) != self._size:
            known = replace(NO_POSES, reason="the camera's pictures have another size than before")
        self.calibration = known or NO_POSES
        self._lens = lens
        self._mapper = CameraMapper(width_px, height_px, lens)
        # The view that the pairs being collected belong to; that of the calibration while it is valid.
        self._view = self.calibration.view
        self._last_view: CameraView | None = None
        self._moved_looks = 0
        self._other_looks = 0
        self._same_ns: int | None = None
        self._moved = ""
        self._lost_since_ns: int | None = None
        self._poses: deque[tuple[int, float, float, float]] = deque()
        self._frames: deque[Candidates] = deque()

    def add_pose(self, t_ns: int, x_m: float, y_m: float, sigma_m: float) -> None:
        """One robot pose, map frame, at its own stamp."""
        self._poses.append((t_ns, x_m, y_m, sigma_m))
        while t_ns - self._poses[0][0] > _WINDOW_NS:
            self._poses.popleft()
        self._mapper.add_pose(t_ns, x_m, y_m, sigma_m)

    def add_candidates(
        self, t_ns: int, image_px: ArrayLike, sigma_px: ArrayLike, box_px: ArrayLike | None = None
    ) -> None:
        """What may be the robot in one frame while it drives; see CameraMapper.add_candidates."""
        frame = Candidates.of(t_ns, image_px, sigma_px, box_px)
        if len(frame.px):
            self._frames.append(frame)
        while self._frames and t_ns - self._frames[0].t_ns > _WINDOW_NS:
            self._frames.popleft()
        self._mapper.add_candidates(t_ns, frame.px, frame.sigma_px, frame.box)

    def look(self, t_ns: int, image: NDArray[np.uint8]) -> bool:
        """Compare the background with the one that belongs to the calibration; True when it was moved.

        Args:
            image: (H, W, 3) BGR or (H, W), any size of the same shape.
        """
        view = CameraView.of(image)
        last, self._last_view = self._last_view, view
        if self._view is None:
            self._view = view
            return False
        change = self._view.change_to(view)
        stable = last is not None and (again := last.change_to(view)).verdict == "same"
        stable = stable and again.matched >= _STABLE_CORNERS
        self._moved_looks = self._moved_looks + 1 if change.verdict == "moved" and stable else 0
        self._other_looks = self._other_looks + 1 if change.verdict == "other" and stable else 0
        if change.verdict == "same":
            self._same_ns = t_ns
        if self._moved_looks >= _MOVED_LOOKS:
            self._begin_anew(f"the picture has shifted by {100 * change.shift:.1f} % of its width", view)
        elif self._other_looks >= _OTHER_LOOKS:
            self._begin_anew("the picture shows another view", view)
        else:
            return False
        return True

    def solve(self, now_ns: int) -> CameraCalibration:
        """How the camera stands, from everything so far; also in `calibration`. Under 1 s."""
        if self.calibration.status == "valid" and self._robot_is_elsewhere():
            still = self._same_ns is not None and now_ns - self._same_ns < _STILL_KNOWN_NS
            self._lost_since_ns = self._lost_since_ns or now_ns
            if not still or now_ns - self._lost_since_ns > _LOST_ROBOT_NS:
                why = "the robot is seen elsewhere than it says it is"
                self._begin_anew(why, self._last_view)
                return self.calibration
            reason = "the robot is not where the camera sees it: has it lost its place?"
            self.calibration = replace(self.calibration, reason=reason)
            return self.calibration
        if self.calibration.status == "valid" and self._lost_since_ns is not None:
            # What was collected while it was lost would spoil the rest.
            self._lost_since_ns = None
            self._mapper = CameraMapper(*self._size, self._lens)
            self.calibration = replace(self.calibration, reason="")
            return self.calibration
        found = self._mapper.solve()
        if found.status == "valid":
            self._moved = ""
            self.calibration = replace(found, view=self._view)
        elif self._moved:
            reason = f"the camera was moved ({self._moved}): {found.reason}"
            self.calibration = replace(found, status="recalibrating", reason=reason)
        elif self.calibration.status != "valid":
            self.calibration = found
        return self.calibration

    def deviations(self) -> Deviations | None:
        """Robot against camera over what came since the last beginning; None while nothing valid stands."""
        return self._mapper.deviations(self.calibration)

    def _begin_anew(self, why: str, view: CameraView | None) -> None:
        """Forget what belongs to the camera's old place."""
        if self.calibration.status in ("valid", "recalibrating"):
            self._moved = why
            reason = f"the camera was moved ({why}): let the robot drive"
            self.calibration = CameraCalibration("recalibrating", 0, reason)
        else:
            # It was moved while it was being calibrated: begin again, there is nothing to take back.
            self.calibration = CameraCalibration("collecting", 0, f"the camera was moved ({why})")
        self._mapper = CameraMapper(*self._size, self._lens)
        self._frames.clear()
        self._view = view
        self._moved_looks = self._other_looks = 0
        self._lost_since_ns = None

    def _robot_is_elsewhere(self) -> bool:
        """Whether, in the last half minute, something moved like the robot, but elsewhere than expected."""
        known = self.calibration
        assert known.camera_from_map is not None
        assert known.intrinsics is not None
        assert known.time_offset_s is not None
        if len(self._poses) < 2 or len(self._frames) < _MIN_FRAMES:
            return False
        origin_ns = self._poses[0][0]
        table = np.array([(1e-9 * (t - origin_ns), x, y, s) for t, x, y, s in self._poses])
        track = PoseTrack(table[:, 0], table[:, 1:3], table[:, 3])
        at = Start(known.intrinsics, known.camera_from_map, known.time_offset_s)
        sightings = recontacted(sightings_of(self._frames, origin_ns), at)
        expected = np.unique(
            sightings.frame[np.isfinite(track.at(sightings.t_s + at.time_offset_s)[0][:, 0])]
        )
        if len(expected) < _MIN_FRAMES:
            return False
        agreeing = best_of_each(sightings.frame, surprise(at, sightings, track), _MAX_SURPRISE)
        if len(agreeing) > _DISAGREEING * len(expected):
            return False
        other = consensus(sightings.image_px, sightings, track, at.time_offset_s)
        return other is not None and other.frames >= _ELSEWHERE * len(expected)
