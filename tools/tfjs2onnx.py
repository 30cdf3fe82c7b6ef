#!/usr/bin/env python3
"""Convert the MoveNet MultiPose graph model of TensorFlow.js (model.json and .bin) to ONNX.

Needs numpy and onnx only. Pictures' tensors stay in NCHW, with a Transpose only where the graph really needs
NHWC; float16 weights stay float16 in the file and are cast when it is loaded. Only the operations of this
network are known: any other is an error.
"""

# ruff: noqa: N802 (methods named after TensorFlow's operations)
from __future__ import annotations

import argparse
import base64
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper
from tfjs_graph import Node, OnnxGraph, load_weights, sorted_nodes

Attributes = dict[str, Any]

NUMPY_TYPE: dict[str, type] = {"DT_FLOAT": np.float32, "DT_INT32": np.int32, "DT_BOOL": np.bool_}
ONNX_TYPE = {np.float32: TensorProto.FLOAT, np.int32: TensorProto.INT32, np.bool_: TensorProto.BOOL}
BINARY = {
    "Sub": "Sub", "Mul": "Mul", "AddV2": "Add", "RealDiv": "Div", "FloorDiv": "Div", "Minimum": "Min",
    "Maximum": "Max", "Less": "Less", "Greater": "Greater", "GreaterEqual": "GreaterOrEqual",
    "Equal": "Equal", "LogicalAnd": "And", "SquaredDifference": "SquaredDifference",
}  # fmt: skip
UNARY = {"Sigmoid": "Sigmoid", "Abs": "Abs", "Exp": "Exp", "Reciprocal": "Reciprocal"}


def text(value: str) -> str:
    """A string attribute, which the JSON holds in base 64."""
    return base64.b64decode(value).decode()


def integers(attribute: dict[str, Any]) -> list[int]:
    return [int(i) for i in attribute["list"]["i"]]


