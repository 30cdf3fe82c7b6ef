"""How well a robot detector finds robot vacuums in photographs, and how often it sees one where none is.

tools/bench detector [--photos FOLDER] [--model FILE --class NAME] [--threshold T] [--json]

FOLDER holds pictures with robots, boxes.csv (image,w,h,x0,y0,x1,y1; a picture may have several rows), and
negatives/ with pictures without. Without --photos those beside the checkout are taken, if they are there.
Exit status: 0 the bar is held (best guess inside a box in 90 % of pictures, a false peak at the working
threshold in 5 % of floors), 1 it is not, 2 nothing to measure with.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
import time
from collections import defaultdict
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from vad.errors import VadError
from vad.vision.robot_detector import RobotDetector

PHOTOS = Path(__file__).resolve().parents[2] / "shared" / "data" / "robot_photos"
TOP_1_MIN, FALSE_MAX = 0.90, 0.05
_LOWEST = 0.01
_ROUNDS = 40

Score = tuple[float, float]


@dataclass(frozen=True)
class Result:
    """Shares 0..1; curve: (threshold, found, false peak); ms: CPU time for a frame of 640x480."""

    kind: str
    threshold: float
    pictures: int
    floors: int
    unreadable: int
    top_1: float
    recall: float
    false: float
    missed: list[str]
    false_alarms: list[str]
    curve: list[tuple[float, float, float]]
    ms: float


def scores(detector: RobotDetector, image: np.ndarray, boxes: np.ndarray) -> Score:
    """The best score of a guess whose middle is in a box, and of one whose middle is in none."""
    found = detector.detect(image, _LOWEST)
    middle = (found.boxes[:, :2] + found.boxes[:, 2:]) / 2
    inside = np.zeros(len(middle), bool)
    for x0, y0, x1, y1 in boxes:
        inside |= (middle > [x0, y0]).all(1) & (middle < [x1, y1]).all(1)
    return float(found.scores[inside].max(initial=0.0)), float(found.scores[~inside].max(initial=0.0))


def measure(detector: RobotDetector, photos: Path) -> Result:
    """All figures; pictures that cannot be read are left out and counted."""
    rows: dict[str, list[list[float]]] = defaultdict(list)
    with (photos / "boxes.csv").open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            rows[row["image"]].append([float(row[key]) for key in ("x0", "y0", "x1", "y1")])
    unreadable = 0
    found: dict[str, Score] = {}
    for name, boxes in sorted(rows.items()):
        image = cv2.imread(str(photos / name))
        if image is None:
            unreadable += 1
            continue
        found[name] = scores(detector, image, np.array(boxes))
    floors: dict[str, float] = {}
    for path in sorted((photos / "negatives").glob("*")):
        image = cv2.imread(str(path))
        if image is None:
            unreadable += 1
            continue
        floors[path.name] = scores(detector, image, np.empty((0, 4)))[1]
    inside, outside = np.array(list(found.values())).reshape(-1, 2).T
    false = np.array(list(floors.values()))
    limit = detector.threshold
    steps = sorted({0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, round(limit, 2)})
    return Result(
        kind=detector.kind,
        threshold=limit,
        pictures=len(found),
        floors=len(floors),
        unreadable=unreadable,
        top_1=float(np.mean((inside > outside) & (inside > 0))),
        recall=float(np.mean(inside >= limit)),
        false=float(np.mean(false >= limit)),
        missed=[name for name, (good, bad) in found.items() if good <= bad],
        false_alarms=[name for name, score in floors.items() if score >= limit],
        curve=[(t, float(np.mean(inside >= t)), float(np.mean(false >= t))) for t in steps],
        ms=milliseconds(detector),
    )


def milliseconds(detector: RobotDetector) -> float:
    """CPU time for one frame of 640x480, the median."""
    image = np.random.default_rng(1).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    took = []
    for _ in range(_ROUNDS):
        begin = time.process_time()
        detector.detect(image, detector.threshold)
        took.append(time.process_time() - begin)
    return 1e3 * float(np.median(took))


def show(result: Result) -> None:
    console = Console()
    table = Table("what", "measured", "bar", title=f"{result.kind} detector")
    best = f"best guess in a box, {result.pictures} photographs"
    table.add_row(best, f"{result.top_1:.1%}", f">= {TOP_1_MIN:.0%}")
    table.add_row(f"found at the working threshold {result.threshold:.2f}", f"{result.recall:.1%}", "")
    table.add_row(f"false peak on {result.floors} floors", f"{result.false:.1%}", f"<= {FALSE_MAX:.0%}")
    table.add_row("CPU time for a frame of 640x480", f"{result.ms:.1f} ms", "")
    console.print(table)
    curve = Table("threshold", "found", "false peak")
    for threshold, recall, false in result.curve:
        curve.add_row(f"{threshold:.2f}", f"{recall:.1%}", f"{false:.1%}")
    console.print(curve)
    console.print(f"missed: {', '.join(result.missed) or 'none'}")
    console.print(f"false alarms: {', '.join(result.false_alarms) or 'none'}")


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--photos", type=Path, default=PHOTOS)
    parser.add_argument("--model", type=Path, help="a YOLO ONNX file; the packaged network if left out")
    parser.add_argument("--class", dest="name", help="the robot's class in that file")
    parser.add_argument("--threshold", type=float)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    if not (arguments.photos / "boxes.csv").is_file():
        what = f"there are no photographs with a boxes.csv in {arguments.photos}"
        print(f"{what}: name a folder with --photos", file=sys.stderr)
        return 2
    try:
        detector = RobotDetector(arguments.model, class_name=arguments.name, threshold=arguments.threshold)
    except VadError as error:
        print(error, file=sys.stderr)
        return 2
    result = measure(detector, arguments.photos)
    if arguments.json:
        print(json.dumps(asdict(result), indent=2))
    else:
        show(result)
    return 0 if result.top_1 >= TOP_1_MIN and result.false <= FALSE_MAX else 1


if __name__ == "__main__":
    sys.exit(main())
