#!/usr/bin/env python3
"""Every part's benchmark in its quick form, and one table: part, what, figure, bar.

tools/bench all [--only PART ...] [--json]

One after the other, for they would slow each other down. The long forms, which the README's tables come from,
are each part's own: `tools/bench PART --help`. Exit code 1 where a bar is not kept, or a benchmark gave no
figures.
"""

from __future__ import annotations

import argparse
import json
import re
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

TOOLS = Path(__file__).resolve().parent
LIMIT_S = 600.0
CSI_NOISE = 0.1
"""How far the same ratio has been seen to differ from run to run."""
WRONG_USE = 2
"""A benchmark that has nothing to measure with says so with this exit code."""


@dataclass(frozen=True, slots=True)
class Row:
    """One figure. kept: whether the bar is, None where there is none."""

    part: str
    what: str
    figure: str
    bar: str = ""
    kept: bool | None = None


@dataclass(frozen=True, slots=True)
class Part:
    """A benchmark: what is given to it, and its figures in what it prints."""

    name: str
    arguments: tuple[str, ...]
    read: Callable[[str], Iterator[tuple[str, str, str, bool | None]]]


Figures = Iterator[tuple[str, str, str, bool | None]]


def _csi(text: str) -> Figures:
    """Whole files: the lines end in MB/s of both and their ratio, where the other reader is installed."""
    files = [line for line in text.splitlines() if "antenna order" in line]
    ratios = [float(match[1]) for line in files if (match := re.search(r"(\d+\.\d\d)\s*$", line))]
    yield (
        "reading logs, against csiread",
        f"{min(ratios):.2f} to {max(ratios):.2f} times",
        f">= 1, ±{CSI_NOISE}",
        min(ratios) >= 1.0 - CSI_NOISE,
    )


def _robot(text: str) -> Figures:
    for line in text.splitlines():
        if match := re.fullmatch(r"(\S.*?)\s+([\d.]+)\s+(\d+)\s+(ok|TOO SLOW)", line.strip()):
            yield match[1], f"{float(match[2]):.1f} µs", f"<= {match[3]} µs", match[4] == "ok"


def _camera(text: str) -> Figures:
    scores = json.loads(text)
    good = [score["deviation_m"] for score in scores if score["status"] == "valid"]
    yield "drives that calibrate", f"{len(good)} of {len(scores)}", "", None
    yield (
        "deviation, median",
        f"{statistics.median(good) * 100:.1f} cm",
        "<= 6 cm",
        statistics.median(good) <= 0.06,
    )


def _people(text: str) -> Figures:
    speed = json.loads(text)["speed"]
    for name, plain in speed.items():
        for key, value in plain.items():
            if isinstance(value, int | float):
                yield f"{name}: {key}", f"{value:.3g}", "", None


def _locate(text: str) -> Figures:
    for name, found in json.loads(text).items():
        errors = [score["error_m"] for score in found["scores"] if score.get("error_m") is not None]
        yield f"{name}: error, median of {len(errors)}", f"{statistics.median(errors):.2f} m", "", None


def _agent(text: str) -> Figures:
    rows = [json.loads(line) for line in text.splitlines() if line.startswith("{")]
    lost = sum(row["sent"] - row["received"] for row in rows)
    yield "packets that never came", str(lost), "0", lost == 0
    yield "hub's share of a core, 4 x 1000 packets/s", f"{max(row['cpu'] for row in rows):.1%}", "", None


def _bus(text: str) -> Figures:
    for row in json.loads(text)["rows"]:
        p99_ms, limit_ms = row["p99_ms"], row["limit_ms"]
        kept = None if limit_ms is None else p99_ms <= limit_ms and not row["errors"]
        yield (
            f"{row['what']}, p99",
            f"{p99_ms:.1f} ms",
            "" if limit_ms is None else f"<= {limit_ms:g} ms",
            kept,
        )


def _kill(text: str) -> Figures:
    facts = json.loads(text)
    yield f"lost after {facts['kills']} kills", str(len(facts["missing"])), "0", not facts["missing"]
    yield "slowest start, processor", f"{facts['slowest_start_cpu_s'] * 1e3:.0f} ms", "", facts["kept"]


