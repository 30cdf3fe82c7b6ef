"""The robot in a picture by a trained network: the packaged one, or any YOLOv5, YOLOv8 or YOLOX ONNX export.

Gives what the motion finder (vad.vision.robot) gives: both feed the same consensus with the robot's poses.
"""

from __future__ import annotations

import ast
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray
from onnxruntime.capi import onnxruntime_pybind11_state as ort_errors

from vad.errors import VadError
from vad.vision.robot import MAX_CANDIDATES, RobotCandidate, disc_contact, touches_people
from vad.vision.robot_outputs import Detections, Layout, Letterbox, layout_of, read_heat, read_yolo, suppress

PACKAGED_MODEL = Path(__file__).parent / "models" / "robot.onnx"
PACKAGED_THRESHOLD = 0.6
"""Working threshold of the packaged network; how it was chosen and what it costs: models/MODELS.md."""
YOLO_THRESHOLD = 0.25
CANDIDATE_SHARE = 0.4
"""Candidates need this share of the threshold: which of them is the robot, its own poses say."""

_PACKAGED_WIDTH = 384
_PACKAGED_MULTIPLE = 16
_OVERLAP = 0.5
# Spread of the contact point, per width of the box: seen in rendered rooms and in the simulated home.
_EDGE_PX = 1.0
_SIGMA_PX = 1.0
_SIGMA_PER_WIDTH = 0.09
_WHERE = "vision.robot_detector"

FloatArray = NDArray[np.float64]
Image = NDArray[np.uint8]


class RobotDetector:
    """Finds robots with a network. Not thread-safe; `update` blocks for some tens of milliseconds.

    Args:
        model_path: an ONNX file; None takes the packaged network.
        class_name: the robot's class in a YOLO model of several, a name in the model's own list or a number;
            None is fine for a model with one class.
        threshold: score from which on `detect`'s caller may say "here is a robot"; None takes the usual one.
        threads: for the network.

    Raises:
        VadError: no such file, one that ONNX Runtime refuses, an output of no known shape, an unknown class.
    """

    def __init__(
        self,
        model_path: Path | None = None,
        *,
        class_name: str | None = None,
        threshold: float | None = None,
        threads: int = 1,
    ) -> None:
        path = model_path or PACKAGED_MODEL
        self._session = _open(path, threads)
        (entry, *more) = self._session.get_inputs()
        if more:
            raise _refused(path, f"it wants {1 + len(more)} inputs")
        self._input, self._type = entry.name, _TYPES.get(entry.type)
        if self._type is None:
            raise _refused(path, f"its input is {entry.type}")
        self._packaged = self._type is np.uint8 and len(entry.shape) == 4 and entry.shape[3] == 3
        self._size = None if self._packaged else _sides(entry.shape)
        self._box = Letterbox(1.0, 0.0, 0.0)
        self._layout: Layout | None = None
        self._class = 0
        if not self._packaged:
            first = self._try(path)
            self._layout = layout_of(first.shape, self._input_size())
            if self._layout is None:
                raise _refused(
                    path, f"its output {'x'.join(map(str, first.shape))} is none of YOLOv5, v8 or X"
                )
            self._class = _class_index(class_name, _names(self._session), self._layout.classes, path)
        usual = PACKAGED_THRESHOLD if self._packaged else YOLO_THRESHOLD
        self.threshold = usual if threshold is None else threshold

    @property
    def kind(self) -> str:
        """`packaged`, `yolov5`, `yolov8`, `yolox`, or `nms` for one that suppresses by itself."""
        return "packaged" if self._layout is None else self._layout.family

    def update(self, image: Image, people_boxes: FloatArray) -> list[RobotCandidate]:
        """Candidates in a frame, the best first; none in people's boxes, none cut by the picture's edge.

        Args:
            image: (height, width, 3) uint8 BGR. people_boxes: (N, 4) x0, y0, x1, y1 in raw pixels.
        """
        people = np.asarray(people_boxes, dtype=np.float64).reshape(-1, 4)
        found = self.detect(image, CANDIDATE_SHARE * self.threshold)
        candidates = []
        height, width = image.shape[:2]
        for k, (x0, y0, x1, y1) in enumerate(found.boxes.tolist()):
            box = (x0, y0, x1, y1)
            # Cut by the picture's edge a box does not tell where the robot stands.
            cut = x0 < _EDGE_PX or y0 < _EDGE_PX or x1 > width - 1 - _EDGE_PX or y1 > height - 1 - _EDGE_PX
            if cut or x1 - x0 < 1.0 or y1 - y0 < 1.0 or touches_people(box, people):
                continue
            x_px, y_px = disc_contact(*box) if found.contacts is None else found.contacts[k].tolist()
            sigma_px = float(np.hypot(_SIGMA_PX, _SIGMA_PER_WIDTH * (x1 - x0)))
            candidates.append(RobotCandidate(x_px, y_px, sigma_px, box, found.contacts is None))
        return candidates[:MAX_CANDIDATES]

    def detect(self, image: Image, threshold: float) -> Detections:
        """Robots in (height, width, 3) uint8 BGR, best first, raw pixels; overlapping ones only once."""
        output = self._run(image)
        if self._layout is None:
            found = read_heat(output, threshold)
        else:
            found = read_yolo(output, self._layout, self._class, threshold)
        height, width = image.shape[:2]
        return suppress(self._box.undo(found, width, height), _OVERLAP)

    def _try(self, path: Path) -> NDArray[np.float32]:
        """The output for a grey picture: its shape tells the family."""
        try:
            return self._run(np.full((64, 64, 3), _GREY, np.uint8))
        except (ort_errors.InvalidArgument, ort_errors.RuntimeException, ort_errors.Fail) as error:
            raise _refused(path, str(error)) from error

    def _input_size(self) -> tuple[int, int]:
        return self._size or (_DEFAULT_SIDE, _DEFAULT_SIDE)

    def _run(self, image: Image) -> NDArray[np.float32]:
        feed: NDArray[Any]
        if self._packaged:
            feed, self._box = _shrunk(image)
        elif self._layout is not None and self._layout.family == "yolox":
            boxed, self._box = _letterboxed(image, self._input_size(), centred=False)
            feed = boxed.transpose(2, 0, 1)
        else:
            boxed, self._box = _letterboxed(image, self._input_size(), centred=True)
            feed = boxed[:, :, ::-1].transpose(2, 0, 1) / np.float32(255.0)
        batch = np.ascontiguousarray(feed[None], dtype=self._type)
        (output, *_) = self._session.run(None, {self._input: batch})
        return np.asarray(output, dtype=np.float32)


