"""What a pose network wants and gives, told by the shapes of its inputs and outputs. Pure: arrays in and out.

Known: MoveNet MultiPose (NHWC, output [1, 6, 56]) and SinglePose (NHWC, [1, 1, 17, 3]), and Ultralytics'
YOLO-pose exports (NCHW, RGB 0..1; [1, 56, N], or [1, N, 57] from those that suppress doubles themselves),
each with COCO's 17 keypoints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vad.errors import VadError

FloatArray = NDArray[np.float64]

KEYPOINTS = 17
ROW = 3 * KEYPOINTS + 5
"""Values of a decoded person: 17 x (x, y, score), x0, y0, x1, y1, score."""

Family = Literal["movenet-multi", "movenet-single", "yolo", "yolo-distinct"]

_DTYPES: dict[str, type[np.generic]] = {
    "tensor(int32)": np.int32,
    "tensor(uint8)": np.uint8,
    "tensor(float)": np.float32,
}
_SIDE_MULTIPLE = 32
# A YOLO calls a keypoint seen above 0.5 and a person found above 0.25, MoveNet at 0.2 and 0.15.
_YOLO_KEYPOINT, _YOLO_PERSON = 0.4, 0.6
_YOLO_SAME_IOU = 0.65
_MAX_PEOPLE = 6
# A body's outline beyond its eyes and ankles, in shares of the distance between them.
_ABOVE_EYES, _BELOW_ANKLES = 0.07, 0.05
_SEEN = 0.2


@dataclass(frozen=True, slots=True)
class PoseFormat:
    """One network's input and output. fixed_size: (height, width) where the network takes no other."""

    family: Family
    dtype: type[np.generic]
    fixed_size: tuple[int, int] | None

    def tensor(self, canvas_rgb: NDArray[np.uint8]) -> NDArray[np.generic]:
        """The network's input from a picture (height, width, 3) uint8 RGB of its size."""
        if self.family in ("movenet-multi", "movenet-single"):
            return canvas_rgb[None].astype(self.dtype)
        planes = canvas_rgb.transpose(2, 0, 1)[None].astype(self.dtype)
        return np.ascontiguousarray(planes / np.asarray(255, dtype=self.dtype))

    def people(self, output: FloatArray, size: tuple[int, int]) -> FloatArray:
        """The output as (M, ROW), best first, in pixels of the input of `size` (height, width).

        A pixel's middle is its coordinate. M is 6 at most; boxes that mean the same person are one.
        """
        if self.family == "movenet-multi":
            rows = _multi(output, size)
        elif self.family == "movenet-single":
            rows = _single(output, size)
        else:
            rows = _yolo(output, distinct=self.family == "yolo-distinct")
        return rows[np.argsort(-rows[:, -1], kind="stable")][:_MAX_PEOPLE]


def recognise(
    input_shape: Sequence[object], input_type: str, output_shape: Sequence[object], where: str
) -> PoseFormat:
    """The format of a network from its first input and output as ONNX Runtime describes them.

    Raises:
        VadError: a network of another kind.
    """
    dtype = _DTYPES.get(input_type)
    channels_last, channels_first = _is(input_shape, 4, 3, 3), _is(input_shape, 4, 1, 3)
    family: Family | None = None
    if dtype is not None and channels_last:
        if len(output_shape) == 3 and output_shape[2] == ROW:
            family = "movenet-multi"
        elif list(output_shape)[1:] == [1, KEYPOINTS, 3]:
            family = "movenet-single"
    elif dtype is np.float32 and channels_first and len(output_shape) == 3:
        if output_shape[1] == ROW:
            family = "yolo"
        elif output_shape[2] == ROW + 1:
            family = "yolo-distinct"
    if family is None or dtype is None:
        raise VadError(
            what=f"no pose network known here: {input_type} {list(input_shape)} -> {list(output_shape)}",
            where=where,
            remedy="give a MoveNet (MultiPose, SinglePose) or a YOLO-pose network with COCO's 17 keypoints",
        )
    height, width = input_shape[1:3] if channels_last else input_shape[2:4]
    if isinstance(height, int) and isinstance(width, int) and height > 0 and width > 0:
        return PoseFormat(family, dtype, (height, width))
    return PoseFormat(family, dtype, None)