def _web(text: str) -> Figures:
    for row in json.loads(text)["rows"]:
        yield row["what"], row["value"], row["limit"], row["kept"] if row["limit"] else None


def _detector(text: str) -> Figures:
    found = json.loads(text)
    yield "best guess on the robot", f"{found['top_1']:.0%}", ">= 90 %", found["top_1"] >= 0.9
    yield "sees one where none is", f"{found['false']:.0%}", "<= 5 %", found["false"] <= 0.05


def _week(text: str) -> Figures:
    summary = json.loads(text)["summary"]
    reachable, right = summary["reachable devices"], summary["mapped in the right room"]
    yield "devices mapped in the right room, two days", f"{right} of {reachable}", "", None
    yield "median error", f"{summary['median error m']} m", "", None


def _rows_of(text: str) -> Figures:
    """Of idle and soak, which give their rows themselves."""
    for what, figure, bar, kept in json.loads(text)["rows"]:
        yield what.strip(), figure, bar, kept


PARTS = (
    Part("robot", (), _robot),
    Part("csi", (), _csi),
    Part("camera", ("--seeds", "1", "--laps", "1", "--jobs", "1", "--json"), _camera),
    Part("detector", ("--json",), _detector),
    Part("people", ("--only-speed", "--json"), _people),
    Part("locate", ("--set", "homes", "--seeds", "1", "--walks", "1", "--jobs", "1", "--json"), _locate),
    Part("agent", ("--seconds", "3", "--json"), _agent),
    Part(
        "bus",
        ("--devices", "100", "--rounds", "300", "--queries", "0", "--clients", "0", "--no-solve", "--json"),
        _bus,
    ),
    Part("kill", ("--kills", "10", "--json"), _kill),
    Part("web", ("--loads", "2", "--seconds", "3", "--json"), _web),
    Part("week", ("--days", "2", "--json"), _week),
    Part("idle", ("--idle", "15", "--json"), _rows_of),
    Part("soak", ("--days", "12", "--walks", "1", "--devices", "4", "--json"), _rows_of),
)


def run(part: Part) -> list[Row]:
    """The part's figures; a row that says why where it gives none."""
    command = [sys.executable, str(TOOLS / f"bench_{part.name}.py"), *part.arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, cwd=TOOLS.parent)
    except subprocess.TimeoutExpired:
        return [Row(part.name, f"no end in {LIMIT_S:g} s", "", "", False)]
    try:
        return [Row(part.name, *figures) for figures in part.read(done.stdout)]
    except (ValueError, KeyError, TypeError, StopIteration, statistics.StatisticsError):
        said = (done.stderr.strip() or done.stdout.strip() or "it says nothing").splitlines()[-1]
        nothing_to_measure_with = done.returncode == WRONG_USE
        return [Row(part.name, said, "left out", "", None if nothing_to_measure_with else False)]


def main() -> None:
    options = argparse.ArgumentParser(prog="tools/bench all", description=__doc__)
    options.add_argument(
        "--only", action="append", choices=[part.name for part in PARTS], help="may be repeated"
    )
    options.add_argument("--json", action="store_true", dest="as_json")
    given = options.parse_args()
    progress = Console(stderr=True)
    rows: list[Row] = []
    for part in PARTS:
        if given.only and part.name not in given.only:
            continue
        begun_s = time.monotonic()
        rows += run(part)
        progress.print(f"{part.name}: {time.monotonic() - begun_s:.0f} s", highlight=False)
    kept = all(row.kept is not False for row in rows)
    if given.as_json:
        print(json.dumps({"rows": [asdict(row) for row in rows], "kept": kept}, indent=1))
    else:
        print_table(rows)
    sys.exit(0 if kept else 1)


def print_table(rows: list[Row]) -> None:
    """All figures; a part's name stands once."""
    table = Table(box=None)
    for name in ("part", "what", "figure", "bar", ""):
        table.add_column(name)
    before = ""
    for row in rows:
        mark = "" if row.kept is None else "kept" if row.kept else "NOT KEPT"
        table.add_row(row.part if row.part != before else "", row.what, row.figure, row.bar, mark)
        before = row.part
    Console(width=130).print(table)


if __name__ == "__main__":
    main()
