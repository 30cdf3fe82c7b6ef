"""On the host, before the guest starts: one simulated home as the guest's emulators will play it.

`story.py FOLDER` writes what would take an emulated processor an hour (`--plan`: the floor plan alone):

    frames/NNNN.jpg   the camera's pictures, rendered, each with its number in a faint strip along the top
    network.onnx      a pose network that reads the number and gives what the packaged network, run here on
                      that very picture, has given; everything around it is the daemon's own
    radio.npz         the packets that a 5300 would report, with times
    story.json        segments (start, drive, rest, walk-N): frames, robot poses, packets; the truth; whom the
                      packaged network, as the daemon uses it, finds in one picture
    floor.yaml, .pgm  the floor plan
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from vad.robot.map_server import save_floor_plan
from vad.sim.home import floor_plan
from vad.sim.radio import Radio
from vad.sim.render import Renderer
from vad.sim.scenario import CARRIER_HZ, Scenario, make_home
from vad.vision.people import MODEL_PATH, PoseNetwork

SEED = 1
STATION_MAC = "f4:f5:d8:d3:35:b2"
FPS = 6.0
PACKETS_PER_S = 200.0
JPEG_QUALITY = 85
WALKS = 4
DRIVE_S = 36.0
STILL_FRAMES = 6
"""Pictures of an empty room, shown in turn: each has its own noise."""
STILL_RADIO_S = 3.0
POSES_PER_S = 20.0

BITS = 10
STRIP_PX = 16
"""A whole block of the JPEG's coarser planes, so that the room's colours do not leak into the strip."""
LEVEL, STEP = 128, 2
"""Grey of the strip, and how much a bit lifts or lowers it: less than the daemon takes for motion."""
NETWORK_SIZE = (288, 384)
"""Height and width of the network's input: the packaged one's for a whole picture."""


@dataclass(frozen=True, slots=True)
class Segment:
    """A part of the story that can be played at any time. t0_s, t1_s: on the home's own timeline."""

    name: str
    t0_s: float
    t1_s: float
    loops: bool


def shortened(home: Scenario) -> Scenario:
    """The home whose robot stops at the last corner that it reaches within DRIVE_S."""
    for corners in range(len(home.robot_path_m), 2, -1):
        shorter = replace(home, robot_path_m=home.robot_path_m[:corners])
        if shorter.drive_end_s - home.drive_start_s <= DRIVE_S:
            return shorter
    raise ValueError("the robot's first lanes take too long")


def segments(home: Scenario) -> list[Segment]:
    """What can be played: stillness before and after the drive, the drive, each walk."""
    rest_s = home.walks[0].start_s - STILL_RADIO_S
    return [
        Segment("start", home.drive_start_s - STILL_FRAMES / FPS, home.drive_start_s, True),
        Segment("drive", home.drive_start_s, home.drive_end_s, False),
        Segment("rest", rest_s, home.walks[0].start_s, True),
        *(Segment(f"walk-{n}", w.start_s, w.end_s, False) for n, w in enumerate(home.walks)),
    ]


def numbered(image: NDArray[np.uint8], number: int) -> NDArray[np.uint8]:
    """The picture with its number, 0 to 1023, in the strip."""
    block = image.shape[1] // BITS
    for bit in range(BITS):
        grey = LEVEL + (STEP if number >> bit & 1 else -STEP)
        image[:STRIP_PX, bit * block : (bit + 1) * block] = grey
    return image


