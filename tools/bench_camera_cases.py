"""The drives of `tools/bench camera`: what is fed to stage 1, and how far its answer is from the truth."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np

from vad.mapping import camera_consensus as mapping
from vad.mapping.camera_calibration import CameraCalibration
from vad.mapping.camera_contact import recontacted
from vad.mapping.camera_fit import Start, information
from vad.mapping.camera_spread import best_of_each
from vad.mapping.camera_stage import CameraMapper
from vad.mapping.camera_track import PoseTrack
from vad.sim.camera_drive import (
    LATENCY_S,
    PIXEL_SIGMA,
    POSE_SIGMA_M,
    START_S,
    Candidates,
    Drive,
    DriveShape,
    Poses,
    make_drive,
)
from vad.sim.render_lens import LensRenderer
from vad.vision.people import MotionGate, PoseNetwork
from vad.vision.robot import RobotFinder

FRAME_HZ = 10.0
POSE_HZ = 10.0
_S_NS = 1_000_000_000
_ROBOT_WITHIN_PX = 15.0


@dataclass(frozen=True, slots=True)
class Variant:
    """How the robot tells where it is, and what the camera's lens is like."""

    name: str
    pose_hz: float = POSE_HZ
    latency_s: float = LATENCY_S
    centred: bool = True
    lens_known: bool = False
    outliers: float = 0.0
    jump_m: float = 0.0
    whole_cm: bool = False


VARIANTS = (
    Variant("poses 10 Hz"),
    Variant("poses 5 Hz", pose_hz=5.0),
    Variant("poses 0.5 Hz, whole cm (Valetudo)", pose_hz=0.5, whole_cm=True),
    Variant("principal point off by 1 %", centred=False),
    Variant("lens known", lens_known=True),
    Variant("poses 1.7 s late", latency_s=1.7),
    Variant("poses 1.7 s early", latency_s=-1.7),
    Variant("5 % wild poses, one jump of 0.5 m", outliers=0.05, jump_m=0.5),
)


@dataclass(frozen=True, slots=True)
class Score:
    """One drive's result against the truth. deviation_m: camera's floor point of the robot's true pixel
    from the robot's true place, mean over the drive; seen_m: the same for the pixels that were found;
    stated_m: what the calibration itself says of robot and camera; bound_m: the least rms error of the
    camera's position that this drive's noise allows (Cramér-Rao)."""

    source: str
    variant: str
    shape: str
    seed: int
    status: str
    reason: str
    deviation_m: float = np.nan
    seen_m: float = np.nan
    stated_m: float = np.nan
    focal: float = np.nan
    offset_s: float = np.nan
    position_m: float = np.nan
    position_nees: float = np.nan
    bound_m: float = np.nan
    solve_s: float = np.nan
    worst_m: float = field(default=np.nan)


def poses_of(drive: Drive, variant: Variant, rng: np.random.Generator) -> Poses:
    """The robot's poses as the variant has them."""
    t_s, xy_m = drive.poses(rng, rate_hz=variant.pose_hz, latency_s=variant.latency_s)
    if variant.jump_m:
        # It finds itself again after a third of the drive: all before was said in a shifted frame.
        angle = rng.uniform(0.0, 2 * np.pi)
        lost = t_s < t_s[0] + (t_s[-1] - t_s[0]) / 3.0
        xy_m = xy_m + variant.jump_m * np.outer(lost, (np.cos(angle), np.sin(angle)))
    wild = rng.random(len(t_s)) < variant.outliers
    xy_m = np.where(wild[:, None], xy_m + rng.uniform(-2.0, 2.0, xy_m.shape), xy_m)
    return Poses(t_s, np.round(xy_m, 2) if variant.whole_cm else xy_m)


def rendered(drive: Drive, network: PoseNetwork) -> list[Candidates]:
    """What the finder says of rendered frames, people masked by the real network."""
    renderer, finder, gate = LensRenderer(drive.scenario, drive.lens), RobotFinder(), MotionGate()
    frames = []
    for t in np.arange(0.0, drive.end_s, 1.0 / FRAME_HZ).tolist():
        image = renderer.frame(t)
        people = network.infer(image) if gate.update(image) else []
        boxes = np.array([p.box for p in people]).reshape(-1, 4)
        found = finder.update(image, boxes)
        if found:
            px = np.array([[c.x_px, c.y_px] for c in found])
            sigma_px = np.array([c.sigma_px for c in found])
            frames.append(Candidates(t, px, sigma_px, np.array([c.box for c in found])))
    return frames


