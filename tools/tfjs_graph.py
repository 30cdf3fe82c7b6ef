"""The growing ONNX graph of tools/tfjs2onnx.py: weights in, node order, names and layouts of tensors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

Node = dict[str, Any]
Array = np.ndarray[Any, Any]


def load_weights(path: Path) -> tuple[dict[str, Any], dict[str, Array]]:
    """The model's JSON and its weights by name; float16 weights stay so.

    Raises:
        ValueError: the .bin files are longer than the manifest says.
    """
    model = json.loads(path.read_text())
    weights: dict[str, Array] = {}
    for group in model["weightsManifest"]:
        buffer = b"".join((path.parent / part).read_bytes() for part in group["paths"])
        offset = 0
        for weight in group["weights"]:
            count = int(np.prod(weight["shape"])) if weight["shape"] else 1
            half = weight.get("quantization", {}).get("dtype") == "float16"
            stored = np.dtype("<f2") if half else np.dtype(weight["dtype"]).newbyteorder("<")
            values = np.frombuffer(buffer, stored, count, offset)
            offset += count * stored.itemsize
            weights[weight["name"]] = (values if half else values.astype(weight["dtype"])).reshape(
                weight["shape"]
            )
        if offset != len(buffer):
            raise ValueError(f"{path}: {len(buffer) - offset} bytes of weights are left over")
    return model, weights


def sorted_nodes(nodes: list[Node]) -> list[Node]:
    """The graph's nodes, each after all of its inputs."""
    by_name = {node["name"]: node for node in nodes}
    done: set[str] = set()
    order: list[Node] = []
    for node in nodes:
        stack = [(node, 0)]
        while stack:
            top, i = stack.pop()
            if top["name"] in done:
                continue
            inputs = [name.lstrip("^").split(":")[0] for name in top.get("input", [])]
            while i < len(inputs) and inputs[i] in done:
                i += 1
            if i < len(inputs):
                stack += [(top, i), (by_name[inputs[i]], 0)]
            else:
                done.add(top["name"])
                order.append(top)
    return order


class OnnxGraph:
    """ONNX nodes and constants, and what is known of each TensorFlow tensor.

    `values` says for each TensorFlow tensor under which ONNX name it is known in which layout
    ("nhwc": TensorFlow's own; "nchw"), its constant value and its rank, where they are known.
    """

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.initialisers: list[onnx.TensorProto] = []
        self.values: dict[str, dict[str, Any]] = {}
        self.scalars: dict[float, str] = {}
        self.count = 0

    def name(self, stem: str) -> str:
        self.count += 1
        return f"{stem}_{self.count}"

    def constant(self, value: Any, stem: str = "c") -> str:
        name = self.name(stem)
        array = np.array(value, order="C")
        if array.dtype == np.float16:
            if array.size > 64:
                self.initialisers.append(numpy_helper.from_array(array, name + "_f16"))
                self.nodes.append(helper.make_node("Cast", [name + "_f16"], [name], to=TensorProto.FLOAT))
                return name
            array = array.astype(np.float32)
        self.initialisers.append(numpy_helper.from_array(array, name))
        return name

    def longs(self, value: Any) -> str:
        return self.constant(np.asarray(value, dtype=np.int64))

    def scalar(self, value: float) -> str:
        if value not in self.scalars:
            self.scalars[value] = self.constant(np.float32(value))
        return self.scalars[value]

    def op(self, kind: str, inputs: list[str], **attributes: Any) -> str:
        return self.split_op(kind, inputs, 1, **attributes)[0]

    def split_op(self, kind: str, inputs: list[str], outputs: int, **attributes: Any) -> list[str]:
        names = [self.name(kind.lower()) for _ in range(outputs)]
        self.nodes.append(helper.make_node(kind, inputs, names, name=names[0], **attributes))
        return names

    def as_int64(self, name: str) -> str:
        return self.op("Cast", [name], to=TensorProto.INT64)

    def as_int32(self, name: str) -> str:
        return self.op("Cast", [name], to=TensorProto.INT32)

    def value(self, tensor: str) -> dict[str, Any]:
        return self.values[tensor.lstrip("^").removesuffix(":0")]

    def rank(self, tensor: str) -> int | None:
        rank: int | None = self.value(tensor).get("rank")
        return rank

    def known(self, tensor: str) -> Array:
        array: Array = self.value(tensor)["const"]
        return array.astype(np.float32) if array.dtype == np.float16 else array

    def nhwc(self, tensor: str) -> str:
        value = self.value(tensor)
        if "nhwc" not in value:
            value["nhwc"] = (
                self.constant(value["const"])
                if "const" in value
                else self.op("Transpose", [value["nchw"]], perm=[0, 2, 3, 1])
            )
        return str(value["nhwc"])

    def nchw(self, tensor: str) -> str:
        value = self.value(tensor)
        if "nchw" not in value:
            value["nchw"] = (
                self.constant(value["const"].transpose(0, 3, 1, 2))
                if "const" in value
                else self.op("Transpose", [value["nhwc"]], perm=[0, 3, 1, 2])
            )
        return str(value["nchw"])

    def is_nchw(self, tensor: str) -> bool:
        return "nchw" in self.value(tensor) and "const" not in self.value(tensor)

    def broadcast_nchw(self, tensor: str) -> str | None:
        """A name that broadcasts against NCHW, or None."""
        value = self.value(tensor)
        if "const" in value:
            array = value["const"]
            if array.ndim == 0:
                return self.nhwc(tensor)
            if array.ndim == 1:
                return self.constant(array.reshape(-1, 1, 1) if array.size > 1 else array)
            return self.nchw(tensor) if array.ndim == 4 else None
        if "nchw" in value:
            return str(value["nchw"])
        return self.nchw(tensor) if value.get("rank") == 4 else None

    def put(self, tensor: str, rank: int | None, **names: Any) -> None:
        self.values[tensor] = dict(names) if rank is None else {**names, "rank": rank}
