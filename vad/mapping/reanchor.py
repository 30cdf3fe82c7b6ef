"""What hangs on a floor plan, moved onto the plan that took its place. Pure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vad.geometry import Rigid
from vad.mapping.camera_calibration import PARAMETERS, CameraCalibration
from vad.mapping.plan_match import PlanTransform
from vad.mapping.posterior import Grid, Posterior

FloatArray = NDArray[np.float64]


def moved_covariance(covariance_m2: FloatArray, transform: PlanTransform) -> FloatArray:
    """(2, 2) of x and y, in the new frame."""
    return np.asarray(transform.matrix @ covariance_m2 @ transform.matrix.T, np.float64)


def moved_posterior(posterior: Posterior, transform: PlanTransform, grid: Grid) -> Posterior:
    """The posterior on a grid of the new frame, linear between the old places; beyond them as at the edge.

    Beyond the old plan nothing was asked, so nothing is ruled out there.
    """
    old = posterior.grid
    at = (transform.inverse_apply(grid.points_m) - (old.x0_m, old.y0_m)) / old.step_m
    x, y = np.clip(at[:, 0], 0, old.columns - 1), np.clip(at[:, 1], 0, old.rows - 1)
    column = np.minimum(x.astype(np.int64), old.columns - 2)
    row = np.minimum(y.astype(np.int64), old.rows - 2)
    fx, fy = x - column, y - row
    d = posterior.log_density
    low = (1 - fx) * d[row, column] + fx * d[row, column + 1]
    high = (1 - fx) * d[row + 1, column] + fx * d[row + 1, column + 1]
    values = ((1 - fy) * low + fy * high).reshape(grid.rows, grid.columns)
    return Posterior(grid, values - values.max())


def moved_calibration(known: CameraCalibration, transform: PlanTransform) -> CameraCalibration:
    """The camera's place in the new frame, as good as before.

    A valid calibration alone is worth moving. After a flip there is none: no camera sees a mirrored home.
    """
    if known.status != "valid" or known.camera_from_map is None:
        return CameraCalibration("uncalibrated", 0, "the robot's map has changed")
    if transform.flipped:
        return CameraCalibration("uncalibrated", 0, "the robot's map was mirrored: let it drive again")
    turn = np.eye(3)
    turn[:2, :2] = transform.matrix
    new_from_old = Rigid(turn, np.array([transform.x_m, transform.y_m, 0.0]))
    homography, covariance = known.map_from_image, known.parameter_covariance
    if homography is not None:
        on_floor = turn.copy()
        on_floor[:2, 2] = transform.x_m, transform.y_m
        homography = on_floor @ homography
    if covariance is not None:
        # The small rotation is in the camera's frame; the position alone turns with the map.
        by_old = np.eye(PARAMETERS)
        by_old[3:6, 3:6] = turn
        covariance = by_old @ covariance @ by_old.T
    return replace(
        known,
        camera_from_map=known.camera_from_map.compose(new_from_old.inverse()),
        map_from_image=homography,
        parameter_covariance=covariance,
    )
