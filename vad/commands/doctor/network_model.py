"""The network that sees people: is its file the right one, and is the machine fast enough for it."""

from __future__ import annotations

import asyncio
import hashlib
import os
import re
import time
from pathlib import Path
from statistics import median

import numpy as np

from vad.commands.doctor.visit import Finding, Visit
from vad.errors import VadError

_ROW = re.compile(r"\| `([^`]+)` \| .* \| `([0-9a-f]{64})` \|")
_LOOKS = 8
_BUSY = 0.6
"""Of what it may have: above this little is left for the rest."""
_HELD_UP = 2.0
_LEAST_FPS = 5


async def check_model(visit: Visit) -> list[Finding]:
    """Whether the packaged networks are what they were when they were packed."""
    from vad.vision.people import MODEL_PATH

    return await asyncio.to_thread(model_findings, MODEL_PATH.parent)


def model_findings(folder: Path) -> list[Finding]:
    """Compare the files of a folder with the hashes in its MODELS.md."""
    remedy = "Install vad anew: the file is damaged"
    try:
        rows = _ROW.findall((folder / "MODELS.md").read_text(encoding="utf-8"))
    except OSError as error:
        return [Finding("networks", "bad", f"MODELS.md: {error.strerror}", remedy)]
    findings = []
    for name, wanted in rows:
        file = folder / name
        if not file.is_file():
            findings.append(Finding("networks", "bad", f"{name} is missing", remedy))
        elif hashlib.sha256(file.read_bytes()).hexdigest() != wanted:
            findings.append(Finding("networks", "bad", f"{name} is not the one that was packed", remedy))
    return findings or [Finding("networks", "ok", f"{', '.join(name for name, _ in rows)}: as packed")]


async def check_processor(visit: Visit) -> list[Finding]:
    """Whether this machine looks at pictures as fast as the settings want: measured."""
    from vad.vision.people import PoseNetwork

    vision = visit.settings.vision
    path = None if vision.model is None else visit.resolve(vision.model)
    try:
        network = await asyncio.to_thread(PoseNetwork, path, threads=vision.threads)
    except VadError as error:
        return [Finding.of_error("processor", error)]
    picture = np.random.default_rng(1).integers(0, 255, (480, 640, 3), np.uint8)

    def look() -> tuple[float, float]:
        network.infer(picture)  # the first one makes room in memory
        wall_s, cpu_s = [], []
        for _ in range(_LOOKS):
            begun_s, used_s = time.perf_counter(), time.process_time()
            network.infer(picture)
            wall_s.append(time.perf_counter() - begun_s)
            cpu_s.append(time.process_time() - used_s)
        return median(wall_s), median(cpu_s)

    wall_s, cpu_s = await asyncio.to_thread(look)
    return [headroom(wall_s, cpu_s, vision.max_fps, vision.threads, os.cpu_count() or 1)]


def headroom(wall_s: float, cpu_s: float, fps: float, threads: int, cores: int) -> Finding:
    """What one picture costs. wall_s: on the clock; cpu_s: of processor time; threads: that share it."""
    told = f"a picture takes {cpu_s * 1e3:.0f} ms: {fps:g} a second are {cpu_s * fps * 100:.0f} % of a core"
    most = int(_BUSY * threads / cpu_s + 1e-6)
    remedy = f"Set vision: max_fps: {most}" if most >= _LEAST_FPS else "A faster machine is needed"
    if cpu_s * fps > min(threads, cores):
        return Finding("processor", "bad", f"{told}, more than there is for it", remedy)
    if cpu_s * fps > _BUSY * min(threads, cores):
        return Finding("processor", "warning", f"{told}: little is left", remedy)
    if wall_s > _HELD_UP * cpu_s:
        what = f"{told}, but other programs make each take {wall_s * 1e3:.0f} ms"
        return Finding("processor", "warning", what, "See what else runs: top")
    return Finding("processor", "ok", f"{told}, of {cores}")
