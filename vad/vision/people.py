"""People in a picture: MoveNet MultiPose Lightning through ONNX Runtime (formats.md 10), gated by motion."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray
from onnxruntime.capi import onnxruntime_pybind11_state as ort_errors

from vad.errors import VadError

FloatArray = NDArray[np.float64]
Image = NDArray[np.uint8]

MODEL_PATH = Path(__file__).parent / "models" / "movenet-multipose.onnx"
LEFT_ANKLE, RIGHT_ANKLE = 15, 16
# The network's scores are low (formats.md 10): above 0.3 most real people are lost.
PERSON_SCORE_MIN = 0.15
_SIDE_MULTIPLE = 32
_KEYPOINTS = 17
_PERSON_VALUES = 3 * _KEYPOINTS + 5

# Motion is sought in a picture this many times smaller, where a pixel's noise is averaged away.
_GATE_CELL_PX = 8
_GATE_LEVELS = 5.0
_GATE_CELLS = 2
# How fast the reference follows the picture, per frame: slow enough for a slow walker to stand out.
_GATE_FOLLOW = 0.15


@dataclass(frozen=True, slots=True)
class Person:
    """One person in a picture, in the picture's own pixels (x right, y down, of the picture given).

    keypoints: (17, 3) of x_px, y_px, score in COCO's order (15 left ankle, 16 right ankle);
    box: x0, y0, x1, y1 in px; score: the network's, 0..1.
    """

    keypoints: FloatArray
    box: tuple[float, float, float, float]
    score: float


class PoseNetwork:
    """MoveNet MultiPose: pictures in, up to six people out. Not thread-safe; `infer` blocks for 25-45 ms."""

    def __init__(
        self, model_path: Path | None = None, input_size: tuple[int, int] = (288, 384), threads: int = 1
    ) -> None:
        """input_size: height and width of the network's input, each a multiple of 32.

        Raises:
            VadError: no model file there, one that ONNX Runtime refuses, or an impossible input size.
        """
        path = model_path or MODEL_PATH
        if any(side <= 0 or side % _SIDE_MULTIPLE for side in input_size):
            raise VadError(
                what=f"the pose network's input {input_size[0]}x{input_size[1]} is not usable",
                where="vision.input_size",
                remedy=f"take sides that are multiples of {_SIDE_MULTIPLE}, such as 288x384",
            )
        if not path.is_file():
            raise VadError(
                what="the pose network's file is missing",
                where=str(path),
                remedy="reinstall vad, or give the path of a MoveNet MultiPose ONNX file",
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
                remedy="give the path of a MoveNet MultiPose ONNX file",
            ) from error
        self._input_name = self._session.get_inputs()[0].name
        self._height, self._width = input_size
        self._canvas = np.zeros((1, self._height, self._width, 3), np.int32)
        self._shape: tuple[int, int] | None = None

    def infer(self, image_bgr: Image, score_min: float = PERSON_SCORE_MIN) -> list[Person]:
        """The people in (height, width, 3) uint8 BGR, best first, those with at least `score_min`."""
        height, width = image_bgr.shape[:2]
        scale = min(self._width / width, self._height / height)
        inner_w, inner_h = round(width * scale), round(height * scale)
        left, top = (self._width - inner_w) // 2, (self._height - inner_h) // 2
        if self._shape != (height, width):
            self._canvas[:] = 0
            self._shape = (height, width)
        small = cv2.resize(image_bgr, (inner_w, inner_h), interpolation=cv2.INTER_AREA)
        self._canvas[0, top : top + inner_h, left : left + inner_w] = small[:, :, ::-1]
        (output,) = self._session.run(None, {self._input_name: self._canvas})
        rows = np.asarray(output, dtype=np.float64).reshape(-1, _PERSON_VALUES)
        rows = rows[rows[:, -1] >= score_min]
        # Each axis has its own factor: rounding the inner picture to whole pixels bends the aspect a little.
        x_px = _Axis(self._width, left, width / inner_w)
        y_px = _Axis(self._height, top, height / inner_h)
        return [_person(row, x_px, y_px) for row in rows[np.argsort(-rows[:, -1])]]


@dataclass(frozen=True, slots=True)
class _Axis:
    """From the network's relative coordinate to the picture's pixels, along one axis.

    The network counts its input's pixel centres as whole numbers: half of one is added (seen in renders).
    """

    side: int
    offset: int
    factor: float

    def __call__(self, relative: FloatArray) -> FloatArray:
        return (relative * self.side + 0.5 - self.offset) * self.factor


def _person(row: FloatArray, x_px: _Axis, y_px: _Axis) -> Person:
    points = row[: 3 * _KEYPOINTS].reshape(_KEYPOINTS, 3)
    keypoints = np.column_stack([x_px(points[:, 1]), y_px(points[:, 0]), points[:, 2]])
    y0, x0, y1, x1 = row[3 * _KEYPOINTS : 3 * _KEYPOINTS + 4]
    corners_x, corners_y = x_px(np.array([x0, x1])), y_px(np.array([y0, y1]))
    box = (float(corners_x[0]), float(corners_y[0]), float(corners_x[1]), float(corners_y[1]))
    return Person(keypoints, box, float(row[-1]))


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