def drive_of(shape: DriveShape, seed: int, laps: int, variant: Variant) -> Drive:
    """The drive of a case."""
    return make_drive(seed, shape, laps=laps, centred=variant.centred)


def solve(source: str, variant: Variant, seed: int, drive: Drive, frames: list[Candidates]) -> Score:
    """Calibrate from a drive's poses and candidates, and compare."""
    rng = np.random.default_rng([seed, 0xB0])
    lens = drive.lens
    mapper = CameraMapper(lens.width_px, lens.height_px, lens if variant.lens_known else None)
    for t, (x, y) in zip(*poses_of(drive, variant, rng), strict=True):
        mapper.add_pose(round(t * _S_NS), float(x), float(y), POSE_SIGMA_M)
    for frame in frames:
        mapper.add_candidates(round(frame.t_s * _S_NS), frame.px, frame.sigma_px, frame.box)
    begun = time.process_time()
    result = mapper.solve()
    spent_s = time.process_time() - begun
    score = Score(source, variant.name, drive.shape, seed, result.status, result.reason, solve_s=spent_s)
    if result.camera_from_map is None:
        return score
    return compared(score, drive, variant, frames, result)


def compared(
    score: Score, drive: Drive, variant: Variant, frames: list[Candidates], result: CameraCalibration
) -> Score:
    """The score with what the result says against the truth."""
    t_s = np.arange(START_S, drive.end_s, 0.2)
    truth = drive.robot_xy_m(t_s)
    px = drive.pixels(truth)
    visible = np.isfinite(px[:, 0])
    xy, _ = result.floor_point(px[visible], PIXEL_SIGMA)
    off_m = np.linalg.norm(xy - truth[visible], axis=1)
    assert result.intrinsics is not None
    assert result.position_m is not None
    assert result.position_covariance is not None
    assert result.time_offset_s is not None
    error = result.position_m - drive.eye_m
    return replace(
        score,
        deviation_m=float(np.mean(off_m)),
        worst_m=float(np.max(off_m)),
        seen_m=_seen(drive, frames, result),
        stated_m=float(result.deviation_m or np.nan),
        focal=result.intrinsics.fx_px / drive.lens.fx_px - 1.0,
        offset_s=result.time_offset_s - variant.latency_s,
        position_m=float(np.linalg.norm(error)),
        position_nees=float(error @ np.linalg.solve(result.position_covariance, error)) / 3.0,
        bound_m=position_bound_m(drive, variant),
    )


def _seen(drive: Drive, frames: list[Candidates], result: CameraCalibration) -> float:
    """Mean distance of the found robot's floor point from its true place, over frames that show it."""
    assert result.intrinsics is not None
    assert result.camera_from_map is not None
    at = Start(result.intrinsics, result.camera_from_map, 0.0)
    plain = [mapping.Candidates.of(round(f.t_s * _S_NS), f.px, f.sigma_px, f.box) for f in frames]
    found = recontacted(mapping.sightings_of(plain, 0), at)
    truth = drive.robot_xy_m(np.array([f.t_s for f in frames]))
    off_px = np.linalg.norm(found.image_px - drive.pixels(truth)[found.frame], axis=1)
    xy, _ = result.floor_point(found.image_px, PIXEL_SIGMA)
    best = best_of_each(found.frame, off_px, _ROBOT_WITHIN_PX)
    return float(np.nanmean(np.linalg.norm(xy - truth[found.frame], axis=1)[best]))


def position_bound_m(drive: Drive, variant: Variant) -> float:
    """Cramér-Rao bound (rms) of the camera's position for white noise of poses and pixels.

    One pair per pose or frame, whichever are fewer; lens priors as in the fit.
    """
    rate_hz = min(variant.pose_hz, FRAME_HZ)
    every = np.arange(0.0, drive.end_s + 1.0, 0.1)
    track = PoseTrack(every, drive.robot_xy_m(every), np.full(len(every), POSE_SIGMA_M))
    t_s = np.arange(START_S, drive.end_s - 0.5, 1.0 / rate_hz)
    px = drive.pixels(drive.robot_xy_m(t_s))
    pixel_sigma = PIXEL_SIGMA * np.sqrt(rate_hz / FRAME_HZ)
    seen = np.isfinite(px[:, 0])
    pairs = mapping.Sightings(
        np.flatnonzero(seen), t_s[seen], px[seen], np.full(int(seen.sum()), pixel_sigma)
    )
    at = Start(drive.lens, drive.camera_from_map, 0.0)
    covariance = np.linalg.inv(information(at, pairs, track, lens_known=variant.lens_known))
    return float(np.sqrt(np.trace(covariance[3:6, 3:6])))
