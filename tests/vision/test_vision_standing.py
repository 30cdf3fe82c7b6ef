"""Where somebody stands by one picture: feet seen, hidden, contradicted or cut off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vad.geometry import Intrinsics, look_at
from vad.vision.body import ANKLES, CROWN, Body, Camera, body_of
from vad.vision.ground import Refusal
from vad.vision.people import Person
from vad.vision.standing import Standing, standing

PICTURE = np.zeros((480, 640, 3), np.uint8)
CAMERA = Camera(Intrinsics(640, 480, 410, 410, 320, 240), look_at((0, 0, 2.2), (3, 3, 0.5)))


def person_at(xy_m: tuple[float, float], height_m: float = 1.7) -> Person:
    """A standing person exactly as the body model has it."""
    fractions = {5: 0.81, 6: 0.81, 11: 0.522, 12: 0.522, 13: 0.285, 14: 0.285, 15: 0.061, 16: 0.061}
    keypoints = np.zeros((17, 3))
    for k, fraction in fractions.items():
        keypoints[k, :2] = CAMERA.pixels(np.array([[*xy_m, fraction * height_m]]))[0]
        keypoints[k, 2] = 0.6
    crown, floor = CAMERA.pixels(np.array([[*xy_m, 0.994 * height_m], [*xy_m, 0.0]]))
    return Person(keypoints, (floor[0] - 30, crown[1], floor[0] + 30, floor[1] + 5), 0.6)


def rescored(person: Person, scores: dict[int, float]) -> Person:
    keypoints = person.keypoints.copy()
    for k, score in scores.items():
        keypoints[k, 2] = score
    return replace(person, keypoints=keypoints)


places = st.tuples(st.floats(2.0, 3.6), st.floats(2.0, 3.6))


@given(places, st.floats(1.5, 1.95))
def test_feet_in_sight_say_where_somebody_stands(place: tuple[float, float], height_m: float) -> None:
    found = standing(person_at(place, height_m), PICTURE, CAMERA)
    assert isinstance(found, Standing)
    assert found.by_feet
    assert found.xy_m == pytest.approx(place, abs=0.04)


@given(places, st.floats(-2.5, 2.5))
def test_behind_furniture_the_trunk_and_the_usual_stature_do(
    place: tuple[float, float], sigmas: float
) -> None:
    height_m = 1.70 + 0.10 * sigmas
    seen, hidden = person_at(place, height_m), rescored(person_at(place, height_m), {15: 0.08, 16: 0.1})
    by_trunk, by_feet = standing(hidden, PICTURE, CAMERA), standing(seen, PICTURE, CAMERA)
    assert isinstance(by_trunk, Standing)
    assert isinstance(by_feet, Standing)
    assert not by_trunk.by_feet
    error = by_trunk.xy_m - place
    assert error @ np.linalg.solve(by_trunk.covariance_m2, error) < 9.0
    assert np.linalg.norm(error) < 0.3
    assert by_trunk.body is not None
    assert np.isinf(by_trunk.body.spread[ANKLES])


def test_feet_that_contradict_the_trunk_are_not_believed() -> None:
    person = person_at((2.5, 2.5))
    keypoints = person.keypoints.copy()
    keypoints[[15, 16], 1] -= 60  # ankles "found" on the edge of the sofa in front
    wrong = replace(person, keypoints=keypoints, box=(*person.box[:3], person.box[3] - 60))
    found = standing(wrong, PICTURE, CAMERA)
    assert isinstance(found, Standing)
    assert not found.by_feet
    assert found.xy_m == pytest.approx((2.5, 2.5), abs=0.2)


def test_feet_outside_the_picture_are_refused_though_the_trunk_is_seen() -> None:
    person = person_at((2.5, 2.5))
    cut = replace(person, box=(*person.box[:3], 478.0))
    assert standing(cut, PICTURE, CAMERA) == Refusal("feet cut off by the picture's lower edge")


def test_who_shows_neither_feet_nor_trunk_has_no_place() -> None:
    ghost = rescored(person_at((2.5, 2.5)), dict.fromkeys(range(17), 0.05))
    assert standing(ghost, PICTURE, CAMERA) == Refusal("no ankle seen")


def test_without_a_trunk_the_feet_are_enough_but_there_is_no_body() -> None:
    found = standing(rescored(person_at((2.5, 2.5)), {5: 0.05}), PICTURE, CAMERA)
    assert isinstance(found, Standing)
    assert found.by_feet
    assert found.body is None


def test_a_body_upside_down_is_none_and_a_crown_at_the_edge_is_not_used() -> None:
    person = person_at((2.5, 2.5))
    flipped = person.keypoints.copy()
    flipped[:, 1] = 480 - flipped[:, 1]
    assert body_of(replace(person, keypoints=flipped)) is None
    body = body_of(replace(person, box=(person.box[0], 1.0, *person.box[2:])))
    assert isinstance(body, Body)
    assert np.isinf(body.spread[CROWN])


def test_the_camera_takes_pixels_to_a_height_and_back() -> None:
    places_m = np.array([[2.0, 3.0, 0.9], [3.0, 2.0, 0.9]])
    assert CAMERA.at_height(CAMERA.pixels(places_m), 0.9) == pytest.approx(places_m[:, :2])
    assert np.isnan(CAMERA.at_height(np.array([[320.0, -500.0]]), 0.0)).all()
