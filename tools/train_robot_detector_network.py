"""The robot detector's network: the first blocks of MoveNet's MobileNetV2, frozen, and a head of our own.

The blocks have learnt on photographs what surfaces and edges look like; the head learns on renders alone
what a robot vacuum is. Runs in torch (a tool's dependency, never the package's).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import nn
from torch.nn import functional

TAPS = {4: "add_44", 8: "add_82", 16: "add_132"}
TAP_CHANNELS = {4: 40, 8: 48, 16: 96}
STRIDE = 8
"""Pixels of the input per cell of the output."""


class Backbone(nn.Module):
    """The part of MoveNet's ONNX graph up to its last tap: uint8 BGR NHWC -> {stride: features}."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        graph = onnx.load(str(path)).graph
        self._values: dict[str, np.ndarray] = {i.name: numpy_helper.to_array(i) for i in graph.initializer}
        self._steps: list[tuple[str, list[str], str, dict[str, object]]] = []
        self._input = graph.input[0].name
        wanted, needed = set(TAPS.values()), []
        for node in reversed(graph.node):
            if wanted & set(node.output):
                wanted |= set(node.input)
                needed.append(node)
        for node in reversed(needed):
            attributes = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
            names = list(node.input)
            if node.op_type == "Constant":
                self._values[node.output[0]] = numpy_helper.to_array(attributes["value"])
            elif node.op_type == "Cast" and names[0] in self._values:
                self._values[node.output[0]] = self._values[names[0]].astype(np.float32)
            else:
                self._steps.append((node.op_type, names, node.output[0], attributes))
        for name in {n for _, names, _, _ in self._steps for n in names if n in self._values}:
            self.register_buffer("_" + name, torch.from_numpy(np.array(self._values[name], np.float32)))

    def _get(self, name: str, seen: dict[str, torch.Tensor]) -> torch.Tensor:
        return seen[name] if name in seen else getattr(self, "_" + name)

    def forward(self, bgr: torch.Tensor) -> dict[int, torch.Tensor]:
        seen = {self._input: bgr.flip(3).float()}
        for kind, names, output, attributes in self._steps:
            a = self._get(names[0], seen)
            if kind == "Conv":
                weight = self._get(names[1], seen)
                bias = self._get(names[2], seen) if len(names) > 2 else None
                stride, groups = attributes.get("strides", [1, 1])[0], int(attributes.get("group", 1))
                pads = attributes.get("pads", [0, 0, 0, 0])
                auto = attributes.get("auto_pad", b"NOTSET")
                if auto == b"SAME_UPPER" or (auto == b"NOTSET" and stride == 2 and not any(pads)):
                    a, pads = functional.pad(a, (0, 1, 0, 1)), [0, 0, 0, 0]  # even sides only
                elif len(set(pads)) > 1:
                    a, pads = functional.pad(a, (pads[1], pads[3], pads[0], pads[2])), [0, 0, 0, 0]
                seen[output] = functional.conv2d(a, weight, bias, stride, pads[0], groups=groups)
            elif kind == "Clip":
                seen[output] = functional.relu6(a)
            elif kind == "Relu":
                seen[output] = functional.relu(a)
            elif kind in ("Add", "Sub", "Mul"):
                b = self._get(names[1], seen)
                seen[output] = a + b if kind == "Add" else (a - b if kind == "Sub" else a * b)
            elif kind == "Transpose":
                seen[output] = a.permute(*attributes["perm"])
            elif kind == "Cast":
                seen[output] = a
            else:
                raise ValueError(f"{kind} is not known here")
        return {stride: seen[name] for stride, name in TAPS.items()}


def _block(channels_in: int, channels: int, dilation: int = 1, stride: int = 1) -> nn.Sequential:
    """Depthwise 3x3 and pointwise convolution."""
    return nn.Sequential(
        nn.Conv2d(channels_in, channels_in, 3, stride, dilation, dilation, channels_in, bias=False),
        nn.BatchNorm2d(channels_in),
        nn.ReLU(),
        nn.Conv2d(channels_in, channels, 1, bias=False),
        nn.BatchNorm2d(channels),
        nn.ReLU(),
    )


class Head(nn.Module):
    """Features -> heat (1) and box (6): offset of the middle in cells, log width and height in input pixels,
    offset of the floor contact in cells."""

    def __init__(self, width: int = 96) -> None:
        super().__init__()
        self.drop = nn.Dropout2d(0.1)
        self.deep = nn.Sequential(
            nn.Conv2d(TAP_CHANNELS[16], width, 1, bias=False), nn.BatchNorm2d(width), nn.ReLU()
        )
        self.context = nn.ModuleList([_block(width, width, d) for d in (1, 2, 4, 8)])
        self.middle = nn.Sequential(nn.Conv2d(TAP_CHANNELS[8], width, 1, bias=False), nn.BatchNorm2d(width))
        self.fine = _block(TAP_CHANNELS[4], width // 2, stride=2)
        self.join = nn.Sequential(
            _block(width + width // 2, width), _block(width, width, 2), _block(width, width)
        )
        self.heat, self.box = nn.Conv2d(width, 1, 1), nn.Conv2d(width, 6, 1)
        nn.init.constant_(self.heat.bias, -4.6)
        nn.init.constant_(self.box.bias, 0.0)

    def forward(self, taps: dict[int, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        x = self.deep(self.drop(taps[16]))
        for block in self.context:
            x = x + block(x)
        x = functional.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)
        x = functional.relu(x + self.middle(self.drop(taps[8])))
        x = self.join(torch.cat([x, self.fine(self.drop(taps[4]))], 1))
        return self.heat(x), self.box(x)


class Detector(nn.Module):
    """What is exported: uint8 BGR (1, H, W, 3), sides multiples of 16 -> (1, 7, H/8, W/8), the mean of
    what is seen in the picture and in its mirror image.

    Channels: heat 0..1; in input pixels: middle x and y, width, height, floor contact x and y.
    """

    def __init__(self, backbone: Backbone, head: Head) -> None:
        super().__init__()
        self.backbone, self.head = backbone, head

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        heat, box = self.head(self.backbone(torch.cat([image, image.flip(2)])))
        # What is seen in the mirror, too, is better founded; offsets along x change their sign there.
        sign = torch.tensor([-1.0, 1.0, 1.0, 1.0, -1.0, 1.0]).reshape(1, 6, 1, 1)
        heat = (heat[0:1] + heat[1:2].flip(3)) / 2
        box = (box[0:1] + box[1:2].flip(3) * sign) / 2
        ones = torch.ones_like(heat)
        cell = torch.cat([torch.cumsum(ones, 3), torch.cumsum(ones, 2)], 1) - 0.5
        middle, contact = ((cell + offset) * STRIDE - 0.5 for offset in (box[:, 0:2], box[:, 4:6]))
        return torch.cat([heat.sigmoid(), middle, box[:, 2:4].clamp(-1.0, 7.0).exp(), contact], 1)
