"""People in a picture: a pose network through ONNX Runtime (MoveNet MultiPose by default, formats.md 10)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray
from onnxruntime.capi import onnxruntime_pybind11_state as ort_errors

from vad.errors import VadError
from vad.vision.pose_format import KEYPOINTS, check_size, overlap, recognise

FloatArray = NDArray[np.float64]
Image = NDArray[np.uint8]
Box = tuple[float, float, float, float]

MODEL_PATH = Path(__file__).parent / "models" / "movenet-multipose.onnx"
LEFT_ANKLE, RIGHT_ANKLE = 15, 16
# The network's scores are low (formats.md 10): above 0.3 most real people are lost.
PERSON_SCORE_MIN = 0.15
_TRUNK = (5, 6, 11, 12)
# Two findings whose trunks are nearer to each other than this share of the box's height are one person.
_SAME_TRUNK = 0.08

# Motion is sought in a picture this many times smaller, where a pixel's noise is averaged away.
_GATE_CELL_PX = 8
_GATE_LEVELS = 5.0
_GATE_CELLS = 2
# How fast the reference follows the picture, per frame: slow enough for a slow walker to stand out.
_GATE_FOLLOW = 0.15

# Where a person is known to be, a piece of the picture is looked at: this much of it is the person, and of
# the findings in it the one that overlaps the known box most is that person.
_FILL_HIGH, _FILL_WIDE = 0.7, 0.9
SAME_IOU = 0.3
_KNOWN_SCORE_MIN = 0.11


@dataclass(frozen=True, slots=True)
class Person:
    """One person in a picture, in the picture's own pixels (x right, y down, of the picture given).

    keypoints: (17, 3) of x_px, y_px, score in COCO's order (15 left ankle, 16 right ankle);
    box: x0, y0, x1, y1 in px; score: the network's, 0..1. A pixel's middle is its coordinate.
    """

    keypoints: FloatArray
    box: Box
    score: float


class PoseNetwork:
    """Pictures in, up to six people out. Not thread-safe; `infer` blocks for 10-45 ms."""

    def __init__(
        self, model_path: Path | None = None, input_size: tuple[int, int] = (288, 384), threads: int = 1
    ) -> None:
        """input_size: height and width of the network's input, each a multiple of 32, if it takes any.

        Raises:
            VadError: no model file there, one that ONNX Runtime refuses, one of a kind that is not known
                (vad.vision.pose_format), or an impossible input size.
        """
        path = model_path or MODEL_PATH
        check_size(input_size)
        if not path.is_file():
            raise VadError(
                what="the pose network's file is missing",
                where=str(path),
                remedy="reinstall vad, or give the path of a MoveNet or YOLO-pose ONNX file",
            )
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            self._session = onnxruntime.InferenceSession(
                str(path), sess_options=options, providers=["CPUExecutionProvider"]
            )
        except (ort_errors.Fail, ort_errors.InvalidGraph, ort_errors.InvalidProtobuf) as error:
            raise VadError(
                what=f"the pose network cannot be loaded: {error}",
                where=str(path),
                remedy="give the path of a MoveNet or YOLO-pose ONNX file",
            ) from error
        given, gives = self._session.get_inputs()[0], self._session.get_outputs()[0]
        self._format = recognise(given.shape, given.type, gives.shape, str(path))
        self._input_name, self._output_name = given.name, gives.name
        self._size = self._format.fixed_size or input_size

    @property
    def takes_any_size(self) -> bool:
        """Whether a piece of the picture may be given in a smaller size, which is faster."""
        return self._format.fixed_size is None

    def infer(self, image_bgr: Image, score_min: float = PERSON_SCORE_MIN) -> list[Person]:
        """The people in (height, width, 3) uint8 BGR, best first, those with at least `score_min`."""
        height, width = image_bgr.shape[:2]
        scale = min(self._size[1] / width, self._size[0] / height)
        found = self._look(image_bgr, self._size, scale, ((width - 1) / 2.0, (height - 1) / 2.0))
        return distinct([person for person in found if person.score >= score_min])

    def follow(self, image_bgr: Image, box: Box, size: tuple[int, int] = (256, 192)) -> Person | None:
        """The person who was in `box` a moment ago, from that part of the picture alone; None if not found.

        size: height and width of the network's input for it; another is taken if the network has but one.
        """
        size = size if self.takes_any_size else self._size
        x0, y0, x1, y1 = box
        high, wide = max(y1 - y0, 1.0), max(x1 - x0, 1.0)
        scale = min(_FILL_HIGH * size[0] / high, _FILL_WIDE * size[1] / wide)
        found = self._look(image_bgr, size, scale, ((x0 + x1) / 2.0, (y0 + y1) / 2.0))
        found = [person for person in found if person.score >= _KNOWN_SCORE_MIN]
        if not found:
            return None
        same = overlap(np.array(box), np.array([person.box for person in found]))
        best = int(np.argmax(same))
        return found[best] if same[best] >= SAME_IOU else None

    def _look(
        self, image_bgr: Image, size: tuple[int, int], scale: float, centre_px: tuple[float, float]
    ) -> list[Person]:
        """All the network finds round a point of the picture, which comes to lie in the input's middle.

        scale: input pixels per picture pixel.
        """
        canvas = np.zeros((*size, 3), np.uint8)
        x = _Axis.place(image_bgr.shape[1], size[1], scale, centre_px[0])
        y = _Axis.place(image_bgr.shape[0], size[0], scale, centre_px[1])
        if x.length and y.length:
            piece = image_bgr[y.first : y.last, x.first : x.last]
            small = cv2.resize(piece, (x.length, y.length), interpolation=cv2.INTER_AREA)
            canvas[y.start : y.start + y.length, x.start : x.start + x.length] = small[:, :, ::-1]
        (output,) = self._session.run([self._output_name], {self._input_name: self._format.tensor(canvas)})
        rows = self._format.people(np.asarray(output, dtype=np.float64), size)
        return [_person(row, x, y) for row in rows]


@dataclass(frozen=True, slots=True)
class _Axis:
    """A piece of the picture in the network's input, along one axis: picture pixels [first, last) fill
    `length` input pixels from `start` on. Each axis has its own factor: rounding to whole pixels bends the
    aspect a little."""

    first: int
    last: int
    start: int
    length: int

    @classmethod
    def place(cls, picture: int, side: int, scale: float, centre_px: float) -> _Axis:
        half = side / (2.0 * scale)
        first = int(np.clip(round(centre_px + 0.5 - half), 0, picture))
        last = int(np.clip(round(centre_px + 0.5 + half), 0, picture))
        length = min(round((last - first) * scale), side)
        start = round(side / 2.0 + (first - centre_px - 0.5) * scale)
        return cls(first, last, int(np.clip(start, 0, side - length)), length)

    def __call__(self, input_px: FloatArray) -> FloatArray:
        """Input pixels as picture pixels; in both a pixel's middle is its coordinate."""
        factor = (self.last - self.first) / max(self.length, 1)
        return (input_px + 0.5 - self.start) * factor + self.first - 0.5


