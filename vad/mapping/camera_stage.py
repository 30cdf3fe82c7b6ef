"""Stage 1: the camera's place from a drive of the robot, without a detector that knows robots. Pure.

What moves in the picture and moves on the floor as the robot says it does, is the robot: the consensus of
candidates and poses names the robot, finds the time offset and calibrates the camera at once
(formats.md 11; the paper's eq. 3 and 4 reconciled in one least-squares estimate).
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vad.geometry import FloatArray, Intrinsics, apply_homography, floor_homography, undistort
from vad.mapping.camera_calibration import PARAMETERS, CameraCalibration, CameraStatus, Deviations
from vad.mapping.camera_consensus import (
    CONSENSUS_M,
    Candidates,
    Consensus,
    Sightings,
    consensus,
    search_time_offset,
    sightings_of,
)
from vad.mapping.camera_contact import recontacted
from vad.mapping.camera_fit import (
    OFFSET,
    Fit,
    Start,
    apart_m,
    free_parameters,
    predict,
    refine,
    starting_pose,
    surprise,
)
from vad.mapping.camera_spread import best_of_each, spread, spread_selection
from vad.mapping.camera_track import PoseTrack

MIN_PAIRS = 15
MIN_AREA_M2 = 0.5
MIN_WIDTH_M = 0.12
MAX_POSITION_SIGMA_M = 0.3
MAX_DEVIATION_M = 0.12
# Two solutions this near to each other are one.
MAX_RIVAL_M = 0.1
# The robot must be what moves where it says it is in this share of the frames that should show it moving.
MIN_AGREEING = 0.4
# So many frames with something moving, and none of it the robot, are a verdict and not a lack of data.
VERDICT_FRAMES = 150

SOLVE_FRAMES = 1200
_SEARCH_FRAMES = 80
_KEPT_FRAMES = 6000
_KEPT_POSES = 60_000
_ROUNDS = 4
_CONTACT_ROUNDS = 2
# A pair this many standard deviations off is something else.
_MAX_SURPRISE = 4.0
# A stretch of the drive after the robot found itself anew joins the rest where so many frames agree.
_JOIN_SHARE = 0.5
_ENOUGH_SIGHTINGS = 100
# Squared surprise by which one solution must be better than another to be told from it.
_RIVAL_MARGIN = 40.0
# The pose must be known this long around a pair, for its derivative in time.
_TIME_MARGIN_S = 0.25
_MOVING_M_S = 0.05


class CameraMapper:
    """Collects poses and candidates of one camera under one map epoch, and solves for the camera.

    Feed both in any order as they come; `solve` whenever a result is wanted. For a new map epoch or a moved
    camera make a new one.

    Args:
        width_px, height_px: of the picture.
        intrinsics: of a calibrated lens; without it the focal length, two radial terms and the principal
            point (near the centre) are estimated.
    """

    def __init__(self, width_px: int, height_px: int, intrinsics: Intrinsics | None = None) -> None:
        if intrinsics is not None and (intrinsics.width_px, intrinsics.height_px) != (width_px, height_px):
            raise ValueError("the intrinsics are of another picture size")
        focal = float(width_px)
        self._lens = intrinsics or Intrinsics(
            width_px, height_px, focal, focal, (width_px - 1) / 2, (height_px - 1) / 2
        )
        self._lens_known = intrinsics is not None
        self._poses: deque[tuple[int, float, float, float]] = deque(maxlen=_KEPT_POSES)
        self._frames: deque[Candidates] = deque(maxlen=_KEPT_FRAMES)

    def add_pose(self, t_ns: int, x_m: float, y_m: float, sigma_m: float) -> None:
        """One robot pose, map frame, at its own stamp."""
        self._poses.append((t_ns, x_m, y_m, sigma_m))

    def add_candidates(
        self, t_ns: int, image_px: ArrayLike, sigma_px: ArrayLike, box_px: ArrayLike | None = None
    ) -> None:
        """What may be the robot in one frame.

        Args:
            image_px: (N, 2) floor contacts, raw pixels. sigma_px: scalar or (N,). box_px: (N, 4) where a
                contact was made from a box with an assumed height of the robot, raw pixels, NaN for others.
        """
        frame = Candidates.of(t_ns, image_px, sigma_px, box_px)
        if len(frame.px):
            self._frames.append(frame)

    def solve(self) -> CameraCalibration:
        """The best calibration from what was collected, or what is missing. Under 0.5 s."""
        if len(self._poses) < 2:
            return CameraCalibration("uncalibrated", 0, "no robot poses have come yet")
        if not self._frames:
            return CameraCalibration("uncalibrated", 0, "nothing has moved in the picture yet")
        track, origin_ns = self._track()
        sightings = self._chosen(track, origin_ns)
        frames = len(np.unique(sightings.frame))
        xy, _ = track.at(sightings.t_s)
        if frames < MIN_PAIRS:
            return CameraCalibration(
                "collecting", 99 * frames // MIN_PAIRS, f"{frames} of {MIN_PAIRS} pictures of a moving robot"
            )
        area_m2, width_m = spread(xy)
        if (refused := _spread_gate(area_m2, width_m)) is not None:
            return CameraCalibration("collecting", refused[0], refused[1])
        fit = self._fit(sightings, track)
        if fit is None:
            return _no_consensus(frames, 0)
        return self._judge(*self._with_contacts(*fit, track), track)

    def deviations(self, known: CameraCalibration) -> Deviations | None:
        """What was collected against a calibration that is not changed by it; None if it has no place."""
        lens, pose, offset_s = known.intrinsics, known.camera_from_map, known.time_offset_s
        if lens is None or pose is None or offset_s is None or len(self._poses) < 2 or not self._frames:
            return None
        track, origin_ns = self._track()
        sightings = self._chosen(track, origin_ns)
        if not len(sightings.frame):
            return None
        at = Start(lens, pose, offset_s)
        sightings = recontacted(sightings, at)
        pairs = sightings.take(self._named(at, sightings, track))
        xy, _ = track.at(pairs.t_s + offset_s)
        found, _ = known.floor_point(pairs.image_px, pairs.sigma_px)
        return Deviations(
            xy, found, pairs.image_px, self._share_agreeing(at, pairs, sightings, track), track.xy_m
        )

    def _track(self) -> tuple[PoseTrack, int]:
        origin_ns = self._poses[0][0]
        table = np.array([(1e-9 * (t - origin_ns), x, y, s) for t, x, y, s in self._poses])
        return PoseTrack(table[:, 0], table[:, 1:3], table[:, 3]), origin_ns

    def _chosen(self, track: PoseTrack, origin_ns: int) -> Sightings:
        """At most SOLVE_FRAMES frames, spread evenly over the floor that was driven."""
        frame_s = np.array([1e-9 * (frame.t_ns - origin_ns) for frame in self._frames])
        xy, _ = track.at(frame_s)
        rows = spread_selection(xy, SOLVE_FRAMES)
        return sightings_of([self._frames[row] for row in rows], origin_ns)

    def _fit(self, sightings: Sightings, track: PoseTrack) -> tuple[Fit, Sightings, Sightings] | None:
        """The fit, its pairs, and the sightings it speaks of: those under one belief of the robot."""
        segment = track.segment_at(sightings.t_s)
        names, counts = np.unique(segment[segment >= 0], return_counts=True)
        if len(names) < 2:
            found = self._fit_one(sightings, track)
            return None if found is None else (*found, sightings)
        # The robot has found itself anew in between. What it believed last counts, once that tells enough;
        # the rest must agree.
        enough = counts >= min(_ENOUGH_SIGHTINGS, counts.max())
        for name in names[enough][::-1]:
            most = name
            if _spread_gate(*spread(track.at(sightings.t_s[segment == name])[0])) is None:
                break
        inside = segment == most
        found = self._fit_one(sightings.take(inside), track)
        if found is None:
            return None
        odd = surprise(found[0].at, sightings, track)
        for name in names[names != most]:
            of_it = segment == name
            agreeing = best_of_each(sightings.frame[of_it], odd[of_it], _MAX_SURPRISE)
            if len(agreeing) >= _JOIN_SHARE * len(np.unique(sightings.frame[of_it])):
                inside |= of_it
        used = sightings.take(inside)
        if np.count_nonzero(inside) > np.count_nonzero(segment == most):
            found = self._fit_one(used, track) or found
        return (*found, used)

    def _fit_one(self, sightings: Sightings, track: PoseTrack) -> tuple[Fit, Sightings] | None:
        if not len(sightings.frame):
            return None
        straight = undistort(sightings.image_px, self._lens)
        few = sightings.frame < np.unique(sightings.frame)[:_SEARCH_FRAMES][-1]
        solved: list[tuple[float, Fit, Sightings]] = []
        for guess in search_time_offset(straight[few], sightings.take(few), track):
            found = consensus(straight, sightings, track, guess.time_offset_s)
            if found is None or found.frames < 6:
                continue
            fitted = self._fit_from(found, straight, sightings, track)
            if fitted is not None:
                solved.append((self._misfit(fitted[0].at, sightings, track), *fitted))
        if not solved:
            return None
        cost, fit, pairs = min(solved, key=lambda one: one[0])
        alike = [other for misfit, other, _ in solved if misfit < cost + _RIVAL_MARGIN]
        apart = [apart_m(fit.at, other.at, pairs.image_px) for other in alike]
        return replace(fit, rival_m=max(apart)), pairs

    def _with_contacts(
        self, fit: Fit, pairs: Sightings, sightings: Sightings, track: PoseTrack
    ) -> tuple[Fit, Sightings, Sightings]:
        """The fit again, with the contacts of boxes as they are seen from where the camera is now known."""
        free = free_parameters(lens_known=self._lens_known)
        for _ in range(0 if sightings.box is None else _CONTACT_ROUNDS):
            seen = recontacted(sightings, fit.at)
            named = seen.take(self._named(fit.at, seen, track))
            again = refine(fit.at, named, track, free=free) if len(named.frame) >= MIN_PAIRS else None
            if again is None:
                break
            fit, pairs, sightings = replace(again, rival_m=fit.rival_m), named, seen
        return fit, pairs, sightings

    def _misfit(self, at: Start, sightings: Sightings, track: PoseTrack) -> float:
        """How badly a camera explains all frames: squared surprise of the best of each, cut off."""
        odd = np.minimum(surprise(at, sightings, track), _MAX_SURPRISE)
        worst = np.full(int(sightings.frame.max()) + 1, _MAX_SURPRISE)
        np.minimum.at(worst, sightings.frame, odd)
        return float(np.sum(worst[np.unique(sightings.frame)] ** 2))

    def _fit_from(
        self, found: Consensus, straight: FloatArray, sightings: Sightings, track: PoseTrack
    ) -> tuple[Fit, Sightings] | None:
        start = self._start(found, straight, sightings, track)
        if start is None:
            return None
        free = free_parameters(lens_known=self._lens_known)
        named = self._agreeing(found, straight, sightings, track)
        result: tuple[Fit, Sightings] | None = None
        for _ in range(_ROUNDS):
            if len(named) < 6:
                return None
            pairs = sightings.take(named)
            fit = refine(start, pairs, track, free=free)
            if fit is None:
                return None
            start, result = fit.at, (fit, pairs)
            before, named = named, self._named(start, sightings, track)
            if np.array_equal(before, named):
                break
        return result

    def _agreeing(
        self, found: Consensus, straight: FloatArray, sightings: Sightings, track: PoseTrack
    ) -> NDArray[np.int64]:
        xy, _ = track.at(sightings.t_s + found.time_offset_s)
        miss = np.linalg.norm(apply_homography(found.map_from_image, straight) - xy, axis=1)
        miss = np.where(_inside(track, sightings.t_s + found.time_offset_s), miss, np.inf)
        return best_of_each(sightings.frame, miss, CONSENSUS_M)

    def _named(self, at: Start, sightings: Sightings, track: PoseTrack) -> NDArray[np.int64]:
        odd = surprise(at, sightings, track)
        odd = np.where(_inside(track, sightings.t_s + at.time_offset_s), odd, np.inf)
        return best_of_each(sightings.frame, odd, _MAX_SURPRISE)

    def _start(
        self, found: Consensus, straight: FloatArray, sightings: Sightings, track: PoseTrack
    ) -> Start | None:
        rows = self._agreeing(found, straight, sightings, track)
        xy, _ = track.at(sightings.t_s[rows] + found.time_offset_s)
        if len(rows) < 6:
            return None
        pose = starting_pose(straight[rows], xy, self._lens, focal_known=self._lens_known)
        return None if pose is None else Start(*pose, found.time_offset_s)

    def _judge(self, fit: Fit, pairs: Sightings, sightings: Sightings, track: PoseTrack) -> CameraCalibration:
        at, lens = fit.at, fit.at.intrinsics
        xy, _ = track.at(pairs.t_s + at.time_offset_s)
        map_from_image = floor_homography(lens, at.camera_from_map)
        predicted, _ = predict(at, pairs, track)
        seen = apply_homography(map_from_image, undistort(predicted + fit.left_out_px, lens))
        deviation_m = float(np.nanmean(np.linalg.norm(seen - xy, axis=1)))
        free_homography, _ = cv2.findHomography(
            undistort(pairs.image_px, lens), xy, cv2.RANSAC, CONSENSUS_M, maxIters=400
        )
        gap_m = None
        if free_homography is not None:
            own = apply_homography(map_from_image, undistort(pairs.image_px, lens))
            other = apply_homography(
                np.asarray(free_homography, dtype=np.float64), undistort(pairs.image_px, lens)
            )
            gap_m = float(np.nanmean(np.linalg.norm(own - other, axis=1)))
        covariance = fit.covariance[:PARAMETERS, :PARAMETERS]
        status, percent, reason = self._gates(fit, xy, deviation_m, pairs, sightings, track)
        return CameraCalibration(
            status=status,
            percent=percent,
            reason=reason,
            pairs=len(pairs.frame),
            unseen=self._unseen(pairs),
            camera_from_map=at.camera_from_map,
            intrinsics=lens,
            focal_sigma_px=lens.fx_px * float(np.sqrt(covariance[6, 6])),
            map_from_image=map_from_image,
            deviation_m=deviation_m,
            homography_gap_m=gap_m,
            time_offset_s=at.time_offset_s,
            time_offset_sigma_s=float(np.sqrt(fit.covariance[OFFSET, OFFSET])),
            parameter_covariance=covariance,
        )

    def _gates(
        self,
        fit: Fit,
        xy_m: FloatArray,
        deviation_m: float,
        pairs: Sightings,
        sightings: Sightings,
        track: PoseTrack,
    ) -> tuple[CameraStatus, int, str]:
        count, frames = len(pairs.frame), len(np.unique(sightings.frame))
        if count < MIN_PAIRS:
            refused = _no_consensus(frames, count)
            return refused.status, refused.percent, refused.reason
        share = self._share_agreeing(fit.at, pairs, sightings, track)
        if share < MIN_AGREEING:
            what = f"only {share:.0%} of the pictures that should show the robot show it where it says it is"
            return ("invalid" if frames >= VERDICT_FRAMES else "collecting"), 50, what
        if (refused_spread := _spread_gate(*spread(xy_m))) is not None:
            percent, reason = refused_spread
            return "collecting", percent, reason + self._advice(pairs)
        if fit.rival_m > MAX_RIVAL_M:
            return (
                "collecting",
                90,
                "the drive fits several places of the camera: let the robot drive straight, too",
            )
        if not deviation_m <= MAX_DEVIATION_M:
            return "invalid", 99, f"robot and camera differ by {deviation_m:.2f} m on average"
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(fit.covariance[3:6, 3:6])[-1]))
        if sigma_m > MAX_POSITION_SIGMA_M:
            percent = int(99 * MAX_POSITION_SIGMA_M / sigma_m)
            what = f"the camera's place is uncertain by {sigma_m:.2f} m: drive over more of the floor it sees"
            return "collecting", percent, what + self._advice(pairs)
        return "valid", 100, ""

    def _share_agreeing(self, at: Start, pairs: Sightings, sightings: Sightings, track: PoseTrack) -> float:
        """Share of the frames that should show the robot moving, in which it was found."""
        predicted, _ = predict(at, sightings, track)
        lens = at.intrinsics
        when = sightings.t_s + at.time_offset_s
        step = track.at(when + _TIME_MARGIN_S)[0] - track.at(when - _TIME_MARGIN_S)[0]
        moving = np.linalg.norm(step, axis=1) > 2.0 * _TIME_MARGIN_S * _MOVING_M_S
        inside = (predicted > 0.0).all(axis=1) & (predicted < (lens.width_px, lens.height_px)).all(axis=1)
        expected = np.unique(sightings.frame[moving & inside])
        return float(np.mean(np.isin(expected, pairs.frame))) if len(expected) else 0.0

    def _unseen(self, pairs: Sightings) -> tuple[str, ...]:
        third = np.clip((3.0 * pairs.image_px[:, 0] / self._lens.width_px).astype(int), 0, 2)
        return tuple(name for k, name in enumerate(("left", "middle", "right")) if not np.any(third == k))

    def _advice(self, pairs: Sightings) -> str:
        unseen = self._unseen(pairs)
        if not unseen:
            return ""
        return f"; the robot has not been seen in the {' and '.join(unseen)} third of the picture"


def _inside(track: PoseTrack, t_s: FloatArray) -> NDArray[np.bool_]:
    before, after = track.at(t_s - _TIME_MARGIN_S)[0], track.at(t_s + _TIME_MARGIN_S)[0]
    return np.isfinite(before[:, 0]) & np.isfinite(after[:, 0])


def _spread_gate(area_m2: float, width_m: float) -> tuple[int, str] | None:
    if width_m < MIN_WIDTH_M:
        return (
            int(99 * width_m / MIN_WIDTH_M),
            "the robot has driven along one line only: it must also drive across",
        )
    if area_m2 < MIN_AREA_M2:
        return (
            int(99 * area_m2 / MIN_AREA_M2),
            f"the robot has been seen on {area_m2:.1f} m2 of floor, {MIN_AREA_M2} m2 are needed",
        )
    return None


def _no_consensus(frames: int, agreeing: int) -> CameraCalibration:
    if frames >= VERDICT_FRAMES:
        return CameraCalibration("invalid", 0, "nothing in the picture moves as the robot says it does")
    return CameraCalibration(
        "collecting",
        min(99, 99 * agreeing // MIN_PAIRS),
        f"{agreeing} of {MIN_PAIRS} pictures show the robot where it says it is",
    )