class Converter(OnnxGraph):
    """Walks the TensorFlow graph once and emits ONNX nodes."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.model, self.weights = load_weights(path)
        self.inputs: list[onnx.ValueInfoProto] = []

    def run(self) -> onnx.ModelProto:
        """The whole model, checked.

        Raises:
            NotImplementedError: an operation or layout this converter does not know.
        """
        for node in sorted_nodes(self.model["modelTopology"]["node"]):
            self.convert(node)
        outputs = []
        signature = self.model.get("signature") or self.model["userDefinedMetadata"]["signature"]
        for output in signature["outputs"].values():
            self.nodes.append(helper.make_node("Identity", [self.nhwc(output["name"])], ["output"]))
            shape = [int(side["size"]) for side in output["tensorShape"]["dim"]]
            outputs.append(helper.make_tensor_value_info("output", TensorProto.FLOAT, shape))
        graph = helper.make_graph(self.nodes, "tfjs", self.inputs, outputs, self.initialisers)
        opset = helper.make_opsetid("", 13)
        model = helper.make_model(graph, opset_imports=[opset], producer_name="tfjs2onnx", ir_version=8)
        onnx.checker.check_model(model)
        return model

    def convert(self, node: Node) -> None:
        op, name, attributes = node["op"], node["name"], node.get("attr", {})
        inputs = [i for i in node.get("input", []) if not i.startswith("^")]
        special: Callable[[str, Attributes, list[str]], None] | None = getattr(self, f"op_{op}", None)
        if special:
            special(name, attributes, inputs)
        elif op in BINARY:
            self.binary(name, BINARY[op], inputs)
        elif op in UNARY:
            self.unary(name, UNARY[op], inputs)
        else:
            raise NotImplementedError(f"{op} {name}")

    # -- operations ---------------------------------------------------------------------------------

    def binary(self, name: str, kind: str, inputs: list[str]) -> None:
        a, b = inputs
        layout = "nchw" if self.is_nchw(a) or self.is_nchw(b) else "nhwc"
        x, y = (self.broadcast_nchw(a), self.broadcast_nchw(b)) if layout == "nchw" else (None, None)
        if x is None or y is None:
            layout, x, y = "nhwc", self.nhwc(a), self.nhwc(b)
        if kind == "SquaredDifference":
            difference = self.op("Sub", [x, y])
            out = self.op("Mul", [difference, difference])
        else:
            out = self.op(kind, [x, y])
        ranks = [rank for rank in (self.rank(a), self.rank(b)) if rank is not None]
        self.put(name, max(ranks) if len(ranks) == 2 else None, **{layout: out})

    def unary(self, name: str, kind: str, inputs: list[str], **attributes: Any) -> None:
        layout = "nchw" if self.is_nchw(inputs[0]) else "nhwc"
        x = self.nchw(inputs[0]) if layout == "nchw" else self.nhwc(inputs[0])
        self.put(name, self.rank(inputs[0]), **{layout: self.op(kind, [x], **attributes)})

    def convolution(
        self, name: str, at: Attributes, inputs: list[str], depthwise: bool, fused: Sequence[str]
    ) -> None:
        x = self.nchw(inputs[0])
        weights = self.value(inputs[1])["const"]
        strides = integers(at["strides"])[1:3]
        dilations = integers(at["dilations"])[1:3] if "dilations" in at else [1, 1]
        rows, columns, channels, multiplier = weights.shape
        if depthwise:
            kernel = weights.transpose(2, 3, 0, 1).reshape(channels * multiplier, 1, rows, columns)
        else:
            kernel = weights.transpose(3, 2, 0, 1)
        settings: dict[str, Any] = {
            "strides": strides,
            "dilations": dilations,
            "kernel_shape": [rows, columns],
            "group": channels if depthwise else 1,
        }
        padding = text(at["padding"]["s"])
        if padding == "VALID" or (rows == columns == 1 and strides != [1, 1]):
            settings["pads"] = [0, 0, 0, 0]
        elif strides == [1, 1]:
            high, wide = (rows - 1) * dilations[0], (columns - 1) * dilations[1]
            settings["pads"] = [high // 2, wide // 2, high - high // 2, wide - wide // 2]
        else:
            settings["auto_pad"] = "SAME_UPPER"
        arguments = [x, self.constant(kernel, "W")]
        if "BiasAdd" in fused:
            arguments.append(self.constant(self.value(inputs[2])["const"].astype(np.float32), "B"))
        out = self.op("Conv", arguments, **settings)
        for activation in fused:
            if activation == "Relu":
                out = self.op("Relu", [out])
            elif activation == "Relu6":
                out = self.op("Clip", [out, self.scalar(0), self.scalar(6)])
            elif activation != "BiasAdd":
                raise NotImplementedError(f"{activation} {name}")
        self.put(name, 4, nchw=out)

    def op_Const(self, name: str, at: Attributes, inputs: list[str]) -> None:
        self.put(name, self.weights[name].ndim, const=self.weights[name])

    def op_Placeholder(self, name: str, at: Attributes, inputs: list[str]) -> None:
        sizes = [int(side["size"]) for side in at["shape"]["shape"]["dim"]]
        sizes = [1, *sizes[1:]] if sizes[0] < 0 else sizes
        shape = [size if size > 0 else f"d{i}" for i, size in enumerate(sizes)]
        self.inputs.append(
            helper.make_tensor_value_info("input", ONNX_TYPE[NUMPY_TYPE[at["dtype"]["type"]]], shape)
        )
        self.put(name, len(shape), nhwc="input")

    def op__FusedConv2D(self, name: str, at: Attributes, inputs: list[str]) -> None:
        self.convolution(name, at, inputs, False, [text(s) for s in at["fused_ops"]["list"]["s"]])

    def op_FusedDepthwiseConv2dNative(self, name: str, at: Attributes, inputs: list[str]) -> None:
        self.convolution(name, at, inputs, True, [text(s) for s in at["fused_ops"]["list"]["s"]])

    def op_DepthwiseConv2dNative(self, name: str, at: Attributes, inputs: list[str]) -> None:
        self.convolution(name, at, inputs, True, [])

    def op_Cast(self, name: str, at: Attributes, inputs: list[str]) -> None:
        self.unary(name, "Cast", inputs, to=ONNX_TYPE[NUMPY_TYPE[at["DstT"]["type"]]])

    def op_Identity(self, name: str, at: Attributes, inputs: list[str]) -> None:
        self.values[name] = self.value(inputs[0])

    def op_Shape(self, name: str, at: Attributes, inputs: list[str]) -> None:
        value = self.value(inputs[0])
        if "nchw" in value:
            shape = self.op("Shape", [value["nchw"]])
            out = self.op("Gather", [shape, self.longs([0, 2, 3, 1])], axis=0)
        else:
            out = self.op("Shape", [self.nhwc(inputs[0])])
        self.put(name, 1, nhwc=self.as_int32(out))

    def op_Size(self, name: str, at: Attributes, inputs: list[str]) -> None:
        self.put(name, 0, nhwc=self.as_int32(self.op("Size", [self.nhwc(inputs[0])])))

    def op_StridedSlice(self, name: str, at: Attributes, inputs: list[str]) -> None:
        begin, end, step = (self.known(i) for i in inputs[1:4])
        keys = ("begin_mask", "end_mask", "ellipsis_mask", "new_axis_mask", "shrink_axis_mask")
        from_start, to_end, ellipsis, new_axis, shrink = (int(at.get(k, {}).get("i", 0) or 0) for k in keys)
        if ellipsis:
            raise NotImplementedError(f"StridedSlice with an ellipsis: {name}")
        x, last = self.nhwc(inputs[0]), int(np.iinfo(np.int64).max)
        cuts: list[tuple[int, int, int, int]] = []
        squeezed: list[int] = []
        added: list[int] = []
        axis = kept = 0
        for i, (a, b, by) in enumerate(zip(begin.tolist(), end.tolist(), step.tolist(), strict=True)):
            if new_axis >> i & 1:
                added.append(kept)
                kept += 1
                continue
            if shrink >> i & 1:
                cuts.append((a, a + 1 if a != -1 else last, axis, 1))
                squeezed.append(axis)
            else:
                if not (from_start >> i & 1 and to_end >> i & 1 and by == 1):
                    cuts.append((0 if from_start >> i & 1 else a, last if to_end >> i & 1 else b, axis, by))
                kept += 1
            axis += 1
        if cuts:
            x = self.op("Slice", [x, *(self.longs(column) for column in zip(*cuts, strict=True))])
        if squeezed:
            x = self.op("Squeeze", [x, self.longs(squeezed)])
        if added:
            x = self.op("Unsqueeze", [x, self.longs(added)])
        rank = self.rank(inputs[0])
        self.put(name, None if rank is None else rank - len(squeezed) + len(added), nhwc=x)

    def op_ResizeBilinear(self, name: str, at: Attributes, inputs: list[str]) -> None:
        if not at["half_pixel_centers"]["b"] or at["align_corners"]["b"]:
            raise NotImplementedError(f"ResizeBilinear without half-pixel centres: {name}")
        x = self.nchw(inputs[0])
        size = self.as_int64(self.nhwc(inputs[1]))
        shape = self.op("Shape", [x])
        kept = self.op("Slice", [shape, self.longs([0]), self.longs([2])])
        sizes = self.op("Concat", [kept, size], axis=0)
        mode = {"mode": "linear", "coordinate_transformation_mode": "half_pixel"}
        self.put(name, 4, nchw=self.op("Resize", [x, "", "", sizes], **mode))

    def op_MaxPool(self, name: str, at: Attributes, inputs: list[str]) -> None:
        kernel, strides = integers(at["ksize"])[1:3], integers(at["strides"])[1:3]
        if text(at["padding"]["s"]) != "SAME" or strides != [1, 1]:
            raise NotImplementedError(f"MaxPool with strides or without padding: {name}")
        pads = [*((k - 1) // 2 for k in kernel), *(k // 2 for k in kernel)]
        x = self.nchw(inputs[0])
        self.put(name, 4, nchw=self.op("MaxPool", [x], kernel_shape=kernel, strides=strides, pads=pads))

    def op_Squeeze(self, name: str, at: Attributes, inputs: list[str]) -> None:
        axes, rank, x = integers(at["squeeze_dims"]), self.rank(inputs[0]), self.nhwc(inputs[0])
        shrunk = None if rank is None else rank - len(axes)
        self.put(name, shrunk, nhwc=self.op("Squeeze", [x, self.longs(axes)]))

    def op_ExpandDims(self, name: str, at: Attributes, inputs: list[str]) -> None:
        rank, x = self.rank(inputs[0]), self.nhwc(inputs[0])
        axes = self.longs(self.known(inputs[1]).reshape(-1))
        self.put(name, None if rank is None else rank + 1, nhwc=self.op("Unsqueeze", [x, axes]))

    def op_Reshape(self, name: str, at: Attributes, inputs: list[str]) -> None:
        constant = self.value(inputs[1]).get("const")
        shape = self.as_int64(self.nhwc(inputs[1])) if constant is None else self.longs(constant)
        x = self.nhwc(inputs[0])
        self.put(name, None if constant is None else len(constant), nhwc=self.op("Reshape", [x, shape]))

    def op_Pack(self, name: str, at: Attributes, inputs: list[str]) -> None:
        axis, rank = int(at.get("axis", {}).get("i", 0) or 0), self.rank(inputs[0])
        parts = [self.op("Unsqueeze", [self.nhwc(i), self.longs([axis])]) for i in inputs]
        self.put(name, None if rank is None else rank + 1, nhwc=self.op("Concat", parts, axis=axis))

    def op_Unpack(self, name: str, at: Attributes, inputs: list[str]) -> None:
        axis, count = int(at.get("axis", {}).get("i", 0) or 0), int(at["num"]["i"])
        rank = self.rank(inputs[0])
        for k, out in enumerate(self.split_op("Split", [self.nhwc(inputs[0])], count, axis=axis)):
            squeezed = self.op("Squeeze", [out, self.longs([axis])])
            self.put(f"{name}:{k}" if k else name, None if rank is None else rank - 1, nhwc=squeezed)

    def op_Split(self, name: str, at: Attributes, inputs: list[str]) -> None:
        axis, x = int(self.known(inputs[0])), self.nhwc(inputs[1])
        for k, out in enumerate(self.split_op("Split", [x], int(at["num_split"]["i"]), axis=axis)):
            self.put(f"{name}:{k}" if k else name, self.rank(inputs[1]), nhwc=out)

    def op_ConcatV2(self, name: str, at: Attributes, inputs: list[str]) -> None:
        axis, parts = int(self.known(inputs[-1])), [self.nhwc(i) for i in inputs[:-1]]
        self.put(name, self.rank(inputs[0]), nhwc=self.op("Concat", parts, axis=axis))

    def op_TopKV2(self, name: str, at: Attributes, inputs: list[str]) -> None:
        x, count = self.nhwc(inputs[0]), self.longs([int(self.known(inputs[1]))])
        values, indices = self.split_op("TopK", [x, count], 2, axis=-1, largest=1, sorted=1)
        self.put(name, self.rank(inputs[0]), nhwc=values)
        self.put(name + ":1", self.rank(inputs[0]), nhwc=self.as_int32(indices))

    def op_AddN(self, name: str, at: Attributes, inputs: list[str]) -> None:
        out = self.nhwc(inputs[0])
        for other in inputs[1:]:
            out = self.op("Add", [out, self.nhwc(other)])
        self.put(name, self.rank(inputs[0]), nhwc=out)

    def op_Range(self, name: str, at: Attributes, inputs: list[str]) -> None:
        self.put(name, 1, nhwc=self.op("Range", [self.nhwc(i) for i in inputs]))

    def op_Tile(self, name: str, at: Attributes, inputs: list[str]) -> None:
        constant, rank = self.value(inputs[1]).get("const"), self.rank(inputs[0])
        times = self.as_int64(self.nhwc(inputs[1])) if constant is None else self.longs(constant)
        self.put(name, rank, nhwc=self.op("Tile", [self.nhwc(inputs[0]), times]))

    def op_Fill(self, name: str, at: Attributes, inputs: list[str]) -> None:
        shape, value = self.as_int64(self.nhwc(inputs[0])), self.nhwc(inputs[1])
        self.put(name, None, nhwc=self.op("Expand", [value, shape]))

    def op_GatherNd(self, name: str, at: Attributes, inputs: list[str]) -> None:
        x, where = self.nhwc(inputs[0]), self.as_int64(self.nhwc(inputs[1]))
        self.put(name, None, nhwc=self.op("GatherND", [x, where]))

    def op_Select(self, name: str, at: Attributes, inputs: list[str]) -> None:
        self.put(name, self.rank(inputs[1]), nhwc=self.op("Where", [self.nhwc(i) for i in inputs]))

    def op_ArgMax(self, name: str, at: Attributes, inputs: list[str]) -> None:
        rank, axis, x = self.rank(inputs[0]), int(self.known(inputs[1])), self.nhwc(inputs[0])
        out = self.as_int32(self.op("ArgMax", [x], axis=axis, keepdims=0))
        self.put(name, None if rank is None else rank - 1, nhwc=out)

    def op_Sum(self, name: str, at: Attributes, inputs: list[str]) -> None:
        axes, rank, x = self.known(inputs[1]).reshape(-1), self.rank(inputs[0]), self.nhwc(inputs[0])
        out = self.op("ReduceSum", [x, self.longs(axes)], keepdims=int(at["keep_dims"]["b"]))
        self.put(name, rank if at["keep_dims"]["b"] or rank is None else rank - len(axes), nhwc=out)

    def op_Max(self, name: str, at: Attributes, inputs: list[str]) -> None:
        axes, rank, x = self.known(inputs[1]).reshape(-1), self.rank(inputs[0]), self.nhwc(inputs[0])
        out = self.op("ReduceMax", [x], axes=axes.tolist(), keepdims=int(at["keep_dims"]["b"]))
        self.put(name, rank if at["keep_dims"]["b"] or rank is None else rank - len(axes), nhwc=out)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("json", type=Path, help="model.json, its .bin files beside it")
    parser.add_argument("out", type=Path, help="the ONNX file to write")
    arguments = parser.parse_args()
    model = Converter(arguments.json).run()
    onnx.save(model, str(arguments.out))
    print(f"{arguments.out}: {arguments.out.stat().st_size} bytes, {len(model.graph.node)} nodes")


if __name__ == "__main__":
    main()
