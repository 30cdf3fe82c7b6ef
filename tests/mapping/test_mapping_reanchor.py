"""Devices and cameras moved with the map: the same places, seen from the new frame."""

from __future__ import annotations

import math

import numpy as np
import pytest

from vad.geometry import Intrinsics, apply_homography, floor_homography, look_at
from vad.mapping.camera_calibration import PARAMETERS, CameraCalibration
from vad.mapping.plan_match import IDENTITY, PlanTransform
from vad.mapping.posterior import Grid, Posterior
from vad.mapping.reanchor import moved_calibration, moved_covariance, moved_posterior

TURN = PlanTransform(math.radians(90), 4.0, -1.0)
FLIP = PlanTransform(0.4, 1.0, 2.0, flipped=True)


def bump(grid: Grid, x: float, y: float) -> Posterior:
    d = grid.points_m - (x, y)
    log = -0.5 * (d[:, 0] ** 2 / 0.09 + d[:, 1] ** 2 / 0.01)
    return Posterior(grid, log.reshape(grid.rows, grid.columns))


@pytest.mark.parametrize("transform", [TURN, FLIP, IDENTITY])
def test_a_posterior_keeps_its_place_and_shape(transform: PlanTransform) -> None:
    old = bump(Grid.over((0.0, 0.0, 6.0, 4.0), 0.1), 3.2, 1.5)
    corners = transform.apply(np.array([[0.0, 0.0], [6.0, 0.0], [0.0, 4.0], [6.0, 4.0]]))
    (x0, y0), (x1, y1) = corners.min(axis=0), corners.max(axis=0)
    new = moved_posterior(old, transform, Grid.over((x0 - 0.03, y0, x1, y1 + 0.04), 0.1))
    mean, covariance = new.mean_and_covariance()
    old_mean, old_covariance = old.mean_and_covariance()
    np.testing.assert_allclose(mean, transform.apply(old_mean[None])[0], atol=0.01)
    np.testing.assert_allclose(covariance, moved_covariance(old_covariance, transform), atol=0.004)


def test_what_lies_beyond_the_old_map_is_not_ruled_out() -> None:
    old = bump(Grid.over((0.0, 0.0, 6.0, 4.0), 0.1), 5.9, 2.0)
    wider = moved_posterior(old, IDENTITY, Grid.over((0.0, 0.0, 8.0, 4.0), 0.1))
    # As likely as the edge beside it, not less.
    assert wider.log_density[20, 75] == pytest.approx(old.log_density[20, 60], abs=0.01)


def calibration() -> CameraCalibration:
    lens = Intrinsics(640, 480, 600.0, 600.0, 319.5, 239.5)
    pose = look_at([0.2, 0.3, 2.0], [3.0, 2.0, 0.0])
    doubt = np.diag(np.arange(1.0, PARAMETERS + 1) * 1e-4)
    return CameraCalibration(
        "valid",
        100,
        "",
        camera_from_map=pose,
        intrinsics=lens,
        map_from_image=floor_homography(lens, pose),
        parameter_covariance=doubt,
    )


def test_a_camera_sees_the_same_floor_in_the_new_frame() -> None:
    old = calibration()
    new = moved_calibration(old, TURN)
    pixels = np.array([[320.0, 300.0], [100.0, 400.0], [600.0, 350.0]])
    before, doubt_before = old.floor_point(pixels, 1.0)
    after, doubt_after = new.floor_point(pixels, 1.0)
    np.testing.assert_allclose(after, TURN.apply(before), atol=1e-9)
    np.testing.assert_allclose(doubt_after, [moved_covariance(c, TURN) for c in doubt_before], rtol=1e-4)
    assert new.map_from_image is not None
    np.testing.assert_allclose(apply_homography(new.map_from_image, pixels), after, atol=1e-9)
    assert old.position_m is not None
    assert new.position_m is not None
    np.testing.assert_allclose(new.position_m[:2], TURN.apply(old.position_m[None, :2])[0], atol=1e-9)
    assert new.position_m[2] == pytest.approx(2.0)


def test_a_mirrored_map_and_an_unfinished_camera_begin_anew() -> None:
    assert moved_calibration(calibration(), FLIP).status == "uncalibrated"
    assert "mirrored" in moved_calibration(calibration(), FLIP).reason
    assert moved_calibration(CameraCalibration("collecting", 40, "drive on"), TURN).status == "uncalibrated"
