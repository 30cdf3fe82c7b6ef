#!/usr/bin/env python3
"""Stage 1 on simulated drives: how well the robot's drive tells where the camera is, the truth beside it.

Rooms, lenses, paths and noise are fixed by their seeds: a run repeats, but for the seconds.
"""

from __future__ import annotations

import argparse
import json
import os
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from functools import partial

import numpy as np
from bench_camera_cases import FRAME_HZ, VARIANTS, Score, Variant, drive_of, rendered, solve
from bench_camera_moved import Noticed, room
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from vad.sim.camera_drive import DRIVE_SHAPES, DriveShape
from vad.vision.people import PoseNetwork

NICENESS = 10
# The renders of one drive serve these variants; a lens off its centre would be another set of frames.
RENDERED_VARIANTS = tuple(v for v in VARIANTS if v.centred)
LEGEND = (
    "Mean / worst over the seeds. floor: the camera's floor point of the robot's true pixel from the robot's "
    "true place, cm; seen: the same for the found robot, the finder's noise included; stated: what the "
    "calibration itself says robot and camera differ by, the poses' own 2 cm per axis included; position: of "
    "the camera, cm; bound: least rms error of the position under this noise (Cramér-Rao), cm; NEES: squared "
    "error over stated variance, 1 is true. All drives count, valid or not."
)


def score_drive(
    case: tuple[str, DriveShape, int], *, laps: int, variants: tuple[Variant, ...]
) -> list[Score]:
    """One drive under every variant."""
    source, shape, seed = case
    scores = []
    if source == "rendered":
        usable = [v for v in variants if v in RENDERED_VARIANTS]
        drive = drive_of(shape, seed, laps, usable[0])
        frames = rendered(drive, PoseNetwork(threads=1))
        return [solve(source, variant, seed, drive, frames) for variant in usable]
    for variant in variants:
        drive = drive_of(shape, seed, laps, variant)
        frames = drive.candidates(np.random.default_rng([seed, 0xCA]), rate_hz=FRAME_HZ)
        scores.append(solve(source, variant, seed, drive, frames))
    return scores


def table_of(title: str, groups: dict[str, list[Score]]) -> Table:
    """One variant's table, a row for each path."""
    table = Table(title=title, title_justify="left", box=None)
    for name in ("path", "valid", "floor cm", "seen cm", "stated cm", "focal %", "offset ms", "position cm"):
        table.add_column(name, justify="left" if name == "path" else "right", no_wrap=True)
    for name in ("bound", "NEES", "CPU s"):
        table.add_column(name, justify="right", no_wrap=True)

    def both(values: list[float], scale: float, digits: int) -> str:
        size = np.abs(np.array(values)) * scale
        if not np.isfinite(size).any():
            return "–"
        return f"{np.nanmean(size):.{digits}f} / {np.nanmax(size):.{digits}f}"

    for shape, scores in groups.items():
        valid = [s for s in scores if s.status == "valid"]
        table.add_row(
            shape,
            f"{len(valid)}/{len(scores)}",
            both([s.deviation_m for s in scores], 100.0, 1),
            both([s.seen_m for s in scores], 100.0, 1),
            both([s.stated_m for s in scores], 100.0, 1),
            both([s.focal for s in scores], 100.0, 1),
            both([s.offset_s for s in scores], 1000.0, 0),
            both([s.position_m for s in scores], 100.0, 1),
            f"{100 * np.sqrt(np.nanmean(np.square([s.bound_m for s in scores]))):.1f}",
            f"{np.nanmean([s.position_nees for s in scores]):.1f}",
            f"{np.mean([s.solve_s for s in scores]):.2f}",
        )
    return table


def _moved(seeds: int, jobs: int, *, as_json: bool) -> None:
    """Whether and when a moved camera is noticed, over rooms."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    rows: list[Noticed] = []
    with ProcessPoolExecutor(jobs) as pool, Progress(*columns, console=Console(stderr=True)) as progress:
        for part in progress.track(pool.map(room, range(seeds)), total=seeds, description="rooms"):
            rows += part
    if as_json:
        print(json.dumps([asdict(row) for row in rows], indent=1))
        return
    table = Table(title="counts as moved", title_justify="left", box=None)
    for name in ("what happened", "seen by", "noticed", "after s, mean / worst"):
        table.add_column(name, justify="left" if name in ("what happened", "seen by") else "right")
    for event, by in dict.fromkeys((row.event, row.by) for row in rows):
        these = [row.after_s for row in rows if (row.event, row.by) == (event, by)]
        when = [after for after in these if after is not None]
        told = f"{np.mean(when):.0f} / {max(when):.0f}" if when else "–"
        table.add_row(event, by, f"{len(when)}/{len(these)}", told)
    Console(width=120).print(table)


def main() -> None:
    options = argparse.ArgumentParser(prog="tools/bench camera", description=__doc__)
    options.add_argument(
        "--source", choices=("geometric", "rendered"), action="append", help="default: geometric"
    )
    options.add_argument("--seeds", type=int, default=20, help="rooms; default 20")
    options.add_argument("--laps", type=int, default=2, help="rounds of each path; default 2")
    options.add_argument("--shape", choices=DRIVE_SHAPES, action="append", help="default: all")
    options.add_argument(
        "--variant", type=int, action="append", help=f"0 to {len(VARIANTS) - 1}; default: all"
    )
    options.add_argument("--jobs", type=int, default=1, help="processes")
    options.add_argument("--json", action="store_true", help="every score as one document")
    options.add_argument("--moved", action="store_true", help="instead: is a moved camera noticed")
    given = options.parse_args()
    os.nice(NICENESS)
    if given.moved:
        _moved(given.seeds, given.jobs, as_json=given.json)
        return
    variants = tuple(VARIANTS[k] for k in given.variant or range(len(VARIANTS)))
    shapes = given.shape or list(DRIVE_SHAPES)
    cases = [(s, p, k) for s in given.source or ["geometric"] for p in shapes for k in range(given.seeds)]
    run = partial(score_drive, laps=given.laps, variants=variants)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    scores: list[Score] = []
    with (
        ProcessPoolExecutor(given.jobs) as pool,
        Progress(*columns, console=Console(stderr=True)) as progress,
    ):
        for part in progress.track(pool.map(run, cases), total=len(cases), description="drives"):
            scores += part
    if given.json:
        print(json.dumps([asdict(s) for s in scores], indent=1))
        return
    console = Console(width=160)
    tables: dict[str, dict[str, list[Score]]] = defaultdict(lambda: defaultdict(list))
    for score in scores:
        tables[f"{score.source}, {given.laps} laps, {score.variant}"][score.shape].append(score)
    for title, groups in tables.items():
        console.print(table_of(title, groups), "")
    console.print(LEGEND)


if __name__ == "__main__":
    main()
