"""What somebody wears, as two colours: so that two who meet are told apart when they part again. Pure."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vad.vision.people import Image, Person

FloatArray = NDArray[np.float64]

_SHOULDERS, _HIPS, _KNEES = (5, 6), (11, 12), (13, 14)
_SCORE_MIN = 0.2
# The same person's colours change this much from picture to picture (light, folds, the other side), in
# OpenCV's 8-bit Lab; lightness more than hue.
_SIGMA = np.array([20.0, 9.0, 9.0, 20.0, 9.0, 9.0])
# However unlike they look, it may be the light: no colours speak louder than this.
MOST_UNLIKE = 8.0
_FOLLOW = 0.04


def clothes(image: Image, person: Person) -> FloatArray | None:
    """(6,): Lab of the shirt and of the trousers, the median over the trunk's and the thighs' middle; None
    where those are not seen. image: (height, width, 3) uint8 BGR that the person was found in."""
    points = person.keypoints
    if points[[*_SHOULDERS, *_HIPS, *_KNEES], 2].min() < _SCORE_MIN:
        return None
    shoulders, hips, knees = (points[list(pair), :2] for pair in (_SHOULDERS, _HIPS, _KNEES))
    shirt = _grid(shoulders, hips, np.linspace(0.2, 0.8, 5))
    trousers = _grid(hips, knees, np.array([0.0, 1.0]))
    height, width = image.shape[:2]
    found = []
    for spots in (shirt, trousers):
        at = np.rint(spots).astype(np.int64)
        inside = (at >= 0).all(axis=1) & (at[:, 0] < width) & (at[:, 1] < height)
        if not inside.any():
            return None
        colours = image[at[inside, 1], at[inside, 0]][None]
        found.append(np.median(cv2.cvtColor(colours, cv2.COLOR_BGR2LAB)[0], axis=0))
    return np.concatenate(found).astype(np.float64)


def _grid(above: FloatArray, below: FloatArray, across: FloatArray) -> FloatArray:
    """Spots (N, 2) between two points above (2, 2) and two below; across: shares from first to second."""
    down = np.linspace(0.15, 0.85, 8)
    upper = above[0] + across[:, None] * (above[1] - above[0])
    lower = below[0] + across[:, None] * (below[1] - below[0])
    spots = upper[:, None] + down[None, :, None] * (lower - upper)[:, None]
    return np.asarray(spots.reshape(-1, 2), dtype=np.float64)


def unlikeness(known: FloatArray | None, seen: FloatArray | None) -> float:
    """How little two sets of colours agree, as a squared distance; 0 where one is not known."""
    if known is None or seen is None:
        return 0.0
    return min(float(np.sum(((seen - known) / _SIGMA) ** 2)) / 2.0, MOST_UNLIKE)


def remembered(known: FloatArray | None, seen: FloatArray | None) -> FloatArray | None:
    """What is known of somebody's colours after they were seen once more."""
    if known is None or seen is None:
        return seen if known is None else known
    return known + _FOLLOW * (seen - known)