def check_size(size: tuple[int, int]) -> None:
    """VadError unless both sides are positive multiples of 32."""
    if any(side <= 0 or side % _SIDE_MULTIPLE for side in size):
        raise VadError(
            what=f"the pose network's input {size[0]}x{size[1]} is not usable",
            where="the pose network's input size",
            remedy=f"take sides that are multiples of {_SIDE_MULTIPLE}, such as 288x384",
        )


def _is(shape: Sequence[object], length: int, axis: int, value: int) -> bool:
    return len(shape) == length and shape[axis] == value


def _multi(output: FloatArray, size: tuple[int, int]) -> FloatArray:
    """17 x (y, x, score), y0, x0, y1, x1, score; relative. It counts pixels' middles as whole numbers."""
    given = output.reshape(-1, ROW)
    rows = given.copy()
    height, width = size
    rows[:, 0:51:3], rows[:, 1:51:3] = given[:, 1:51:3] * width, given[:, 0:51:3] * height
    rows[:, 51:55] = given[:, [52, 51, 54, 53]] * (width, height, width, height)
    return rows


def _single(output: FloatArray, size: tuple[int, int]) -> FloatArray:
    """17 x (y, x, score) of one person, who is as sure as the keypoints are in the mean."""
    points = output.reshape(KEYPOINTS, 3)
    height, width = size
    x, y, score = points[:, 1] * width, points[:, 0] * height, points[:, 2]
    seen = score >= _SEEN
    if not seen.any():
        return np.empty((0, ROW))
    tall = float(np.ptp(y[seen]))
    box = (
        x[seen].min(),
        y[seen].min() - _ABOVE_EYES * tall,
        x[seen].max(),
        y[seen].max() + _BELOW_ANKLES * tall,
    )
    return np.concatenate([np.column_stack([x, y, score]).ravel(), box, [score.mean()]])[None]


def _yolo(output: FloatArray, *, distinct: bool) -> FloatArray:
    """Pixels, edges at whole numbers. A box: corners, score, class if distinct, else middle, size, score."""
    if distinct:
        given = output.reshape(-1, ROW + 1)
        boxes, scores, points = given[:, :4], given[:, 4], given[:, 6:]
    else:
        given = output.reshape(ROW, -1).T
        centre, half = given[:, :2], given[:, 2:4] / 2.0
        boxes, scores, points = np.hstack([centre - half, centre + half]), given[:, 4], given[:, 5:]
    rows = np.empty((len(given), ROW))
    rows[:, 0:51:3], rows[:, 1:51:3] = points[:, 0::3] - 0.5, points[:, 1::3] - 0.5
    rows[:, 2:51:3] = points[:, 2::3] * _YOLO_KEYPOINT
    rows[:, 51:55], rows[:, 55] = boxes - 0.5, scores * _YOLO_PERSON
    return rows if distinct else _distinct(rows)


def _distinct(rows: FloatArray) -> FloatArray:
    """Of boxes that overlap much only the surest, 6 at most."""
    left = rows[np.argsort(-rows[:, 55])]
    left = left[left[:, 55] > 0.0][:300]
    chosen: list[FloatArray] = []
    while len(left) and len(chosen) < _MAX_PEOPLE:
        best, left = left[0], left[1:]
        chosen.append(best)
        left = left[overlap(best[51:55], left[:, 51:55]) < _YOLO_SAME_IOU]
    return np.array(chosen).reshape(-1, ROW)


def overlap(box: FloatArray, boxes: FloatArray) -> FloatArray:
    """Intersection over union of one box (4,) x0, y0, x1, y1 with each of (N, 4)."""
    low, high = np.maximum(box[:2], boxes[:, :2]), np.minimum(box[2:], boxes[:, 2:])
    common = np.prod(np.maximum(high - low, 0.0), axis=1)
    areas = np.prod(boxes[:, 2:] - boxes[:, :2], axis=1) + np.prod(box[2:] - box[:2])
    return np.asarray(common / np.maximum(areas - common, 1e-9), dtype=np.float64)