def _person(row: FloatArray, x_px: _Axis, y_px: _Axis) -> Person:
    points = row[: 3 * KEYPOINTS].reshape(KEYPOINTS, 3)
    keypoints = np.column_stack([x_px(points[:, 0]), y_px(points[:, 1]), points[:, 2]])
    x0, y0, x1, y1 = row[3 * KEYPOINTS : 3 * KEYPOINTS + 4]
    corners_x, corners_y = x_px(np.array([x0, x1])), y_px(np.array([y0, y1]))
    box = (float(corners_x[0]), float(corners_y[0]), float(corners_x[1]), float(corners_y[1]))
    return Person(keypoints, box, float(row[-1]))


def distinct(people: list[Person]) -> list[Person]:
    """The people, best first, each once: the network now and then finds one of them twice."""
    chosen: list[Person] = []
    for person in sorted(people, key=lambda one: -one.score):
        trunk = person.keypoints[list(_TRUNK), :2].mean(axis=0)
        near = _SAME_TRUNK * (person.box[3] - person.box[1])
        others = (other.keypoints[list(_TRUNK), :2].mean(axis=0) for other in chosen)
        if all(float(np.linalg.norm(trunk - other)) > near for other in others):
            chosen.append(person)
    return chosen


class MotionGate:
    """Whether anything moves in a stream of pictures, so that the network rests while nothing does.

    Compares a small grey copy with one that follows it slowly; a change of the whole picture's brightness
    is no motion. Stays open for `hold_frames` after the last motion: who stands still is still there.
    """

    def __init__(self, hold_frames: int = 30) -> None:
        self._hold_frames = hold_frames
        self._open_for = 0
        self._reference: NDArray[np.float32] | None = None

    def update(self, image: Image) -> bool:
        """Take the next picture, (height, width, 3) uint8; True while it is worth looking for people."""
        height, width = image.shape[:2]
        size = (max(1, width // _GATE_CELL_PX), max(1, height // _GATE_CELL_PX))
        grey = cv2.cvtColor(cv2.resize(image, size, interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2GRAY)
        small = grey.astype(np.float32)
        if self._reference is None or self._reference.shape != small.shape:
            self._reference = small
            self._open_for = self._hold_frames
            return True
        gain = float(small.mean()) / max(float(self._reference.mean()), 1.0)
        difference = np.abs(small - self._reference * gain)
        self._reference += _GATE_FOLLOW * (small - self._reference)
        if np.count_nonzero(difference > _GATE_LEVELS) >= _GATE_CELLS:
            self._open_for = self._hold_frames
        else:
            self._open_for = max(0, self._open_for - 1)
        return self._open_for > 0
