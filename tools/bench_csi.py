#!/usr/bin/env python3
"""CSI: reading logs, beside csiread where that is installed; with --live receiving them from the kernel.

All logs are made here, so that the table can be made anywhere; further logs may be named.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import bench_csi_live
import numpy as np
from rich.console import Console
from rich.table import Table

from vad.csi.bfee import encode_bodies
from vad.csi.logfile import LogReader, read_log, record

try:
    import csiread
except ImportError:
    csiread = None

PACKETS = 40_000
ROUNDS = 15


def make_log(n_tx: int, packets: int, *, changing: bool) -> bytes:
    """A log of 3 receive antennas whose chain order may change from packet to packet."""
    rng = np.random.default_rng(1)
    csi = rng.integers(-60, 61, (packets, 30, 3, n_tx, 2)).astype(np.int8)
    order = rng.choice([0b100100, 0b011000, 0b000110], packets) if changing else 0b100100
    bodies = encode_bodies(
        csi,
        nic_us=np.arange(packets) * 1000,
        bfee_count=np.arange(packets),
        rssi=(30, 31, 32),
        antenna_sel=order,
    )
    return b"".join(record(0xBB, body) for body in bodies)


def read_ours(path: Path) -> int:
    """Everything: complex64 in antenna order and all fields."""
    return len(read_log(path.read_bytes())[0])


def read_csiread(path: Path, n_tx: int) -> int:
    """Everything: complex128 in antenna order and all fields."""
    reader = csiread.Intel(str(path), nrxnum=3, ntxnum=n_tx, if_report=False)
    reader.read()
    return int(reader.count)


def best_s(*readers: Callable[[], int]) -> list[float]:
    """The shortest time of each, taken in turns."""
    best = [float("inf")] * len(readers)
    for _ in range(ROUNDS):
        for i, read in enumerate(readers):
            started = time.perf_counter()
            read()
            best[i] = min(best[i], time.perf_counter() - started)
    return best


def shape_of(log: bytes) -> tuple[int, int]:
    """Packets and the most transmit antennas."""
    packets, _ = read_log(log)
    return len(packets), max(packets.n_tx.tolist(), default=1)


def add_row(table: Table, name: str, path: Path) -> None:
    """Measure one file."""
    log = path.read_bytes()
    packets, n_tx = shape_of(log)
    readers: list[Callable[[], int]] = [lambda: read_ours(path)]
    if csiread is not None:
        readers.append(lambda: read_csiread(path, n_tx))
    times = best_s(*readers)
    cells = [f"{len(log) / 1e6 / s:.0f}" for s in times] + ["–"] * (2 - len(times))
    ratio = f"{times[1] / times[0]:.2f}" if len(times) == 2 else "–"
    table.add_row(name, f"{packets:,}", f"{len(log) / 1e6:.1f}", *cells, ratio)


def files(console: Console, named: list[Path]) -> None:
    """The table of whole files."""
    table = Table(title="From file, MB/s", title_justify="left", box=None)
    for column in ("log", "packets", "MB", "vad", "csiread", "vad / csiread"):
        table.add_column(column, justify="left" if column == "log" else "right")
    with tempfile.TemporaryDirectory() as folder:
        for n_tx, packets in ((1, PACKETS), (3, PACKETS // 2)):
            for changing in (False, True):
                path = Path(folder) / "csi.dat"
                path.write_bytes(make_log(n_tx, packets, changing=changing))
                add_row(table, f"3x{n_tx}, antenna order {'changes' if changing else 'fixed'}", path)
    for path in named:
        add_row(table, f"{path.parent.name}/{path.name}", path)
    console.print(table)


def batches(console: Console) -> None:
    """The table of small pieces, as live sources hand them over."""
    log = make_log(1, 4096, changing=False)
    size = len(log) // 4096
    table = Table(title="In pieces, 3x1", title_justify="left", box=None)
    for column in ("packets a piece", "us a piece", "us a packet"):
        table.add_column(column, justify="right")
    for piece in (1, 8, 64, 512):
        best = float("inf")
        for _ in range(ROUNDS):
            reader = LogReader()
            started = time.perf_counter()
            for at in range(0, min(len(log), 64 * piece * size), piece * size):
                reader.feed(log[at : at + piece * size])
            best = min(best, (time.perf_counter() - started) / min(64, 4096 // piece))
        table.add_row(str(piece), f"{best * 1e6:.0f}", f"{best * 1e6 / piece:.2f}")
    console.print(table)


def main() -> None:
    options = argparse.ArgumentParser(prog="tools/bench csi", description=__doc__)
    options.add_argument("files", nargs="*", type=Path, help="further logs to read")
    options.add_argument("--live", action="store_true", help="through the kernel instead; needs root")
    options.add_argument("--seconds", type=float, default=30.0, help="length of a live run")
    given = options.parse_args()
    console = Console(width=110)
    console.print(f"{os.cpu_count()} CPUs, load {os.getloadavg()[0]:.1f}, numpy {np.__version__}")
    if given.live:
        bench_csi_live.main(console, given.seconds)
    else:
        files(console, given.files)
        batches(console)


if __name__ == "__main__":
    main()
