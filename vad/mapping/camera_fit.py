"""The camera's pose and lens from named sightings: solvePnP to start with, then least squares. Pure."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from vad.geometry import (
    FloatArray,
    Intrinsics,
    Rigid,
    apply_homography,
    floor_homography,
    project,
    rotation_from_vector,
    undistort,
)
from vad.mapping.camera_calibration import PARAMETERS, moved
from vad.mapping.camera_consensus import Sightings
from vad.mapping.camera_track import PoseTrack

# What is assumed of a lens nobody described: a horizontal view of 40 to 100 degrees, little distortion.
_FOCAL_PER_WIDTH = np.geomspace(0.4, 2.2, 12)
_FOCAL_PRIOR_PER_WIDTH = 0.85
_LOG_FOCAL_PRIOR_SIGMA = 0.5
_K1_PRIOR_SIGMA = 0.15
_K2_PRIOR_SIGMA = 0.05
_CENTRE_PRIOR_PER_WIDTH = 0.01
_OFFSET_PRIOR_SIGMA_S = 1.0

# Parameters of the fit: the camera's (camera_calibration.PARAMETERS), then the time offset.
OFFSET = PARAMETERS
_FIT_STEPS = np.array([1e-5, 1e-5, 1e-5, 1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5, 1e-2, 1e-2, 0.1])
_HUBER = 2.0
_UNKNOWN_COSTS = 4.0
_MAX_ROUNDS = 25


@dataclass(frozen=True, slots=True)
class Start:
    """A camera and a time offset; where a fit begins and ends."""

    intrinsics: Intrinsics
    camera_from_map: Rigid
    time_offset_s: float

    def moved(self, change: FloatArray) -> Start:
        """After a small change (12,) of the fit's parameters."""
        lens, camera_from_map = moved(self.intrinsics, self.camera_from_map, change[:PARAMETERS])
        return Start(lens, camera_from_map, self.time_offset_s + float(change[OFFSET]))


@dataclass(frozen=True, slots=True)
class Fit:
    """The least-squares estimate. covariance: (12, 12); left_out_px: (N, 2) residuals of each pair when it is
    predicted without itself; rival_m: how far off on the floor another camera is that fits alike."""

    at: Start
    covariance: FloatArray
    left_out_px: FloatArray
    rival_m: float = 0.0


def starting_pose(
    points_px: FloatArray, xy_m: FloatArray, lens: Intrinsics, *, focal_known: bool
) -> tuple[Intrinsics, Rigid] | None:
    """The best camera above the floor that solvePnP finds (eq. 3), over a range of focal lengths if unknown.

    Args:
        points_px: (N, 2) undistorted. xy_m: (N, 2) on the floor. lens: its focal length counts only if
            known.
    """
    floor = np.column_stack([xy_m, np.zeros(len(xy_m))])
    factors = (lens.fx_px / lens.width_px,) if focal_known else _FOCAL_PER_WIDTH
    best: tuple[float, Intrinsics, Rigid] | None = None
    for factor in factors:
        focal = float(factor) * lens.width_px
        tried = lens if focal_known else replace(lens, fx_px=focal, fy_px=focal)
        straight = replace(tried, k1=0.0, k2=0.0)
        for method in (cv2.SOLVEPNP_IPPE, cv2.SOLVEPNP_ITERATIVE):
            try:
                _, turns, shifts, _ = cv2.solvePnPGeneric(
                    floor, points_px, straight.matrix, None, flags=method
                )
            except cv2.error:
                # Degenerate points, such as those of a chance consensus on one line.
                continue
            for turn, shift in zip(turns, shifts, strict=True):
                camera_from_map = Rigid(
                    rotation_from_vector(turn), np.asarray(shift, dtype=np.float64).ravel()
                )
                if camera_from_map.inverse().translation[2] <= 0.0:
                    continue
                miss = np.linalg.norm(project(floor, straight, camera_from_map) - points_px, axis=1)
                cost = float(np.median(miss))
                if np.isfinite(cost) and (best is None or cost < best[0]):
                    best = (cost, tried, camera_from_map)
    return None if best is None else best[1:]


def predict(at: Start, sightings: Sightings, track: PoseTrack) -> tuple[FloatArray, FloatArray]:
    """Where the robot should be in the picture, (K, 2) raw pixels, and the covariance of the difference to
    the sighting, (K, 2, 2): the finder's own and the pose's seen through the camera. NaN where unknown."""
    xy, sigma_m = track.at(sightings.t_s + at.time_offset_s)
    floor = np.column_stack([xy, np.zeros(len(xy))])
    predicted = project(floor, at.intrinsics, at.camera_from_map)
    step = 1e-3
    by_map = np.stack(
        [
            (project(floor + shift, at.intrinsics, at.camera_from_map) - predicted) / step
            for shift in (np.array([step, 0.0, 0.0]), np.array([0.0, step, 0.0]))
        ],
        axis=-1,
    )
    covariance = by_map @ by_map.transpose(0, 2, 1) * (sigma_m**2)[:, None, None]
    covariance = covariance + np.eye(2) * (sightings.sigma_px**2)[:, None, None]
    return predicted, covariance


