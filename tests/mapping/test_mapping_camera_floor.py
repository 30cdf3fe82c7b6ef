"""The floor in a camera's picture: every point inside the outline is in the picture, every other is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from vad.geometry import Intrinsics, look_at, project
from vad.mapping.camera_calibration import CameraCalibration
from vad.mapping.camera_floor import floor_in_picture

BOUNDS = (-1.0, -2.0, 7.0, 5.0)
LENS = Intrinsics(640, 480, 420.0, 420.0, 319.5, 239.5)


def calibration(eye: tuple[float, float, float], target: tuple[float, float, float]) -> CameraCalibration:
    return CameraCalibration("valid", 100, "", camera_from_map=look_at(eye, target), intrinsics=LENS)


def inside(outline: np.ndarray, x: float, y: float) -> float:
    """How far within a convex counter-clockwise outline; negative outside."""
    edges = np.roll(outline, -1, axis=0) - outline
    lengths = np.maximum(np.hypot(*edges.T), 1e-9)
    cross = edges[:, 0] * (y - outline[:, 1]) - edges[:, 1] * (x - outline[:, 0])
    return float((cross / lengths)[np.hypot(*edges.T) > 0.02].min())


places = st.tuples(st.floats(-0.9, 6.9), st.floats(-1.9, 4.9))


@given(
    eye=st.tuples(st.floats(0, 6), st.floats(-1, 4), st.floats(0.8, 2.6)),
    target=st.tuples(st.floats(0, 6), st.floats(-1, 4), st.floats(0, 1.5)),
    place=places,
)
def test_the_outline_holds_what_the_picture_shows(
    eye: tuple[float, float, float], target: tuple[float, float, float], place: tuple[float, float]
) -> None:
    if np.hypot(eye[0] - target[0], eye[1] - target[1]) < 0.2:
        return
    known = calibration(eye, target)
    outline = floor_in_picture(known, BOUNDS)
    assert known.camera_from_map is not None
    ((u, v),) = project([[*place, 0.0]], LENS, known.camera_from_map)
    margin_px = min(u + 0.5, 639.5 - u, v + 0.5, 479.5 - v) if np.isfinite(u) else -np.inf
    if outline is None:
        assert not margin_px > 5, "a point well in the picture has an outline around it"
        return
    within_m = inside(np.array(outline), *place)
    if margin_px > 5:
        assert within_m > -0.03
    elif margin_px < -5:
        assert within_m < 0.03


def test_a_camera_that_looks_level_sees_floor_up_to_the_end_of_the_map() -> None:
    outline = floor_in_picture(calibration((0.0, 0.0, 1.5), (5.0, 0.0, 1.5)), BOUNDS)
    assert outline is not None
    assert max(x for x, _ in outline) == BOUNDS[2]
    assert min(x for x, _ in outline) > 1.0, "not the floor below it"


def test_no_outline_where_the_place_is_not_known_or_no_floor_is_seen() -> None:
    assert floor_in_picture(CameraCalibration("collecting", 40, "drive on"), BOUNDS) is None
    upwards = calibration((0.0, 0.0, 1.5), (1.0, 0.0, 4.5))
    assert floor_in_picture(upwards, BOUNDS) is None
    moved = replace(calibration((0.0, 0.0, 2.0), (3.0, 0.0, 0.0)), status="invalid")
    assert floor_in_picture(moved, BOUNDS) is None


def test_a_bent_lens_shows_no_more_than_its_middles() -> None:
    straight = calibration((0.0, 0.0, 2.0), (3.0, 1.0, 0.0))
    bent = replace(straight, intrinsics=replace(LENS, k1=-0.1, k2=0.01))
    outline = floor_in_picture(bent, BOUNDS)
    assert outline is not None
    assert bent.camera_from_map is not None
    assert bent.intrinsics is not None
    corners = np.column_stack([np.array(outline), np.zeros(len(outline))])
    u, v = project(0.98 * corners + 0.02 * corners.mean(axis=0), bent.intrinsics, bent.camera_from_map).T
    assert (u > -8).all()
    assert (u < 648).all()
    assert (v > -8).all()
    assert (v < 488).all()
