#!/usr/bin/env python3
"""Trains the packaged robot detector from rendered rooms only, and writes vad/vision/models/robot.onnx.

    python -m venv /tmp/train
    /tmp/train/bin/pip install numpy numba opencv-python-headless onnx onnxruntime torch
    /tmp/train/bin/python tools/train_robot_detector.py render --out /tmp/rooms --count 4000   # 1 s each
    /tmp/train/bin/python tools/train_robot_detector.py train --rooms /tmp/rooms --out /tmp/robot.pt
    /tmp/train/bin/python tools/train_robot_detector.py export --weights /tmp/robot.pt

None of these packages but numpy, OpenCV and ONNX Runtime is needed to run the detector.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import deque
from multiprocessing import Pool
from pathlib import Path

import cv2
import numpy as np

BACKBONE = Path(__file__).resolve().parents[1] / "vad" / "vision" / "models" / "movenet-multipose.onnx"
PACKAGED = BACKBONE.with_name("robot.onnx")
INPUT = (288, 384)
STRIDE = 8
_KEPT = 1024
_AVERAGE = 0.985  # what is kept is the mean of the last steps' weights
WITHOUT_ROBOT = 3  # every third room


def _render_one(job: tuple[int, Path]) -> dict[str, object] | None:
    from train_robot_detector_scenes import picture

    cv2.setNumThreads(1)
    seed, out = job
    found = picture(seed, seed % WITHOUT_ROBOT != 0)
    if found is None:
        return None
    cv2.imwrite(str(out / f"{seed}.jpg"), found.image, [cv2.IMWRITE_JPEG_QUALITY, 96])
    places = {
        "boxes": found.boxes.tolist(),
        "contacts": found.contacts.tolist(),
        "visible": found.visible.tolist(),
    }
    return {"file": f"{seed}.jpg", **places}


def render(arguments: argparse.Namespace) -> None:
    """Pictures and labels.jsonl."""
    arguments.out.mkdir(parents=True, exist_ok=True)
    jobs = [(arguments.seed + k, arguments.out) for k in range(arguments.count)]
    start = time.monotonic()
    with (
        Pool(arguments.workers) as pool,
        (arguments.out / "labels.jsonl").open("a", encoding="utf-8") as labels,
    ):
        for done, row in enumerate(pool.imap_unordered(_render_one, jobs), 1):
            if row is not None:
                labels.write(json.dumps(row) + "\n")
                labels.flush()
            if done % 100 == 0:
                print(
                    f"{done} of {arguments.count}, {(time.monotonic() - start) / done:.2f} s each", flush=True
                )


def load(folder: Path) -> list[tuple[Path, np.ndarray]]:
    """Pictures with (N, 6) of the robots that can be seen: box and floor contact."""
    rows = []
    for file in sorted(folder.glob("labels*.jsonl")):
        for line in file.read_text(encoding="utf-8").splitlines():
            row = json.loads(line)
            robots = np.hstack(
                [np.array(row["boxes"]).reshape(-1, 4), np.array(row["contacts"]).reshape(-1, 2)]
            )
            rows.append((folder / row["file"], robots[np.array(row["visible"]) > 0.25]))
    return rows


def augment(image: np.ndarray, boxes: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Cut, mirror, recolour, blur, noise, JPEG: what cameras do to pictures."""
    height, width = image.shape[:2]
    scale = INPUT[1] / (width * rng.uniform(0.6, 1.0))
    room_x, room_y = width * scale - INPUT[1], height * scale - INPUT[0]
    squeeze = rng.uniform(0.85, 1.15)
    matrix = np.array(
        [[scale, 0, -rng.uniform(0, 1) * room_x], [0, scale * squeeze, -rng.uniform(0, 1) * room_y]]
    )
    out = cv2.warpAffine(image, matrix, INPUT[::-1], flags=cv2.INTER_AREA, borderMode=cv2.BORDER_REFLECT_101)
    if len(boxes):
        boxes = boxes * np.tile(np.diag(matrix[:, :2]), 3) + np.tile(matrix[:, 2], 3)
        cut = boxes[:, :4].clip(0, [INPUT[1] - 1, INPUT[0] - 1] * 2)
        area = np.prod(boxes[:, 2:4] - boxes[:, :2], axis=1)
        left = np.prod(np.maximum(cut[:, 2:] - cut[:, :2], 0), axis=1)
        boxes = np.hstack([cut, boxes[:, 4:]])[left > 0.4 * area]
    if rng.random() < 0.5:
        out = out[:, ::-1]
        last = INPUT[1] - 1
        x0, y0, x1, y1, x, y = boxes.T
        boxes = np.column_stack([last - x1, y0, last - x0, y1, last - x, y])
    out = np.ascontiguousarray(out)
    if rng.random() < 0.4:
        stick(out, boxes, rng)
    x = out.astype(np.float32) / 255.0
    if rng.random() < 0.7:
        x = x ** rng.uniform(0.6, 1.6)
    if rng.random() < 0.6:
        grey = x.mean(2, keepdims=True)
        x = grey + (x - grey) * rng.uniform(0.0, 1.5)
    if rng.random() < 0.6:
        x = x * rng.uniform(0.85, 1.15, 3).astype(np.float32)
    if rng.random() < 0.5:
        x = (x - 0.5) * rng.uniform(0.6, 1.4) + 0.5 + rng.uniform(-0.12, 0.12)
    if rng.random() < 0.3:
        x = x + rng.uniform(0, 0.35) * cv2.GaussianBlur(np.maximum(x - 0.7, 0), (0, 0), 12.0)
    pick = rng.random()
    if pick < 0.5:
        x = cv2.GaussianBlur(x, (0, 0), rng.uniform(0.3, 1.6))
    elif pick < 0.6:
        kernel = np.zeros((9, 9), np.float32)
        kernel[4, : int(rng.integers(2, 10))] = 1.0
        x = cv2.filter2D(x, -1, kernel / kernel.sum())
    elif pick < 0.75:
        x = x + rng.uniform(0.2, 1.0) * (x - cv2.GaussianBlur(x, (0, 0), 1.2))
    if rng.random() < 0.5:
        x = x + rng.normal(0, rng.uniform(0, 0.05), x.shape)
    out = (x.clip(0, 1) * 255).astype(np.uint8)
    if rng.random() < 0.5:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(25, 95))]
        out = cv2.imdecode(cv2.imencode(".jpg", out, quality)[1], cv2.IMREAD_COLOR)
    return np.ascontiguousarray(out), boxes