def surprise(at: Start, sightings: Sightings, track: PoseTrack) -> FloatArray:
    """Mahalanobis distance of each sighting from the robot, (K,); infinite where unknown."""
    predicted, covariance = predict(at, sightings, track)
    known = np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(predicted).all(axis=1)
    distance = np.full(len(predicted), np.inf)
    difference = (sightings.image_px - predicted)[known]
    solved = np.linalg.solve(covariance[known], difference[:, :, None])[:, :, 0]
    distance[known] = np.sqrt(np.sum(difference * solved, axis=1))
    return distance


def refine(start: Start, sightings: Sightings, track: PoseTrack, *, free: NDArray[np.bool_]) -> Fit | None:
    """Levenberg-Marquardt over pose, lens and time offset, Huber-weighted; every sighting is the robot.

    Args:
        free: (12,) which parameters may change. The priors are those of an undescribed lens.

    Returns:
        None if the sightings cannot be predicted or the equations are singular.
    """
    _, covariance = predict(start, sightings, track)
    if not np.all(np.isfinite(covariance)):
        return None
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    at, damping = start, 1e-3
    error = _whitened(at, sightings, track, whiten)
    cost = _cost(error, at)
    for _ in range(_MAX_ROUNDS):
        jacobian = _jacobian(at, sightings, track, whiten)
        normal, gradient = _normal_equations(jacobian, error, at, free)
        improved = False
        while damping < 1e6:
            change = np.zeros(len(free))
            damped = normal + damping * np.diag(np.diag(normal))
            change[free] = np.linalg.solve(damped, -gradient)
            candidate = at.moved(change)
            candidate_error = _whitened(candidate, sightings, track, whiten)
            candidate_cost = _cost(candidate_error, candidate)
            if candidate_cost < cost:
                improved = cost - candidate_cost > 1e-6 * cost
                at, error, cost, damping = candidate, candidate_error, candidate_cost, damping / 5.0
                break
            damping *= 5.0
        if not improved:
            break
    jacobian = _jacobian(at, sightings, track, whiten)
    normal, _ = _normal_equations(jacobian, error, at, free)
    return _conclude(at, sightings, track, whiten, jacobian, error, normal, free)


def apart_m(one: Start, other: Start, image_px: FloatArray) -> float:
    """Mean distance of two cameras' floor points of the same raw pixels (N, 2)."""
    here, there = (
        apply_homography(
            floor_homography(at.intrinsics, at.camera_from_map), undistort(image_px, at.intrinsics)
        )
        for at in (one, other)
    )
    return float(np.nanmean(np.linalg.norm(here - there, axis=1)))


def information(at: Start, sightings: Sightings, track: PoseTrack, *, lens_known: bool) -> FloatArray:
    """Fisher information of the parameters that may change, priors included; square.

    Of a true camera and a noiseless track its inverse is the Cramér-Rao bound. The first six rows are the
    pose.
    """
    _, covariance = predict(at, sightings, track)
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    jacobian = _jacobian(at, sightings, track, whiten)
    nothing = np.zeros((len(jacobian), 2))
    normal, _ = _normal_equations(jacobian, nothing, at, free_parameters(lens_known=lens_known))
    return normal


def free_parameters(*, lens_known: bool) -> NDArray[np.bool_]:
    """Which of the fit's parameters may change, (12,)."""
    free = np.ones(PARAMETERS + 1, dtype=np.bool_)
    free[6:PARAMETERS] = not lens_known
    return free


def _conclude(
    at: Start,
    sightings: Sightings,
    track: PoseTrack,
    whiten: FloatArray,
    jacobian: FloatArray,
    error: FloatArray,
    normal: FloatArray,
    free: NDArray[np.bool_],
) -> Fit | None:
    if not np.all(np.isfinite(normal)) or np.linalg.cond(normal) > 1e15:
        return None
    inverse = np.linalg.inv(normal)
    weight = _weights(error)
    freedom = max(2 * len(error) - int(np.count_nonzero(free)), 1)
    # Larger than stated noise widens the covariance; smaller does not narrow it.
    scatter = max(1.0, float(np.sum(weight * np.sum(error**2, axis=1))) / freedom)
    covariance = np.zeros((len(free), len(free)))
    shared = _shared(sightings.t_s + at.time_offset_s, track)
    covariance[np.ix_(free, free)] = inverse * scatter * shared
    # Leave-one-out to first order: r / (1 - leverage), two by two.
    chosen = jacobian[:, :, free]
    leverage = weight[:, None, None] * (chosen @ inverse @ chosen.transpose(0, 2, 1))
    predicted, _ = predict(at, sightings, track)
    shrink = np.linalg.solve(np.eye(2) - np.minimum(leverage, 0.9), error[:, :, None])
    left_out = np.linalg.solve(whiten, shrink)[:, :, 0]
    return Fit(at, covariance, np.where(np.isfinite(predicted), left_out, np.nan))


