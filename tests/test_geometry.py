"""Frames, cameras and homographies: against OpenCV where it knows the same, and their own inverses."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vad.geometry import (
    Intrinsics,
    Rigid,
    apply_homography,
    floor_homography,
    look_at,
    project,
    rotation_from_vector,
    undistort,
)

LENS = Intrinsics(640, 480, 500.0, 510.0, 322.0, 236.0, -0.18, 0.05)
places = st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(0.8, 3.0))
targets = st.tuples(st.floats(4.0, 6.0), st.floats(4.0, 6.0), st.just(0.0))


@given(eye=places, target=targets, seed=st.integers(0, 2**16))
def test_project_is_opencvs(eye: tuple[float, ...], target: tuple[float, ...], seed: int) -> None:
    camera_from_map = look_at(eye, target)
    points = np.array(target) + np.random.default_rng(seed).uniform(-1.0, 1.0, (20, 3))
    turn, _ = cv2.Rodrigues(camera_from_map.rotation)
    lens = np.array([LENS.k1, LENS.k2, 0.0, 0.0])
    expected, _ = cv2.projectPoints(points, turn, camera_from_map.translation, LENS.matrix, lens)
    assert np.allclose(project(points, LENS, camera_from_map), expected[:, 0], atol=1e-6)


@given(eye=places, target=targets, seed=st.integers(0, 2**16))
def test_floor_homography_inverts_projection(
    eye: tuple[float, ...], target: tuple[float, ...], seed: int
) -> None:
    camera_from_map = look_at(eye, target)
    floor = np.array(target) + np.random.default_rng(seed).uniform(-0.8, 0.8, (20, 3)) * [1.0, 1.0, 0.0]
    px = undistort(project(floor, LENS, camera_from_map), LENS)
    map_from_image = floor_homography(LENS, camera_from_map)
    assert np.allclose(apply_homography(map_from_image, px), floor[:, :2], atol=1e-6)
    image_from_map = np.linalg.inv(map_from_image)
    assert np.allclose(apply_homography(image_from_map, floor[:, :2]), px, atol=1e-5)


@given(eye=places, target=targets)
def test_look_at_is_level_and_centred(eye: tuple[float, ...], target: tuple[float, ...]) -> None:
    camera_from_map = look_at(eye, target)
    assert np.allclose(camera_from_map.rotation @ camera_from_map.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(camera_from_map.rotation) == pytest.approx(1.0)
    seen = camera_from_map.apply([target])[0]
    assert np.allclose(seen[:2], 0.0, atol=1e-9)
    assert seen[2] > 0.0
    assert np.allclose(camera_from_map.inverse().translation, eye)
    # Right is level, and the map's up is the picture's up.
    assert camera_from_map.rotation[0, 2] == pytest.approx(0.0)
    assert camera_from_map.rotation[1, 2] < 0.0


def test_look_straight_down_and_nowhere() -> None:
    down = look_at([0.0, 0.0, 2.0], [0.0, 0.0, 0.0])
    assert np.allclose(down.apply([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), [[1.0, 0.0, 2.0], [0.0, -1.0, 2.0]])
    with pytest.raises(ValueError, match="same point"):
        look_at([1.0, 1.0, 1.0], [1.0, 1.0, 1.0])


@given(st.tuples(*[st.floats(-3.0, 3.0)] * 3), st.tuples(*[st.floats(-3.0, 3.0)] * 3))
def test_rigid_motions(turn: tuple[float, float, float], shift: tuple[float, float, float]) -> None:
    expected, _ = cv2.Rodrigues(np.array(turn))
    assert np.allclose(rotation_from_vector(turn), expected, atol=1e-9)
    b_from_a = Rigid(rotation_from_vector(turn), np.array(shift))
    c_from_b = look_at([0.0, 0.0, 1.0], [1.0, 2.0, 0.0])
    points = np.random.default_rng(0).normal(size=(5, 3))
    assert np.allclose(c_from_b.compose(b_from_a).apply(points), c_from_b.apply(b_from_a.apply(points)))
    assert np.allclose(b_from_a.inverse().apply(b_from_a.apply(points)), points)


def test_points_behind_the_camera_are_nowhere() -> None:
    px = project([[0.0, -5.0, 1.0], [0.0, 5.0, 1.0]], LENS, look_at([0.0, 0.0, 1.0], [0.0, 1.0, 1.0]))
    assert np.isnan(px[0]).all()
    assert np.isfinite(px[1]).all()


def test_undistort_says_where_the_model_ends() -> None:
    barrel = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0, -0.3)
    straight = undistort([[320.0, 240.0], [500.0, 300.0], [5000.0, 240.0]], barrel)
    assert np.allclose(straight[0], [320.0, 240.0])
    assert np.isfinite(straight[1]).all()
    assert np.isnan(straight[2]).all()
    plain = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0)
    assert np.array_equal(undistort([[1.0, 2.0]], plain), [[1.0, 2.0]])


def test_horizon_has_no_floor_point() -> None:
    homography = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    assert np.isnan(apply_homography(homography, [[1.0, 0.0]])).all()
