"""The colours of shirt and trousers, from a picture with a person of known colours."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from vad.vision.clothes import MOST_UNLIKE, clothes, remembered, unlikeness
from vad.vision.people import Person


def person(scores: float = 0.6) -> Person:
    keypoints = np.zeros((17, 3))
    for k, xy in {
        5: (80, 60),
        6: (120, 60),
        11: (85, 120),
        12: (115, 120),
        13: (85, 170),
        14: (115, 170),
    }.items():
        keypoints[k] = *xy, scores
    return Person(keypoints, (70.0, 20.0, 130.0, 220.0), 0.6)


def picture(shirt: tuple[int, int, int], trousers: tuple[int, int, int]) -> np.ndarray:
    image = np.full((240, 200, 3), 200, np.uint8)
    cv2.rectangle(image, (75, 50), (125, 121), shirt, -1)
    cv2.rectangle(image, (75, 122), (125, 220), trousers, -1)
    return image


def test_shirt_and_trousers_have_their_own_colours() -> None:
    red, blue = (0, 0, 200), (150, 60, 20)
    seen = clothes(picture(red, blue), person())
    assert seen is not None
    wanted = cv2.cvtColor(np.array([[red, blue]], np.uint8), cv2.COLOR_BGR2LAB)[0].ravel()
    assert seen == pytest.approx(wanted, abs=1.0)


def test_the_same_person_is_like_themselves_and_another_is_not() -> None:
    red = clothes(picture((0, 0, 200), (150, 60, 20)), person())
    darker = clothes((picture((0, 0, 200), (150, 60, 20)) * 0.85).astype(np.uint8), person())
    black = clothes(picture((20, 20, 20), (15, 15, 15)), person())
    assert unlikeness(red, darker) < 4.0
    assert unlikeness(red, black) == MOST_UNLIKE


def test_who_is_not_seen_well_has_no_colours_and_fits_everybody() -> None:
    image = picture((0, 0, 200), (150, 60, 20))
    hidden = clothes(image, person(scores=0.1))
    assert hidden is None
    assert unlikeness(hidden, clothes(image, person())) == 0.0
    outside = person()
    outside.keypoints[:, 0] += 500
    assert clothes(image, outside) is None


def test_memory_follows_slowly() -> None:
    old, new = np.zeros(6), np.full(6, 100.0)
    assert remembered(None, new) is new
    assert remembered(old, None) is old
    known = remembered(old, new)
    assert known is not None
    assert 0.0 < known[0] < 50.0
