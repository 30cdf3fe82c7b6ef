#!/usr/bin/env python3
"""Accuracy: where devices are put against where they are, with the bound and the paper's method beside it.

Errors in metres. Every seed is fixed: a run repeats, but for the seconds.
"""

from __future__ import annotations

import argparse
import json
import os
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from functools import partial

from bench_locate_cases import RECORDINGS, home_cases, paper_cases, recorded, recorded_groups
from bench_locate_score import ABLATIONS, Case, Score, fuse, solve, summary
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from vad.mapping.device_stage import Evidence

SETS = ("office", "open", "homes", "recordings")
SEEDS = {"office": 2, "open": 2, "homes": 12}
NICENESS = 10

COLUMNS: tuple[tuple[str, str, str], ...] = (
    ("n", "n", "d"),
    ("median", "median_m", ".2f"),
    ("mean", "mean_m", ".2f"),
    ("rms", "rms_m", ".2f"),
    ("p80", "p80_m", ".2f"),
    ("p95", "p95_m", ".2f"),
    ("<0.5", "below_half_metre", ".0%"),
    ("in 50", "in50", ".0%"),
    ("in 90", "in90", ".0%"),
    ("r90", "radius90_m", ".2f"),
    ("out", "outward_m", "+.2f"),
    ("unsure", "uncertain", "d"),
    ("no", "refused", "d"),
    ("CRB", "bound_rms_m", ".2f"),
    ("rms/CRB", "rms_per_bound", ".1f"),
    ("paper 1.1", "paper_office_mean_m", ".2f"),
    ("2.3", "paper_open_mean_m", ".2f"),
    ("CPU s", "cpu_s", ".1f"),
)
ROOM_COLUMNS = (("right room", "right_room", ".0%"), ("wrong, sure", "wrong_room_confident", ".0%"))
HEIGHT_COLUMNS = (("height told", "height_told", ".0%"), ("in it", "height_in", ".0%"))
LEGEND = (
    "in 50, in 90: share of truths in those regions; r90: median radius of the 90 % region; out: mean "
    "error away from the walk; unsure, no: uncertain, refused; CRB: rms bound of Doppler alone, perfect path "
    "length change; paper: mean error of Algorithm 1 with thresholds 1.1 and 2.3 m."
)

Unit = Callable[[], Iterator[list[Case]]]


def units(name: str, seeds: int | None, limit: int | None) -> list[Unit]:
    """The independent parts of a set: each makes the walks of one device, a few at a time."""
    if name == "recordings":
        return [partial(recorded, group, limit) for group in recorded_groups()]
    count = range(SEEDS[name] if seeds is None else seeds)
    if name == "homes":
        return [partial(home_cases, seed) for seed in count]
    return [partial(paper_cases, "office" if name == "office" else "open", seed, limit) for seed in count]


def run_unit(unit: Unit, ablations: tuple[str, ...]) -> dict[str, list[Score]]:
    """Solve the walks of one device, alone and together; scores by ablation."""
    scores: dict[str, list[Score]] = defaultdict(list)
    groups: dict[tuple[str, str], list[tuple[Case, Evidence]]] = defaultdict(list)
    for cases in unit():
        for case in cases:
            for ablation in ablations:
                score, evidence = solve(case, ablation)
                scores[ablation].append(score)
                # The recording's arrays are not needed again, and many of them fill the memory.
                small = replace(case, recording=replace(case.recording, csi=case.recording.csi[:0]))
                bare = replace(evidence, spectrogram=None, path=None, posterior=None)
                groups[ablation, case.group].append((small, bare))
    for (ablation, group), members in groups.items():
        if len(members) > 2:
            fused = fuse(group, [c for c, _ in members], [e for _, e in members])
            if fused is not None:
                scores[ablation].append(fused)
    return scores


def pools(scores: list[Score]) -> Iterator[tuple[str, list[Score]]]:
    """The rows of a table: single walks, then fused ones, by tag."""
    for fused in (False, True):
        kind = [s for s in scores if (s.walks > 1) == fused]
        if not kind:
            continue
        title = f"{max(s.walks for s in kind)} walks" if fused else "one walk"
        tags = list(dict.fromkeys(tag for s in kind for tag in s.tags))
        for tag in sorted(tags, key=lambda t: "," in t):  # "slow 2 cm" before all "slow 2 cm, circle"
            yield f"{title}, {tag}", [s for s in kind if tag in s.tags]


def table_of(name: str, ablation: str, scores: list[Score]) -> Table:
    """One set's table."""
    table = Table(
        title=f"{name}{'' if ablation == 'full' else f', {ablation}'}", title_justify="left", box=None
    )
    columns = COLUMNS + (ROOM_COLUMNS + HEIGHT_COLUMNS if name == "homes" else ())
    table.add_column("", no_wrap=True)
    for title, _, _ in columns:
        table.add_column(title, justify="right", no_wrap=True)
    for title, pool in pools(scores):
        values = summary(pool)
        cells = []
        for _, key, form in columns:
            value = values.get(key)
            cells.append("–" if value is None else format(value, form))
        table.add_row(title, *cells)
    return table


def main() -> None:
    options = argparse.ArgumentParser(prog="tools/bench locate", description=__doc__)
    options.add_argument("--set", choices=SETS, action="append", help="only this set; may be repeated")
    options.add_argument("--seeds", type=int, help=f"of each simulated set; default {SEEDS}")
    options.add_argument("--walks", type=int, help="at most this many of each device")
    options.add_argument("--jobs", type=int, default=1, help="processes")
    options.add_argument("--json", action="store_true", help="every score and summary as one document")
    options.add_argument(
        "--ablation",
        choices=[*ABLATIONS, "all"],
        action="append",
        help="leave something out of the estimator; may be repeated",
    )
    given = options.parse_args()
    os.nice(NICENESS)
    asked = tuple(given.ablation or ("full",))
    ablations = tuple(ABLATIONS) if "all" in asked else asked
    console, errors = Console(width=200), Console(stderr=True)
    document: dict[str, object] = {}
    with ProcessPoolExecutor(given.jobs) as pool:
        for name in given.set or SETS:
            todo = units(name, given.seeds, given.walks)
            if not todo:
                errors.print(f"{name}: skipped, no recordings at {RECORDINGS}")
                continue
            found = solved(name, todo, ablations, pool if given.jobs > 1 else None, errors)
            for ablation, scores in found.items():
                if given.json:
                    key = name if ablation == "full" else f"{name}, {ablation}"
                    rows = {title: summary(members) for title, members in pools(scores)}
                    document[key] = {"summary": rows, "scores": [asdict(s) for s in scores]}
                else:
                    console.print(table_of(name, ablation, scores), "")
    if given.json:
        print(json.dumps(document, indent=1))
    else:
        console.print(LEGEND)


def solved(
    name: str,
    todo: list[Unit],
    ablations: tuple[str, ...],
    pool: ProcessPoolExecutor | None,
    errors: Console,
) -> dict[str, list[Score]]:
    """All units of a set, in this process or in others; scores by ablation in the units' order."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    run = partial(run_unit, ablations=ablations)
    found: dict[str, list[Score]] = defaultdict(list)
    with Progress(*columns, console=errors) as progress:
        for part in progress.track(
            map(run, todo) if pool is None else pool.map(run, todo), total=len(todo), description=name
        ):
            for ablation, scores in part.items():
                found[ablation] += scores
    return found


if __name__ == "__main__":
    main()
