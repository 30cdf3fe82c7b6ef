"""The packaged robot network: where it comes from, what it does on photographs and in the simulated home."""

from __future__ import annotations

import csv
import hashlib
from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest

from vad.geometry import project
from vad.sim.render import Renderer
from vad.sim.scenario import make_home
from vad.vision.robot_detector import PACKAGED_MODEL, RobotDetector

pytestmark = pytest.mark.timeout(600)
"""Much work for the processor: a busy machine takes many times as long as an idle one."""

NOBODY = np.empty((0, 4))


def test_every_network_is_listed_with_its_origin() -> None:
    text = (PACKAGED_MODEL.parent / "MODELS.md").read_text(encoding="utf-8")
    notice = (PACKAGED_MODEL.parents[3] / "NOTICE").read_text(encoding="utf-8")
    for path in PACKAGED_MODEL.parent.glob("*.onnx"):
        assert hashlib.sha256(path.read_bytes()).hexdigest() in text, path.name
        assert path.name in notice


def test_the_network_says_what_it_was_trained_on_and_is_small() -> None:
    assert PACKAGED_MODEL.stat().st_size < 2_000_000
    model = onnx.load(str(PACKAGED_MODEL))
    assert [(p.key, p.value) for p in model.metadata_props] == [
        ("vad.robot/1", "head trained on rendered data only")
    ]


@pytest.mark.slow
def test_photographs(shared_data: Path) -> None:
    """The bar of the project, on photographs that it was not trained on."""
    photos = shared_data / "robot_photos"
    boxes: dict[str, list[list[float]]] = defaultdict(list)
    with (photos / "boxes.csv").open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            boxes[row["image"]].append([float(row[key]) for key in ("x0", "y0", "x1", "y1")])
    detector = RobotDetector()
    right = 0
    for name, places in boxes.items():
        found = detector.detect(np.asarray(cv2.imread(str(photos / name)), np.uint8), 0.01)
        x, y = (found.boxes[0, :2] + found.boxes[0, 2:]) / 2
        right += any(x0 < x < x1 and y0 < y < y1 for x0, y0, x1, y1 in places)
    assert right >= 0.9 * len(boxes)
    floors = sorted((photos / "negatives").glob("*.jpg"))
    false = sum(
        len(detector.detect(np.asarray(cv2.imread(str(path)), np.uint8), detector.threshold).boxes) > 0
        for path in floors
    )
    assert false <= 0.05 * len(floors)


@pytest.mark.slow
def test_contact_with_the_floor_in_the_simulated_home() -> None:
    """Rooms of another renderer than the one it was trained with."""
    detector = RobotDetector()
    miss, deviation, shown = [], [], 0
    for seed in range(3):
        scenario = make_home(seed)
        renderer = Renderer(scenario)
        for t_s in np.linspace(2.0, scenario.drive_end_s - 2.0, 12):
            x_m, y_m, _ = scenario.robot_at(float(t_s))
            truth = project([[x_m, y_m, 0.0]], renderer.view.intrinsics, renderer.view.camera_from_map)[0]
            candidates = detector.update(renderer.frame(float(t_s)), NOBODY)
            far = [float(np.hypot(c.x_px - truth[0], c.y_px - truth[1])) for c in candidates]
            shown += 1
            if far and min(far) < 30.0:
                miss.append(min(far))
                deviation.append(min(far) / candidates[int(np.argmin(far))].sigma_px)
    assert len(miss) >= 0.5 * shown
    assert np.median(miss) < 8.0
    # Two axes of one standard deviation each: the mean distance is 1.25 of them.
    assert 0.3 < np.mean(deviation) < 2.0