def stick(image: np.ndarray, boxes: np.ndarray, rng: np.random.Generator) -> None:
    """Flat things without any side to them, in place: signs, logos, painted discs, beams. None is a robot."""
    height, width = image.shape[:2]
    for _ in range(int(rng.integers(1, 5))):
        x, y = int(rng.integers(0, width)), int(rng.integers(0, height))
        w = int(np.exp(rng.uniform(np.log(8), np.log(90))))
        h = max(3, int(w * rng.uniform(0.15, 1.1)))
        if len(boxes) and np.any(
            (boxes[:, 0] < x + w) & (boxes[:, 2] > x - w) & (boxes[:, 1] < y + h) & (boxes[:, 3] > y - h)
        ):
            continue
        paint = (
            [int(v) for v in rng.integers(0, 256, 3)]
            if rng.random() < 0.5
            else [int(rng.integers(0, 256))] * 3
        )
        other = [int(v) for v in rng.integers(0, 256, 3)]
        pick, turn = rng.random(), float(rng.uniform(0, 180)) * (rng.random() < 0.2)
        if pick < 0.55:
            cv2.ellipse(image, (x, y), (w, h), turn, 0, 360, paint, -1, cv2.LINE_AA)
            if rng.random() < 0.5:
                ring = (max(1, int(w * 0.8)), max(1, int(h * 0.8)))
                cv2.ellipse(
                    image, (x, y), ring, turn, 0, 360, other, int(rng.choice([-1, 1, 2, 4])), cv2.LINE_AA
                )
        elif pick < 0.75:
            cv2.rectangle(image, (x - w, y - h), (x + w, y + h), paint, int(rng.choice([-1, 2, 5])))
        else:
            cv2.line(
                image, (x - 2 * w, y - h), (x + 2 * w, y + h), paint, int(rng.integers(1, 12)), cv2.LINE_AA
            )
        if rng.random() < 0.4:
            word = "".join(chr(c) for c in rng.integers(65, 123, int(rng.integers(1, 10))))
            cv2.putText(image, word, (x - w, y + h // 3), int(rng.integers(0, 8)), w / 60, other,
                        int(rng.integers(1, 4)), cv2.LINE_AA)  # fmt: skip


def targets(boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Heat (h, w), box (6, h, w) and how much the box counts (h, w)."""
    rows, columns = INPUT[0] // STRIDE, INPUT[1] // STRIDE
    heat, box = np.zeros((rows, columns), np.float32), np.zeros((6, rows, columns), np.float32)
    counts = np.zeros((rows, columns), np.float32)
    y, x = np.mgrid[0:rows, 0:columns]
    for x0, y0, x1, y1, floor_x, floor_y in boxes:
        cx, cy = ((x0 + x1) / 2 + 0.5) / STRIDE - 0.5, ((y0 + y1) / 2 + 0.5) / STRIDE - 0.5
        sx, sy = max((x1 - x0) / STRIDE / 7, 0.7), max((y1 - y0) / STRIDE / 7, 0.7)
        near = np.exp(-0.5 * (((x - cx) / sx) ** 2 + ((y - cy) / sy) ** 2)).astype(np.float32)
        i, j = min(max(round(cy), 0), rows - 1), min(max(round(cx), 0), columns - 1)
        near[i, j] = 1.0
        inside = (near > 0.5) & (near > heat)
        sizes = [np.full_like(near, np.log(max(side, 1.0))) for side in (x1 - x0, y1 - y0)]
        floor = [(floor_x + 0.5) / STRIDE - 0.5 - x, (floor_y + 0.5) / STRIDE - 0.5 - y]
        values = [cx - x, cy - y, *sizes, *floor]
        box[:, inside] = np.stack(values)[:, inside]
        counts[inside] = near[inside]
        heat = np.maximum(heat, near)
    return heat, box, counts


def train(arguments: argparse.Namespace) -> None:
    """The head only; the features come from ONNX Runtime, which is faster than torch on a CPU."""
    import onnx
    import onnxruntime
    import torch
    from torch.nn import functional
    from train_robot_detector_network import TAPS, Head

    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(1)
    torch.manual_seed(arguments.seed)
    model = onnx.load(str(BACKBONE))
    del model.graph.output[:]
    model.graph.output.extend([onnx.helper.make_empty_tensor_value_info(name) for name in TAPS.values()])
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = arguments.threads
    options.log_severity_level = 3
    extract = onnxruntime.InferenceSession(
        model.SerializeToString(), options, providers=["CPUExecutionProvider"]
    )
    rooms = [room for folder in arguments.rooms for room in load(folder)]
    rng = np.random.default_rng(arguments.seed)
    head = Head()
    if arguments.start is not None:
        head.load_state_dict(torch.load(arguments.start))
    head = head.to(memory_format=torch.channels_last)  # half as much time on a CPU
    head.train()
    average = torch.optim.swa_utils.AveragedModel(
        head, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(_AVERAGE), use_buffers=True
    )
    optimiser = torch.optim.AdamW(head.parameters(), lr=arguments.rate, weight_decay=1e-3)
    steps = int(arguments.epochs * len(rooms) / max(1, arguments.batch // arguments.reuse))
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, arguments.rate, total_steps=steps, pct_start=0.15
    )
    print(
        f"{len(rooms)} rooms, {steps} steps, {sum(p.numel() for p in head.parameters())} weights", flush=True
    )
    order: list[int] = []
    kept: deque[tuple[list[np.ndarray], tuple[np.ndarray, ...]]] = deque(maxlen=_KEPT)
    mean, start = np.zeros(2), time.monotonic()
    for step in range(1, steps + 1):
        fresh = []
        for _ in range(max(1, arguments.batch // arguments.reuse)):
            if not order:
                order = rng.permutation(len(rooms)).tolist()
            path, boxes = rooms[order.pop()]
            image, boxes = augment(cv2.imread(str(path)), boxes, rng)
            seen = extract.run(list(TAPS.values()), {"input": image[None, :, :, ::-1].astype(np.int32)})
            fresh.append(([tap[0].astype(np.float16) for tap in seen], targets(boxes)))
        # Features cost more than the head: each is used several times, at random later on.
        again = rng.integers(len(kept), size=arguments.batch - len(fresh)) if kept else ()
        batch = [*fresh, *(kept[k] for k in again)]
        kept.extend(fresh)
        taps = {
            stride: np.stack([seen[k] for seen, _ in batch]).astype(np.float32)
            for k, stride in enumerate(TAPS)
        }
        wanted = [want for _, want in batch]
        heat, box = head(
            {
                k: torch.from_numpy(tap).contiguous(memory_format=torch.channels_last)
                for k, tap in taps.items()
            }
        )
        true, place, counts = (torch.from_numpy(np.stack(part)) for part in zip(*wanted, strict=True))
        logit = heat[:, 0]
        p = logit.sigmoid()
        hits = true >= 0.999
        loss_hit = -(functional.logsigmoid(logit) * (1 - p) ** 2)[hits].sum()
        loss_miss = -(functional.logsigmoid(-logit) * p**2 * (1 - true) ** 4)[~hits].sum()
        loss_heat = (loss_hit + loss_miss) / max(int(hits.sum()), 1)
        loss_box = (functional.smooth_l1_loss(box, place, reduction="none", beta=0.1).sum(1) * counts).sum()
        loss_box = loss_box / counts.sum().clamp(min=1.0)
        optimiser.zero_grad()
        (loss_heat + 0.5 * loss_box).backward()
        torch.nn.utils.clip_grad_norm_(head.parameters(), 5.0)
        optimiser.step()
        schedule.step()
        average.update_parameters(head)
        mean += (loss_heat.item(), loss_box.item())
        if step % 50 == 0 or step == steps:
            done = (time.monotonic() - start) / step
            print(
                f"{step}/{steps} heat {mean[0] / 50:.3f} box {mean[1] / 50:.3f} {done:.2f} s each", flush=True
            )
            mean[:] = 0
            torch.save(average.module.state_dict(), arguments.out)


def export(arguments: argparse.Namespace) -> None:
    """Backbone's first blocks and head as one file, weights in half precision, computed in single."""
    import onnx
    import torch
    from onnx import TensorProto, helper, numpy_helper
    from train_robot_detector_network import Backbone, Detector, Head

    head = Head()
    head.load_state_dict(torch.load(arguments.weights))
    net = Detector(Backbone(BACKBONE), head).eval()
    example = torch.zeros((1, *INPUT, 3), dtype=torch.uint8)
    torch.onnx.export(
        net, (example,), str(arguments.out), input_names=["image"], output_names=["robot"], opset_version=17,
        dynamic_axes={"image": {1: "height", 2: "width"}, "robot": {2: "rows", 3: "columns"}}, dynamo=False,
    )  # fmt: skip
    model = onnx.load(str(arguments.out))
    casts = []
    for tensor in model.graph.initializer:
        if tensor.data_type == TensorProto.FLOAT and np.prod(tensor.dims) >= 16:
            values, name = numpy_helper.to_array(tensor), tensor.name
            tensor.CopyFrom(numpy_helper.from_array(values.astype(np.float16), name + "_half"))
            casts.append(helper.make_node("Cast", [name + "_half"], [name], to=TensorProto.FLOAT))
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    model.producer_name, model.producer_version = "tools/train_robot_detector.py", ""
    entry = model.metadata_props.add()
    entry.key, entry.value = "vad.robot/1", "head trained on rendered data only"
    onnx.checker.check_model(model)
    onnx.save(model, str(arguments.out))
    print(f"{arguments.out}: {arguments.out.stat().st_size} bytes")


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    a = commands.add_parser("render", help="draw rooms")
    a.add_argument("--out", type=Path, required=True)
    a.add_argument("--count", type=int, default=4000)
    a.add_argument("--seed", type=int, default=1)
    a.add_argument("--workers", type=int, default=1)
    a.set_defaults(run=render)
    a = commands.add_parser("train", help="train the head")
    a.add_argument("--rooms", type=Path, nargs="+", required=True)
    a.add_argument("--out", type=Path, required=True)
    a.add_argument("--start", type=Path, help="weights to go on from")
    a.add_argument("--epochs", type=float, default=8.0)
    a.add_argument("--batch", type=int, default=16)
    a.add_argument("--reuse", type=int, default=3, help="how often each augmented picture is used")
    a.add_argument("--rate", type=float, default=2e-3)
    a.add_argument("--threads", type=int, default=1)
    a.add_argument("--seed", type=int, default=1)
    a.set_defaults(run=train)
    a = commands.add_parser("export", help="write the ONNX file")
    a.add_argument("--weights", type=Path, required=True)
    a.add_argument("--out", type=Path, default=PACKAGED)
    a.set_defaults(run=export)
    arguments = parser.parse_args()
    arguments.run(arguments)
    return 0


if __name__ == "__main__":
    sys.exit(main())
