"""V4L2 and Kinect v2 through a real kernel: vivid, uvcvideo and usbfs in the guest of tools/guest."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from guest_world import Guest

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3000)]

FRAMES = 12


@pytest.fixture(scope="module")
def report(guest: Guest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What vad's adapters saw in the guest."""
    folder = tmp_path_factory.mktemp("cameras")
    for file in (Path(__file__).parent / "cameras").iterdir():
        if file.is_file():
            shutil.copy(file, folder)
    subprocess.run([sys.executable, str(folder / "pictures.py"), str(folder)], check=True)
    done = guest(folder, timeout_s=2400)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    found: dict[str, Any] = json.loads((folder / "report.json").read_text())
    return found


@pytest.mark.parametrize(
    ("kind", "detail", "shape", "noticed"),
    [
        ("vivid", "640x360 YUYV, stamps: driver", [360, 640, 3], ("stopped sending", "no such camera")),
        ("uvc", "640x480 MJPG, stamps: driver", [480, 640, 3], ("stopped sending", "no such camera")),
        ("kinect", "Kinect v2, 960x540, stamps: sensor", [540, 960, 3], ("unplugged", "no Kinect v2")),
    ],
)
def test_frames_unplug_replug(
    report: dict[str, Any], kind: str, detail: str, shape: list[int], noticed: tuple[str, str]
) -> None:
    seen = report[kind]
    assert seen["detail"] == detail
    assert any(words in seen["noticed"] for words in noticed)
    assert seen["state"] == "ok"
    assert seen["counters"]["reopens"] >= 1
    assert seen["threads"] == []
    for part in (seen["before"], seen["after"]):
        assert part["frames"] >= FRAMES
        assert part["shape"] == shape
        assert part["seqs"] == list(range(part["seqs"][0], part["seqs"][0] + part["frames"]))
        assert (np.diff(part["t_ns"]) > 0).all()
        assert min(part["age_ms"]) >= 0.0  # stamped before they came
    assert seen["after"]["t_ns"][0] > seen["before"]["t_ns"][-1]


@pytest.mark.parametrize("kind", ["uvc", "kinect"])
def test_pictures_are_the_ones_sent_and_carry_their_times(report: dict[str, Any], kind: str) -> None:
    seen = report[kind]
    sent = {int(k): t_ns for k, t_ns in seen["sent"].items()}
    for part in (seen["before"], seen["after"]):
        late_ms = []
        for shown, t_ns in zip(part["numbers"], part["t_ns"], strict=True):
            same = [t for k, t in sent.items() if k % seen["kinds"] == shown]
            late_ms.append(1e-6 * min((t_ns - t for t in same), key=abs))
        # None twice; the stamp is when the device sent the picture, however late an emulated processor came
        # to show it.
        assert (np.diff(part["numbers"]) % seen["kinds"] >= 1).all()
        assert np.abs(np.median(late_ms)) < 150.0
        assert np.percentile(np.abs(np.array(late_ms) - np.median(late_ms)), 90) < 100.0
