"""What detection networks put out -> boxes in the picture: our heat map, YOLOv5, YOLOv8, YOLOX. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Family = Literal["yolov5", "yolov8", "yolox", "nms"]

_STRIDES = (8, 16, 32)
_ANCHORS = 3
HEAT_CHANNELS = 7
"""Heat 0..1; in input pixels: the box's middle x and y, its width and height, the floor contact's x and y."""
_NMS_VALUES = 6


@dataclass(frozen=True, slots=True)
class Detections:
    """Best first. boxes: (N, 4) x0, y0, x1, y1 in pixels; scores: (N,) 0..1; contacts: (N, 2) x, y of the
    floor under the robot's middle, from networks that tell it."""

    boxes: FloatArray
    scores: FloatArray
    contacts: FloatArray | None = None

    def only(self, rows: list[int] | NDArray[np.int64]) -> Detections:
        """These rows, in this order."""
        contacts = None if self.contacts is None else self.contacts[rows]
        return Detections(self.boxes[rows], self.scores[rows], contacts)


@dataclass(frozen=True, slots=True)
class Layout:
    """How to read a YOLO output. classes: how many, 0 where the output does not tell; size: height and width
    of the input, px. `nms`: exported with its suppression in it."""

    family: Family
    classes: int
    size: tuple[int, int]


@dataclass(frozen=True, slots=True)
class Letterbox:
    """From the picture to the network's input: times scale_x, scale_y, plus left, top; pixel edges count.

    scale_y is scale_x where it is left out.
    """

    scale_x: float
    left: float
    top: float
    scale_y: float | None = None

    def undo(self, found: Detections, width: int, height: int) -> Detections:
        """Input pixels -> the picture's pixels, cut at its edges."""
        scale_y = self.scale_x if self.scale_y is None else self.scale_y
        scale = np.array([self.scale_x, scale_y] * 2)
        # Boxes count pixel edges from 0; the picture's pixels have their middles at whole numbers.
        boxes = (found.boxes - np.array([self.left, self.top] * 2)) / scale - 0.5
        limit = np.array([width, height] * 2) - 0.5
        contacts = found.contacts
        if contacts is not None:
            contacts = (contacts - np.array([self.left, self.top])) / scale[:2] - 0.5
        return Detections(np.clip(boxes, -0.5, limit), found.scores, contacts)


def layout_of(shape: tuple[int, ...], size: tuple[int, int]) -> Layout | None:
    """Which family puts out `shape` for an input of `size` (height, width); None where none does.

    YOLOv8: (1, 4 + classes, cells). YOLOv5: (1, 3 cells, 5 + classes). YOLOX: (1, cells, 5 + classes). With
    suppression: (1, most, 6), corners, score, class.
    """
    if len(shape) != 3 or shape[0] != 1:
        return None
    cells = sum((size[0] // s) * (size[1] // s) for s in _STRIDES)
    _, rows, columns = shape
    if columns == cells and rows > 4:
        return Layout("yolov8", rows - 4, size)
    if rows == cells and columns > 5:
        return Layout("yolox", columns - 5, size)
    if rows == _ANCHORS * cells and columns > 5:
        return Layout("yolov5", columns - 5, size)
    if columns == _NMS_VALUES:
        return Layout("nms", 0, size)
    return None


def read_heat(output: NDArray[np.float32], threshold: float) -> Detections:
    """Our own network's output (1, 7, rows, columns), see `HEAT_CHANNELS`, as boxes and contacts in the
    input's pixels, edges counted.

    A peak is a cell that none of its eight neighbours exceeds.
    """
    heat = output[0, 0].astype(np.float64)
    rows, columns = heat.shape
    around = np.full((rows + 2, columns + 2), -np.inf)
    around[1:-1, 1:-1] = heat
    neighbours = np.max(
        [around[i : i + rows, j : j + columns] for i in range(3) for j in range(3) if (i, j) != (1, 1)],
        axis=0,
    )
    i, j = np.nonzero((heat >= threshold) & (heat >= neighbours))
    x, y, width, height, floor_x, floor_y = output[0, 1:, i, j].astype(np.float64).T
    # The network counts pixel middles.
    boxes = np.column_stack([x - width / 2, y - height / 2, x + width / 2, y + height / 2]) + 0.5
    contacts = np.column_stack([floor_x, floor_y]) + 0.5
    return _sorted(boxes, heat[i, j], contacts)


def read_yolo(output: NDArray[np.float32], layout: Layout, number: int, threshold: float) -> Detections:
    """A YOLO output as boxes of the class `number`, in the input's pixels."""
    rows = output[0].T if layout.family == "yolov8" else output[0]
    rows = rows.astype(np.float64)
    if layout.family == "nms":
        ours = np.isfinite(rows).all(axis=1) & (rows[:, 4] >= threshold) & (rows[:, 5] == number)
        return _sorted(rows[ours, :4], rows[ours, 4])
    scores = rows[:, 4 + number] if layout.family == "yolov8" else rows[:, 4] * rows[:, 5 + number]
    keep = np.isfinite(rows[:, :4]).all(axis=1) & (scores >= threshold)
    places = rows[:, :4]
    if layout.family == "yolox" and _is_raw(places):
        places = _decode_yolox(places, layout.size)
    x, y, width, height = places[keep].T
    boxes = np.column_stack([x - width / 2, y - height / 2, x + width / 2, y + height / 2])
    return _sorted(boxes, scores[keep])


def suppress(found: Detections, overlap: float) -> Detections:
    """Of boxes that share more than `overlap` of their union only the best; also of one inside another."""
    kept: list[int] = []
    boxes = found.boxes
    area = np.prod(np.maximum(boxes[:, 2:] - boxes[:, :2], 0.0), axis=1)
    for k in range(len(boxes)):
        if kept:
            others = boxes[kept]
            corner = np.minimum(boxes[k, 2:], others[:, 2:]) - np.maximum(boxes[k, :2], others[:, :2])
            shared = np.prod(np.maximum(corner, 0.0), axis=1)
            union = area[k] + area[kept] - shared
            inside = shared / np.maximum(np.minimum(area[k], area[kept]), 1e-9)
            if np.any((shared > overlap * union) | (inside > 0.8)):
                continue
        kept.append(k)
    return found.only(kept)


def _sorted(boxes: FloatArray, scores: FloatArray, contacts: FloatArray | None = None) -> Detections:
    order = np.argsort(-scores, kind="stable")
    return Detections(boxes.reshape(-1, 4), scores, contacts).only(order)


def _is_raw(places: FloatArray) -> bool:
    """Whether YOLOX left its boxes in cells and logarithms: decoded widths are never below zero."""
    return bool((places[:, 2:] < 0.0).any())


def _decode_yolox(places: FloatArray, size: tuple[int, int]) -> FloatArray:
    grid, step = [], []
    for stride in _STRIDES:
        y, x = np.mgrid[0 : size[0] // stride, 0 : size[1] // stride]
        grid.append(np.column_stack([x.ravel(), y.ravel()]))
        step.append(np.full((x.size, 1), float(stride)))
    cells, strides = np.vstack(grid), np.vstack(step)
    return np.hstack([(places[:, :2] + cells) * strides, np.exp(np.clip(places[:, 2:], -20, 20)) * strides])