def _shared(t_s: FloatArray, track: PoseTrack) -> float:
    """How many pairs count as one: frames between the same two poses see the same pose error.

    How the robot strays between two poses is not shared by the frames between them.
    """
    per_interval = len(t_s) / len(np.unique(track.interval(t_s)))
    _, sigma_m = track.at(t_s)
    own_m = track.sigma_m[np.clip(track.interval(t_s) - 1, 0, len(track.sigma_m) - 1)]
    common = float(np.mean(np.minimum(own_m**2 / sigma_m**2, 1.0)[np.isfinite(sigma_m)]))
    return 1.0 + (per_interval - 1.0) * common


def _whitened(at: Start, sightings: Sightings, track: PoseTrack, whiten: FloatArray) -> FloatArray:
    xy, _ = track.at(sightings.t_s + at.time_offset_s)
    predicted = project(np.column_stack([xy, np.zeros(len(xy))]), at.intrinsics, at.camera_from_map)
    difference = (sightings.image_px - predicted)[:, :, None]
    error = np.asarray((whiten @ difference)[:, :, 0], dtype=np.float64)
    # A moment that the track does not know (any more) costs like a bad outlier and pulls nowhere.
    unknown = np.array([_UNKNOWN_COSTS, 0.0])
    known = np.asarray(np.isfinite(error).all(axis=1))
    return np.where(known[:, None], error, unknown)


def _jacobian(at: Start, sightings: Sightings, track: PoseTrack, whiten: FloatArray) -> FloatArray:
    columns = []
    for size, step in zip(_FIT_STEPS, np.diag(_FIT_STEPS), strict=True):
        ahead = _whitened(at.moved(step), sightings, track, whiten)
        behind = _whitened(at.moved(-step), sightings, track, whiten)
        columns.append((ahead - behind) / (2.0 * size))
    # At the track's ends the derivative in time is unknown; such a pair says nothing about the offset.
    return np.asarray(np.nan_to_num(np.stack(columns, axis=-1), nan=0.0), dtype=np.float64)


def _weights(error: FloatArray) -> FloatArray:
    size = np.linalg.norm(error, axis=1)
    return np.asarray(_HUBER / np.maximum(size, _HUBER), dtype=np.float64)


def _prior(at: Start) -> tuple[FloatArray, FloatArray]:
    """Deviation from the prior in standard deviations (12,), and 1/sigma (12,), zero where there is none."""
    lens = at.intrinsics
    inverse_sigma = np.zeros(PARAMETERS + 1)
    value = np.zeros(PARAMETERS + 1)
    value[6] = np.log(lens.fx_px / (_FOCAL_PRIOR_PER_WIDTH * lens.width_px))
    value[7:] = (
        lens.k1,
        lens.k2,
        lens.cx_px - (lens.width_px - 1) / 2,
        lens.cy_px - (lens.height_px - 1) / 2,
        at.time_offset_s,
    )
    centre_px = _CENTRE_PRIOR_PER_WIDTH * lens.width_px
    inverse_sigma[6:] = 1.0 / np.array(
        [
            _LOG_FOCAL_PRIOR_SIGMA,
            _K1_PRIOR_SIGMA,
            _K2_PRIOR_SIGMA,
            centre_px,
            centre_px,
            _OFFSET_PRIOR_SIGMA_S,
        ]
    )
    return value * inverse_sigma, inverse_sigma


def _cost(error: FloatArray, at: Start) -> float:
    size = np.linalg.norm(error, axis=1)
    robust = np.where(size <= _HUBER, 0.5 * size**2, _HUBER * (size - 0.5 * _HUBER))
    return float(np.sum(robust) + 0.5 * np.sum(_prior(at)[0] ** 2))


def _normal_equations(
    jacobian: FloatArray, error: FloatArray, at: Start, free: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray]:
    weight = _weights(error)[:, None]
    rows = jacobian.reshape(-1, jacobian.shape[-1])
    weighted = (jacobian * weight[:, :, None]).reshape(rows.shape)
    deviation, inverse_sigma = _prior(at)
    normal = rows.T @ weighted + np.diag(inverse_sigma**2)
    gradient = weighted.T @ error.ravel() + deviation * inverse_sigma
    return np.asarray(normal[np.ix_(free, free)], dtype=np.float64), np.asarray(gradient[free])
