"""Tiny pose networks with the signatures of the real ones, made of a few ONNX nodes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

H, W = 256, 192
# Somebody in the input's pixels: 17 points down the middle, the last two (ankles) at the bottom.
POINTS = np.column_stack([np.full(17, 90.0), np.linspace(40.0, 200.0, 17), np.full(17, 0.8)])
SCORE = 7.0  # marks where the person's score goes
BOX = np.array([60.0, 30.0, 120.0, 210.0])


def save(path: Path, output: NDArray[np.float32], shape: list[int | str], dtype: int, *, nchw: bool) -> Path:
    """A network that gives `output`, its person's score times the mean of the input's red channel (of 255, or
    of 1 where the network wants 0..1), so that the order of channels and the scale are tested, too."""
    nodes = [
        helper.make_node("Cast", ["image"], ["floats"], to=TensorProto.FLOAT),
        helper.make_node("Slice", ["floats", "from", "to", "axis"], ["red"]),
        helper.make_node("ReduceMean", ["red"], ["mean"], keepdims=0),
        helper.make_node("Mul", ["mean", "scores"], ["score"]),
        helper.make_node("Add", ["score", "rest"], ["people"]),
    ]
    axis = 1 if nchw else 3
    scores = np.where(output == SCORE, 0.6 if nchw else 0.6 / 255.0, 0.0).astype(np.float32)
    rest = np.where(output == SCORE, 0.0, output).astype(np.float32)
    constants = {
        "from": np.array([0], np.int64),
        "to": np.array([1], np.int64),
        "axis": np.array([axis], np.int64),
        "scores": scores,
        "rest": rest,
    }
    graph = helper.make_graph(
        nodes,
        "tiny",
        [helper.make_tensor_value_info("image", dtype, shape)],
        [helper.make_tensor_value_info("people", TensorProto.FLOAT, list(output.shape))],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))
    return path


def movenet_multi() -> NDArray[np.float32]:
    out = np.zeros((1, 6, 56), np.float32)
    person = np.column_stack([POINTS[:, 1] / H, POINTS[:, 0] / W, POINTS[:, 2]])
    out[0, 0] = np.concatenate([person.ravel(), BOX[[1, 0, 3, 2]] / (H, W, H, W), [SCORE]])
    return out


def movenet_single() -> NDArray[np.float32]:
    person = np.column_stack([POINTS[:, 1] / H, POINTS[:, 0] / W, np.full(17, SCORE)])
    return person.astype(np.float32)[None, None]


def yolo() -> NDArray[np.float32]:
    """Columns: two boxes of the same person and one of nobody. Edges at whole numbers: half a pixel more."""
    out = np.zeros((1, 56, 3), np.float32)
    points = np.add(POINTS, (0.5, 0.5, 0.0))
    centre, size = (BOX[:2] + BOX[2:]) / 2 + 0.5, BOX[2:] - BOX[:2]
    out[0, :, 0] = np.concatenate([centre, size, [SCORE], points.ravel()])
    out[0, :, 1] = np.concatenate([centre + 2, size, [0.2], points.ravel()])
    return out


def yolo_distinct() -> NDArray[np.float32]:
    out = np.zeros((1, 4, 57), np.float32)
    points = np.add(POINTS, (0.5, 0.5, 0.0))
    out[0, 0] = np.concatenate([BOX + 0.5, [SCORE, 0.0], points.ravel()])
    return out


def red(level: int = 255) -> NDArray[np.uint8]:
    picture = np.zeros((H, W, 3), np.uint8)
    picture[:, :, 2] = level  # BGR
    return picture