_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}
# Of an export whose sides are not fixed.
_DEFAULT_SIDE = 640
_GREY = 114  # what the YOLO families were trained with around their pictures


def _open(path: Path, threads: int) -> onnxruntime.InferenceSession:
    if not path.is_file():
        remedy = "give motion, packaged, or the path of an ONNX file"
        raise VadError(what="the robot detector's file is missing", where=str(path), remedy=remedy)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(
            str(path), sess_options=options, providers=["CPUExecutionProvider"]
        )
    except (ort_errors.Fail, ort_errors.InvalidGraph, ort_errors.InvalidProtobuf) as error:
        raise _refused(path, str(error)) from error


def _refused(path: Path, why: str) -> VadError:
    remedy = f"{_WHERE} takes a YOLOv5, YOLOv8 or YOLOX model exported to ONNX"
    return VadError(what=f"the robot detector cannot be used: {why}", where=str(path), remedy=remedy)


def _sides(shape: Sequence[object]) -> tuple[int, int] | None:
    """Height and width of an NCHW input; None where they are free."""
    sides = shape[2:4]
    if len(shape) == 4 and all(isinstance(side, int) and side > 0 for side in sides):
        return int(str(sides[0])), int(str(sides[1]))
    return None


def _names(session: onnxruntime.InferenceSession) -> dict[int, str]:
    """The class names that Ultralytics' exports carry, by number."""
    text = session.get_modelmeta().custom_metadata_map.get("names", "")
    try:
        names = ast.literal_eval(text) if text else {}
    except (ValueError, SyntaxError):
        return {}
    if isinstance(names, list | tuple):
        names = dict(enumerate(names))
    return {k: str(v) for k, v in names.items()} if isinstance(names, dict) else {}


def _class_index(wanted: str | None, names: dict[int, str], count: int, path: Path) -> int:
    if wanted is None:
        if count == 1 or (not count and len(names) < 2):
            return 0
        remedy = "name it in vision.robot_class" + (f"; the model knows {_some(names)}" if names else "")
        raise VadError(
            what=f"which of its {count or len(names)} classes is the robot?", where=str(path), remedy=remedy
        )
    count = count or max(len(names), 1)
    for number, name in names.items():
        if name.casefold() == wanted.casefold() and number < count:
            return number
    if wanted.isdigit() and int(wanted) < count:
        return int(wanted)
    known = _some(names) if names else f"numbers 0 to {count - 1}"
    raise VadError(what=f"the model has no class {wanted!r}", where=str(path), remedy=f"it knows {known}")


def _some(names: dict[int, str]) -> str:
    shown = list(names.values())[:12]
    return ", ".join(shown) + (", ..." if len(names) > len(shown) else "")


def _shrunk(image: Image) -> tuple[Image, Letterbox]:
    """A picture as the packaged network wants it: its longer side as in training, both multiples of 16."""
    height, width = image.shape[:2]
    scale = _PACKAGED_WIDTH / max(width, height)
    size = [
        max(_PACKAGED_MULTIPLE, round(side * scale / _PACKAGED_MULTIPLE) * _PACKAGED_MULTIPLE)
        for side in (width, height)
    ]
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR)
    return np.asarray(small, dtype=np.uint8), Letterbox(size[0] / width, 0.0, 0.0, size[1] / height)


def _letterboxed(image: Image, size: tuple[int, int], *, centred: bool) -> tuple[Image, Letterbox]:
    """A picture inside grey of exactly `size` (height, width); in its middle or its upper left corner."""
    height, width = image.shape[:2]
    scale = min(size[0] / height, size[1] / width)
    inner = (max(1, round(width * scale)), max(1, round(height * scale)))
    left = (size[1] - inner[0]) // 2 if centred else 0
    top = (size[0] - inner[1]) // 2 if centred else 0
    canvas = np.full((*size, 3), _GREY, np.uint8)
    small = cv2.resize(image, inner, interpolation=cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR)
    canvas[top : top + inner[1], left : left + inner[0]] = small
    return canvas, Letterbox(inner[0] / width, float(left), float(top), inner[1] / height)
