"""The robot detector: every YOLO family through tiny real networks, and the packaged network on renders."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import robot_networks as tiny
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from vad.errors import VadError
from vad.vision.robot import disc_contact
from vad.vision.robot_detector import RobotDetector
from vad.vision.robot_outputs import HEAT_CHANNELS, Detections, Letterbox, layout_of, read_heat, suppress

NOBODY = np.empty((0, 4))


def room(width: int, height: int, red: tuple[float, float], size: float = 0.05) -> NDArray[np.uint8]:
    """A grey picture with a red patch around `red` (shares of width and height), BGR."""
    image = np.full((height, width, 3), 90, np.uint8)
    x, y, r = round(red[0] * width), round(red[1] * height), round(size * max(width, height))
    image[y - r : y + r, x - r : x + r] = (10, 10, 250)
    return image


FAMILIES: list[tuple[str, Callable[[Path], Path], str | None]] = [
    ("yolov8", tiny.yolov8, None),
    (
        "yolov8",
        lambda path: tiny.yolov8(path, classes=3, names={0: "cat", 1: "dog", 2: "robot vacuum"}),
        "Robot Vacuum",
    ),
    ("yolov5", tiny.yolov5, "1"),
    ("yolox", tiny.yolox, None),
    ("yolox", lambda path: tiny.yolox(path, decoded=True), None),
]


@pytest.mark.parametrize(("family", "make", "name"), FAMILIES)
@pytest.mark.parametrize("size", [(640, 480), (480, 640), (1280, 400), (100, 80)])
def test_every_family_is_recognised_and_finds_the_patch(
    family: str, make: Callable[[Path], Path], name: str | None, size: tuple[int, int], tmp_path: Path
) -> None:
    detector = RobotDetector(make(tmp_path / "robot.onnx"), class_name=name)
    assert detector.kind == family
    width, height = size
    found = detector.detect(room(width, height, (0.3, 0.6)), 0.25)
    x0, y0, x1, y1 = found.boxes[0]
    scale = max(width / tiny.SIDES[1], height / tiny.SIDES[0])
    assert (x0 + x1) / 2 == pytest.approx(0.3 * width, abs=8.0 * scale)
    assert (y0 + y1) / 2 == pytest.approx(0.6 * height, abs=8.0 * scale)
    assert x1 - x0 == pytest.approx(tiny.WIDTH * scale, rel=0.03)
    assert y1 - y0 == pytest.approx(tiny.HEIGHT * scale, rel=0.03)
    assert found.scores[0] > 0.4
    assert not len(detector.detect(np.full((height, width, 3), 90, np.uint8), 0.25).boxes)


def test_an_export_with_its_own_suppression(tmp_path: Path) -> None:
    detector = RobotDetector(tiny.suppressed(tmp_path / "robot.onnx"), class_name="robot")
    assert detector.kind == "nms"
    found = detector.detect(room(640, 480, (0.5, 0.5)), 0.2)
    assert len(found.boxes) == 1


def test_candidates_are_the_discs_contact_and_none_are_people(tmp_path: Path) -> None:
    detector = RobotDetector(tiny.yolov8(tmp_path / "robot.onnx"), threshold=0.5)
    image = room(640, 480, (0.3, 0.6), 0.025)
    candidate = detector.update(image, NOBODY)[0]
    assert (candidate.x_px, candidate.y_px) == disc_contact(*candidate.box)
    assert 1.0 < candidate.sigma_px < 0.15 * (candidate.box[2] - candidate.box[0])
    x0, y0, x1, y1 = candidate.box
    assert detector.update(image, np.array([[x0 - 30.0, y0 - 200.0, x1, y1 + 100.0]])) == []
    assert candidate in detector.update(image, np.array([[x1 + 60.0, y0 - 200.0, x1 + 100.0, y1]]))
    cut = room(640, 480, (0.03, 0.6), 0.025)
    assert len(detector.detect(cut, 0.5).boxes)
    assert detector.update(cut, NOBODY) == []


@pytest.mark.parametrize(
    ("make", "name", "words"),
    [
        (tiny.other, None, "none of YOLOv5"),
        (lambda path: tiny.yolov8(path, classes=3), None, "which of its 3 classes"),
        (lambda path: tiny.yolov8(path, classes=2, names={0: "cat", 1: "dog"}), "robot", "cat, dog"),
        (lambda path: tiny.yolov8(path, classes=2), "2", "numbers 0 to 1"),
    ],
)
def test_what_cannot_be_used_is_said(
    make: Callable[[Path], Path], name: str | None, words: str, tmp_path: Path
) -> None:
    with pytest.raises(VadError, match=words):
        RobotDetector(make(tmp_path / "robot.onnx"), class_name=name)


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(VadError, match="missing"):
        RobotDetector(tmp_path / "robot.onnx")
    (tmp_path / "robot.onnx").write_bytes(b"not a network")
    with pytest.raises(VadError, match="cannot be used"):
        RobotDetector(tmp_path / "robot.onnx")


# The outputs alone.


@given(
    width=st.integers(16, 4000), height=st.integers(16, 4000),
    box=st.tuples(*[st.floats(0.0, 1.0)] * 4), left=st.integers(0, 100), top=st.integers(0, 100),
    scale=st.floats(0.05, 4.0),
)  # fmt: skip
def test_a_letterbox_is_undone(
    width: int, height: int, box: tuple[float, float, float, float], left: int, top: int, scale: float
) -> None:
    x0, x1 = sorted((box[0] * width, box[2] * width))
    y0, y1 = sorted((box[1] * height, box[3] * height))
    inner = np.array([[x0 * scale + left, y0 * scale + top, x1 * scale + left, y1 * scale + top]])
    undone = Letterbox(scale, left, top).undo(Detections(inner, np.ones(1)), width, height).boxes[0]
    assert undone == pytest.approx(np.array([x0, y0, x1, y1]) - 0.5, abs=1e-6 * max(width, height))


@given(st.integers(1, 90), st.integers(1, 40), st.integers(1, 40))
def test_layouts_are_told_apart(classes: int, rows: int, columns: int) -> None:
    size = (32 * rows, 32 * columns)
    cells = 21 * rows * columns
    found = {
        "yolov8": layout_of((1, 4 + classes, cells), size),
        "yolov5": layout_of((1, 3 * cells, 5 + classes), size),
        "yolox": layout_of((1, cells, 5 + classes), size),
    }
    for family, layout in found.items():
        assert layout is not None
        if layout.family != family:  # a shape that two families share
            assert {4 + classes, 5 + classes} & {cells, 3 * cells}
        else:
            assert layout.classes == classes


@given(st.lists(st.tuples(*[st.floats(0, 100)] * 4), max_size=8))
def test_suppression_keeps_the_best_and_nothing_twice(
    places: list[tuple[float, float, float, float]],
) -> None:
    boxes = np.array([[x, y, x + 1 + w, y + 1 + h] for x, y, w, h in places]).reshape(-1, 4)
    kept = suppress(Detections(boxes, np.linspace(1, 0.5, len(boxes))), 0.5)
    assert len(kept.boxes) <= len(boxes)
    if len(boxes):
        assert (kept.boxes[0] == boxes[0]).all()
    again = suppress(kept, 0.5)
    assert len(again.boxes) == len(kept.boxes)


def test_peaks_of_a_heat_map() -> None:
    output = np.zeros((1, HEAT_CHANNELS, 10, 12), np.float32)
    output[0, 0, 3, 4], output[0, 0, 3, 5], output[0, 0, 8, 11] = 0.9, 0.8, 0.4
    output[0, 1:, 3, 4] = (35.5, 27.5, 20.0, 10.0, 36.0, 29.5)
    output[0, 1:, 8, 11] = (91.0, 67.0, 8.0, 8.0, 91.0, 68.0)
    found = read_heat(output, 0.3)
    assert found.scores.tolist() == pytest.approx([0.9, 0.4])
    assert found.boxes[0].tolist() == [26.0, 23.0, 46.0, 33.0]
    assert found.contacts is not None
    undone = Letterbox(0.5, 0.0, 0.0).undo(found, 200, 160)
    assert undone.contacts is not None
    assert undone.contacts[0].tolist() == [72.5, 59.5]
    assert not len(read_heat(output, 0.95).boxes)
