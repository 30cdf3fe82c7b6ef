"""Tiny detection networks with the outputs of the real families: they find red patches of 8x8 pixels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

SIDES = (160, 192)  # height and width of the input
WIDTH, HEIGHT = 40.0, 24.0  # of every box, input pixels
STRIDES = (8, 16, 32)


def _middles() -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Middle of every cell (N, 2) in pixels and its stride (N, 1)."""
    places, strides = [], []
    for stride in STRIDES:
        y, x = np.mgrid[0 : SIDES[0] // stride, 0 : SIDES[1] // stride]
        places.append((np.column_stack([x.ravel(), y.ravel()]) + 0.5) * stride)
        strides.append(np.full((x.size, 1), stride))
    return np.vstack(places).astype(np.float32), np.vstack(strides).astype(np.float32)


def _save(
    path: Path,
    nodes: list[onnx.NodeProto],
    constants: dict[str, NDArray[np.float32] | NDArray[np.int64]],
    shape: tuple[int, ...],
    names: dict[int, str] | None,
) -> Path:
    graph = helper.make_graph(
        nodes,
        "tiny",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, *SIDES])],
        [helper.make_tensor_value_info("output", TensorProto.FLOAT, list(shape))],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    if names is not None:
        helper.set_model_props(model, {"names": repr(names), "stride": "32"})
    onnx.checker.check_model(model)
    onnx.save(model, str(path))
    return path


def _score_nodes(red: int, white: float) -> tuple[list[onnx.NodeProto], dict[str, NDArray[np.float32]]]:
    """`scores` (1, cells of stride 8, 1): how red; `red`: the channel's number; `white`: its brightest."""
    weight = np.full((1, 3, 8, 8), -0.5 / 64 / white, np.float32)
    weight[:, red] = 1.0 / 64 / white
    cells = SIDES[0] * SIDES[1] // 64
    nodes = [
        helper.make_node("Conv", ["images", "weight"], ["map"], kernel_shape=[8, 8], strides=[8, 8]),
        helper.make_node("Relu", ["map"], ["positive"]),
        helper.make_node("Reshape", ["positive", "column"], ["scores"]),
    ]
    return nodes, {"weight": weight, "column": np.array([1, cells, 1], np.int64)}


def yolov8(path: Path, *, classes: int = 1, names: dict[int, str] | None = None) -> Path:
    """RGB 0..1; (1, 4 + classes, cells); the last class is the red one."""
    places, _ = _middles()
    count = len(places)
    nodes, constants = _score_nodes(0, 1.0)
    rest = count - constants["column"][1]
    boxes = np.hstack([places, np.full((count, 1), WIDTH), np.full((count, 1), HEIGHT)])
    constants |= {
        "boxes": boxes.astype(np.float32)[None],
        "others": np.zeros((1, count, classes - 1), np.float32),
        "zeros": np.zeros((1, rest, 1), np.float32),
    }
    nodes += [
        helper.make_node("Concat", ["scores", "zeros"], ["all"], axis=1),
        helper.make_node("Concat", ["boxes", "others", "all"], ["rows"], axis=2),
        helper.make_node("Transpose", ["rows"], ["output"], perm=[0, 2, 1]),
    ]
    return _save(path, nodes, constants, (1, 4 + classes, count), names)


def yolov5(path: Path) -> Path:
    """RGB 0..1; (1, 3 cells, 7): two classes, the second sure; three anchors, the first one speaks."""
    places, _ = _middles()
    nodes, constants = _score_nodes(0, 1.0)
    first = int(constants["column"][1])
    order, at = [], 0
    for stride in STRIDES:
        cells = SIDES[0] * SIDES[1] // stride**2
        order += [places[at : at + cells]] * 3
        at += cells
    centres = np.vstack(order)
    count = len(centres)
    boxes = np.hstack([centres, np.full((count, 1), WIDTH), np.full((count, 1), HEIGHT)])
    constants |= {
        "boxes": boxes.astype(np.float32)[None],
        "zeros": np.zeros((1, count - first, 1), np.float32),
        "classes": np.tile(np.array([0.05, 0.9], np.float32), (1, count, 1)),
    }
    nodes += [
        helper.make_node("Concat", ["scores", "zeros"], ["all"], axis=1),
        helper.make_node("Concat", ["boxes", "all", "classes"], ["output"], axis=2),
    ]
    return _save(path, nodes, constants, (1, count, 7), None)


def yolox(path: Path, *, decoded: bool = False) -> Path:
    """BGR 0..255; (1, cells, 6); boxes in cells and logarithms, as its exporter leaves them by default."""
    places, strides = _middles()
    count = len(places)
    nodes, constants = _score_nodes(2, 255.0)
    sizes = np.tile(np.array([[WIDTH, HEIGHT]]), (count, 1))
    raw = np.hstack([np.full((count, 2), 0.5), np.log(sizes / strides)])
    boxes = np.hstack([places, sizes]) if decoded else raw
    constants |= {
        "boxes": boxes.astype(np.float32)[None],
        "zeros": np.zeros((1, count - constants["column"][1], 1), np.float32),
        "sure": np.ones((1, count, 1), np.float32),
    }
    nodes += [
        helper.make_node("Concat", ["scores", "zeros"], ["all"], axis=1),
        helper.make_node("Concat", ["boxes", "all", "sure"], ["output"], axis=2),
    ]
    return _save(path, nodes, constants, (1, count, 6), None)


def suppressed(path: Path) -> Path:
    """(1, 3, 6), corners, score, class; the score of the first is how red the picture is."""
    rows = np.array([[76, 68, 116, 92, 0, 1], [10, 10, 30, 30, 0.9, 0], [0, 0, 0, 0, 0, 0]], np.float32)
    scale = np.zeros((1, 3, 6), np.float32)
    scale[0, 0, 4] = 20.0
    nodes, constants = _score_nodes(0, 1.0)
    constants |= {"rows": rows[None], "scale": scale}
    nodes += [
        helper.make_node("ReduceMean", ["scores"], ["mean"], axes=[1, 2], keepdims=1),
        helper.make_node("Mul", ["mean", "scale"], ["share"]),
        helper.make_node("Add", ["rows", "share"], ["output"]),
    ]
    return _save(path, nodes, constants, (1, 3, 6), {0: "cat", 1: "robot"})


def other(path: Path) -> Path:
    """A network that is no detector."""
    nodes = [helper.make_node("ReduceMean", ["images"], ["output"], axes=[2, 3], keepdims=0)]
    return _save(path, nodes, {}, (1, 3), None)
