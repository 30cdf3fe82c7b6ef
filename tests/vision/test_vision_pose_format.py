"""Pose networks of other kinds: tiny ones with the signatures of the real ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto
from pose_networks import BOX, POINTS, H, W, movenet_multi, movenet_single, red, save, yolo, yolo_distinct

from vad.errors import VadError
from vad.vision.people import PoseNetwork
from vad.vision.pose_format import overlap

NETWORKS = {
    "movenet-multi, any size": (movenet_multi(), [1, "h", "w", 3], TensorProto.INT32, False),
    "movenet-multi, fixed": (movenet_multi(), [1, H, W, 3], TensorProto.UINT8, False),
    "movenet-multi of floats": (movenet_multi(), [1, H, W, 3], TensorProto.FLOAT, False),
    "movenet-single": (movenet_single(), [1, H, W, 3], TensorProto.INT32, False),
    "yolo": (yolo(), [1, 3, H, W], TensorProto.FLOAT, True),
    "yolo, any size": (yolo(), [1, 3, "h", "w"], TensorProto.FLOAT, True),
    "yolo-distinct": (yolo_distinct(), [1, 3, H, W], TensorProto.FLOAT, True),
}


@pytest.mark.parametrize("name", NETWORKS)
def test_every_known_kind_gives_the_same_person(name: str, tmp_path: Path) -> None:
    output, shape, dtype, nchw = NETWORKS[name]
    network = PoseNetwork(save(tmp_path / "net.onnx", output, shape, dtype, nchw=nchw), input_size=(H, W))
    assert network.takes_any_size == ("any size" in name)
    (person,) = network.infer(red())
    assert person.keypoints[:, :2] == pytest.approx(POINTS[:, :2], abs=1e-3)
    if "single" not in name:
        assert person.box == pytest.approx(BOX, abs=1e-3)
        assert person.keypoints[:, 2].min() > 0.3
    else:
        assert person.box[1] < 40 < 200 < person.box[3]
    # The score follows the red channel: blue is not red, and half as red is half as sure.
    blue = red()[:, :, ::-1].copy()
    assert network.infer(blue) == []
    (half,) = network.infer(red(128), score_min=0.0)[:1]
    assert half.score == pytest.approx(person.score * 128 / 255, rel=0.02)


@pytest.mark.parametrize("name", ["movenet-multi, fixed", "yolo"])
def test_points_lie_in_the_pixels_of_a_picture_twice_as_large(name: str, tmp_path: Path) -> None:
    output, shape, dtype, nchw = NETWORKS[name]
    network = PoseNetwork(save(tmp_path / "net.onnx", output, shape, dtype, nchw=nchw))
    large = np.repeat(np.repeat(red(), 2, axis=0), 2, axis=1)
    (person,) = network.infer(large)
    # A pixel's middle is its coordinate: k becomes 2 k + 0.5.
    assert person.keypoints[:, :2] == pytest.approx(2 * POINTS[:, :2] + 0.5, abs=1e-3)


def test_a_piece_of_the_picture_is_placed_where_it_came_from(tmp_path: Path) -> None:
    output, shape, dtype, nchw = NETWORKS["movenet-multi, any size"]
    network = PoseNetwork(save(tmp_path / "net.onnx", output, shape, dtype, nchw=nchw))
    picture = np.zeros((600, 800, 3), np.uint8)
    picture[:, :, 2] = 255
    # The person fills 0.7 of the piece's height, so the piece is 256 high at a scale of 1.
    box = (400.0 - 30, 300.0 - 89.6, 400.0 + 30, 300.0 + 89.6)
    found = network.follow(picture, box, (H, W))
    assert found is not None
    inside = POINTS[:, :2] - ((W - 1) / 2, (H - 1) / 2)
    assert found.keypoints[:, :2] == pytest.approx(np.add(inside, (400, 300)), abs=0.6)
    # Somebody else, far from the known box, is not the person looked for.
    assert network.follow(picture, (100.0, 100.0, 110.0, 400.0), (H, W)) is None


def test_a_network_of_another_kind_is_refused_with_its_shapes(tmp_path: Path) -> None:
    classifier = np.zeros((1, 1000), np.float32)
    path = save(tmp_path / "net.onnx", classifier, [1, 3, 224, 224], TensorProto.FLOAT, nchw=True)
    with pytest.raises(VadError, match="no pose network known") as refused:
        PoseNetwork(path)
    assert "[1, 1000]" in str(refused.value)


def test_overlap_is_1_with_itself_and_0_apart() -> None:
    boxes = np.array([BOX, BOX + 1000, [60.0, 30.0, 120.0, 120.0]])
    assert overlap(BOX, boxes) == pytest.approx([1.0, 0.0, 0.5])
