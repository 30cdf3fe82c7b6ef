"""Where the robot may be in a picture, without a trained detector: what moves and is shaped like a low disc.

Several candidates a frame; which of them is the robot, and whether any is, the consensus with the robot's own
poses says (formats.md 11, vad.mapping.camera_stage).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

# Robot vacuums are 0.32-0.36 m across and 0.08-0.11 m high.
HEIGHT_PER_DIAMETER = 0.28
MAX_CANDIDATES = 6

_WORK_WIDTH_PX = 320
_HISTORY_FRAMES = 400
_VARIANCE_THRESHOLD = 20.0
_FOREGROUND = 255
# More of the picture than this changes at once when a lamp is switched or the camera is moved.
_MAX_CHANGED = 0.35
_RELEARN_RATE = 0.2
_MIN_AREA_WORK_PX = 30
_MIN_FILL = 0.5
_MIN_ASPECT, _MAX_ASPECT = 0.2, 1.5
_MAX_WIDTH_PER_PICTURE = 0.4
_PERSON_MARGIN = 0.1
# Spread of the contact point: the picture's grid, and what shadow and colour do to a blob's outline.
_SIGMA_GRID_PX = 1.0
_SIGMA_PER_WIDTH = 0.04

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RobotCandidate:
    """Something that moves and may be the robot.

    x_px, y_px: the middle of its contact with the floor, raw pixels; sigma_px: 1 standard deviation per axis;
    box: (x0, y0, x1, y1) of the blob, raw pixels; from_box: the contact follows from the box alone, with a
    usual height of the robot.
    """

    x_px: float
    y_px: float
    sigma_px: float
    box: tuple[float, float, float, float]
    from_box: bool = True


class CandidateFinder(Protocol):
    """What names places in a picture where the robot may be: by motion, or by a trained network."""

    def update(self, image: NDArray[np.uint8], people_boxes: FloatArray) -> list[RobotCandidate]:
        """Candidates of the next frame, best first; in people's boxes (N, 4) are none."""
        ...


class RobotFinder:
    """Background subtraction, blobs and the contact of a disc; one object per camera, every frame in turn."""

    def __init__(self) -> None:
        self._background = cv2.createBackgroundSubtractorMOG2(
            history=_HISTORY_FRAMES, varThreshold=_VARIANCE_THRESHOLD, detectShadows=True
        )
        self._opening = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
        self._closing = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
        self._size: tuple[int, int] | None = None
        self._rate = -1.0

    def update(self, image: NDArray[np.uint8], people_boxes: FloatArray) -> list[RobotCandidate]:
        """Candidates of the next frame, the largest first.

        Args:
            image: (height, width, 3) uint8 BGR. people_boxes: (N, 4) x0, y0, x1, y1 in raw pixels; what moves
                there is people and no candidate.
        """
        height, width = image.shape[:2]
        scale = max(1.0, width / _WORK_WIDTH_PX)
        size = (round(width / scale), round(height / scale))
        if size != self._size:
            # Another picture size is another background; the model restarts with its first frame.
            self._size, self._rate = size, 1.0
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if scale > 1.0 else image
        changed = self._background.apply(small, learningRate=self._rate)
        # Shadows have a value of their own and are left out.
        moving = np.asarray(changed == _FOREGROUND, dtype=np.uint8)
        if float(moving.mean()) > _MAX_CHANGED:
            self._rate = _RELEARN_RATE
            return []
        self._rate = -1.0
        moving = np.asarray(cv2.morphologyEx(moving, cv2.MORPH_OPEN, self._opening), dtype=np.uint8)
        moving = np.asarray(cv2.morphologyEx(moving, cv2.MORPH_CLOSE, self._closing), dtype=np.uint8)
        return _candidates(moving, scale, np.asarray(people_boxes, dtype=np.float64).reshape(-1, 4))


def disc_contact(x0: float, y0: float, x1: float, y1: float) -> tuple[float, float]:
    """The floor point under the middle of a low disc from its box, pixels (formats.md 11).

    A disc seen at the angle theta above the floor is as high as sin(theta) of its width, and its side adds
    cos(theta) of its height; the contact's middle lies width / 2 * sin(theta) above the box's bottom.
    """
    width = x1 - x0
    ratio = (y1 - y0) / width
    tilt = np.arctan(HEIGHT_PER_DIAMETER)
    theta = np.arcsin(min(1.0, ratio / np.hypot(1.0, HEIGHT_PER_DIAMETER))) - tilt
    # Past the sum's maximum the height falls again: seen from above a disc is as high as wide.
    sine = 1.0 if ratio >= np.hypot(1.0, HEIGHT_PER_DIAMETER) else max(0.0, float(np.sin(theta)))
    return 0.5 * (x0 + x1), y1 - 0.5 * width * sine


def _candidates(moving: NDArray[np.uint8], scale: float, people: FloatArray) -> list[RobotCandidate]:
    rows, columns = moving.shape
    count, _, stats, _ = cv2.connectedComponentsWithStats(moving, connectivity=8)
    found: list[tuple[int, RobotCandidate]] = []
    for x, y, w, h, area in stats[1:count].tolist():
        cut = x == 0 or y == 0 or x + w == columns or y + h == rows
        shaped = _MIN_ASPECT <= h / w <= _MAX_ASPECT and area >= _MIN_FILL * w * h
        if cut or not shaped or area < _MIN_AREA_WORK_PX or w > _MAX_WIDTH_PER_PICTURE * columns:
            continue
        # From pixel indices to coordinates: a pixel's middle is its coordinate.
        box = (x * scale - 0.5, y * scale - 0.5, (x + w) * scale - 0.5, (y + h) * scale - 0.5)
        if touches_people(box, people):
            continue
        x_px, y_px = disc_contact(*box)
        sigma_px = _SIGMA_GRID_PX * scale / 2.0 + _SIGMA_PER_WIDTH * w * scale
        found.append((area, RobotCandidate(x_px, y_px, sigma_px, box)))
    found.sort(key=lambda pair: -pair[0])
    return [candidate for _, candidate in found[:MAX_CANDIDATES]]


def touches_people(box: tuple[float, float, float, float], people: FloatArray) -> bool:
    """Whether a box (x0, y0, x1, y1) lies in, or reaches into, a person's box with a margin."""
    if not len(people):
        return False
    margin = _PERSON_MARGIN * np.maximum(people[:, 2:] - people[:, :2], 0.0)
    low, high = people[:, :2] - margin, people[:, 2:] + margin
    x0, y0, x1, y1 = box
    apart = (high[:, 0] < x0) | (low[:, 0] > x1) | (high[:, 1] < y0) | (low[:, 1] > y1)
    return bool(np.any(~apart))