def as_input(image: NDArray[np.uint8]) -> NDArray[np.int32]:
    """A 640x480 picture as the packaged network's input, the way vad.vision.people brings it there."""
    small = cv2.resize(image, NETWORK_SIZE[::-1], interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(small[None, :, :, ::-1].astype(np.int32))


def reading_network(answers: NDArray[np.float32]) -> onnx.ModelProto:
    """A network with MoveNet's input and output that looks a picture's number up in `answers` (N, 6, 56)."""
    columns = NETWORK_SIZE[1]
    place = np.zeros((columns, BITS), np.float32)
    for bit in range(BITS):
        middle = (bit + 0.5) * columns / BITS
        inside = np.abs(np.arange(columns) + 0.5 - middle) < 0.3 * columns / BITS
        place[inside, bit] = 1.0 / np.count_nonzero(inside)
    rows = round(STRIP_PX / 2 * NETWORK_SIZE[0] / 480)

    def constant(name: str, value: NDArray[Any]) -> onnx.TensorProto:
        return numpy_helper.from_array(value, name)

    nodes = [
        helper.make_node("Slice", ["input", "first", "last", "axes"], ["strip"]),
        helper.make_node("Cast", ["strip"], ["grey"], to=TensorProto.FLOAT),
        helper.make_node("ReduceMean", ["grey"], ["row"], axes=[1, 3], keepdims=0),
        helper.make_node("MatMul", ["row", "place"], ["levels"]),
        helper.make_node("Greater", ["levels", "level"], ["set"]),
        helper.make_node("Cast", ["set"], ["bits"], to=TensorProto.FLOAT),
        helper.make_node("MatMul", ["bits", "powers"], ["sum"]),
        helper.make_node("Cast", ["sum"], ["number"], to=TensorProto.INT64),
        helper.make_node("Min", ["number", "most"], ["row_number"]),
        helper.make_node("Gather", ["answers", "row_number"], ["output"], axis=0),
    ]
    constants = [
        constant("first", np.array([1], np.int64)),
        constant("last", np.array([1 + rows], np.int64)),
        constant("axes", np.array([1], np.int64)),
        constant("place", place),
        constant("level", np.array([LEVEL], np.float32)),
        constant("powers", (2.0 ** np.arange(BITS)).astype(np.float32)),
        constant("most", np.array([len(answers) - 1], np.int64)),
        constant("answers", answers),
    ]
    graph = helper.make_graph(
        nodes,
        "numbered pictures",
        [helper.make_tensor_value_info("input", TensorProto.INT32, [1, *NETWORK_SIZE, 3])],
        [helper.make_tensor_value_info("output", TensorProto.FLOAT, [1, 6, 56])],
        constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.checker.check_model(model)
    return model


class Film:
    """Draws pictures, has the packaged network look at them, and keeps both."""

    def __init__(self, home: Scenario, folder: Path) -> None:
        self._renderer = Renderer(home)
        self._folder = folder
        folder.mkdir()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self._network = onnxruntime.InferenceSession(
            str(MODEL_PATH), sess_options=options, providers=["CPUExecutionProvider"]
        )
        self._input = self._network.get_inputs()[0].name
        self.answers: list[NDArray[np.float32]] = []

    def take(self, t_s: float) -> int:
        """The number of the picture of t_s."""
        number = len(self.answers)
        if number >= 1 << BITS:
            raise ValueError("more pictures than numbers")
        image = numbered(self._renderer.frame(t_s), number)
        path = self._folder / f"{number:04}.jpg"
        cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        sent = np.asarray(cv2.imread(str(path)), dtype=np.uint8)
        (answer,) = self._network.run(None, {self._input: as_input(sent)})
        self.answers.append(np.asarray(answer[0], dtype=np.float32))
        return number

    def check(self, network: Path) -> None:
        """That `network` reads every picture's number."""
        reader = onnxruntime.InferenceSession(str(network), providers=["CPUExecutionProvider"])
        for number, wanted in enumerate(self.answers):
            image = np.asarray(cv2.imread(str(self._folder / f"{number:04}.jpg")), dtype=np.uint8)
            (found,) = reader.run(None, {"input": as_input(image)})
            if not np.array_equal(found[0], wanted):
                raise ValueError(f"picture {number} is not read as itself")


def poses(home: Scenario, part: Segment) -> list[tuple[float, float, float]]:
    """What the robot's SLAM says during a segment, POSES_PER_S a second: the truth and 1.5 cm of noise."""
    rng = np.random.default_rng([home.seed, round(part.t0_s * 1000)])
    times = np.arange(part.t0_s, part.t1_s, 1 / POSES_PER_S)
    noise = rng.normal(0.0, [0.015, 0.015, 0.01], (len(times), 3))
    return [tuple(np.add(home.robot_at(float(t)), dx).tolist()) for t, dx in zip(times, noise, strict=True)]


def packets(radio: Radio, part: Segment) -> tuple[NDArray[np.float64], list[bytes]]:
    """The driver's records of a segment: seconds since its begin, and bytes."""
    timed = radio.log_bytes(radio.generate(part.t0_s, part.t1_s))
    return np.array([t_s - part.t0_s for t_s, _ in timed]), [data for _, data in timed]


def main() -> None:
    folder = Path(sys.argv[1])
    home = shortened(replace(make_home(SEED, walks=WALKS), device_mac=STATION_MAC))
    home = replace(home, join_s=home.walks[0].start_s - STILL_RADIO_S)
    save_floor_plan(floor_plan(home), folder / "floor.yaml")
    if "--plan" in sys.argv:
        return
    radio = Radio(home, packets_per_s=PACKETS_PER_S, seed=home.seed)
    film = Film(home, folder / "frames")
    parts: dict[str, Any] = {}
    arrays: dict[str, NDArray[Any]] = {}
    for part in segments(home):
        count = STILL_FRAMES if part.loops else int((part.t1_s - part.t0_s) * FPS)
        parts[part.name] = {
            "seconds": part.t1_s - part.t0_s,
            "loops": part.loops,
            "frames": [film.take(part.t0_s + k / FPS) for k in range(count)],
            "poses": poses(home, part),
        }
        if part.name not in ("start", "drive"):
            times, records = packets(radio, part)
            arrays[f"{part.name}-t"] = times
            arrays[f"{part.name}-size"] = np.array([len(data) for data in records])
            arrays[f"{part.name}-data"] = np.frombuffer(b"".join(records), np.uint8)
    np.savez(folder / "radio.npz", **arrays)
    onnx.save(reading_network(np.stack(film.answers)), str(folder / "network.onnx"))
    film.check(folder / "network.onnx")
    offset = np.subtract(home.anchor_m, home.camera.eye_m)
    looked_at = parts["walk-0"]["frames"][len(parts["walk-0"]["frames"]) // 2]
    picture = np.asarray(cv2.imread(str(folder / "frames" / f"{looked_at:04}.jpg")), dtype=np.uint8)
    story = {
        "fps": FPS,
        "looked_at": looked_at,
        "people": [person.keypoints[:, :2].tolist() for person in PoseNetwork().infer(picture)],
        "poses_per_s": POSES_PER_S,
        "segments": parts,
        "mac": home.device_mac,
        "truth": dict(zip("xyz", home.device_m, strict=True)),
        "camera_m": home.camera.eye_m,
        "carrier_hz": CARRIER_HZ,
        "antenna_offset_m": [round(float(v), 3) for v in offset],
    }
    (folder / "story.json").write_text(json.dumps(story))


if __name__ == "__main__":
    main()
