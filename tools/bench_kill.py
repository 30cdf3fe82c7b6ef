#!/usr/bin/env python3
"""What survives kill -9: a hub's store is killed again and again while it writes, then asked what it knows.

tools/bench kill [--kills 200] [--seed 1] [--folder DIR] [--json]

A process of its own saves devices with posteriors as fast as it can and says each one only after the store
has taken it, as the daemon publishes. It is killed at a random moment; the next one must find every device
that was said, each at least as new as it was said, in a database that passes its checks. With --folder on a
small file system and --fill the disk is full from time to time. Exit code 1 where anything is missing.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import random
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import track

from vad.store.records import DeviceRecord, Estimate, PosteriorRecord
from vad.store.store import Store
from vad.store.worker import StoreWorker

MACS = 60
MUTE_S = 20.0
LONGEST_S = 0.4
"""A writer lives at most this long after its first word."""
START_LIMIT_S = 3.0


@dataclass(slots=True)
class Tally:
    """What the kills came to. start_s, start_cpu_s: from opening to knowing, for each start after a kill; the
    limit is held to the processor's time, for the wall's says how busy the machine is."""

    kills: int = 0
    said: int = 0
    missing: list[str] = field(default_factory=list)
    set_aside: int = 0
    start_s: list[float] = field(default_factory=list)
    start_cpu_s: list[float] = field(default_factory=list)

    @property
    def kept(self) -> bool:
        """Whether nothing was lost."""
        return not self.missing and not self.set_aside and max(self.start_cpu_s, default=0.0) < START_LIMIT_S


def mac(number: int) -> str:
    """One of MACS addresses."""
    return f"aa:bb:cc:dd:ee:{number % MACS:02x}"


async def write(path: Path, number: int) -> None:
    """Save devices from `number` on until killed; say each on standard output once it is kept."""
    place = Estimate(1.0, 2.0, ((0.04, 0.01), (0.01, 0.09)), 0.6, ((0.0, 0.0), (1.0, 1.0)), "Hall", "kill")
    grid = np.random.default_rng(number).normal(size=(80, 100)).astype(np.float32)
    async with StoreWorker(path, retry_s=0.01) as store:

        async def keep(n: int) -> None:
            at = "2026-01-31T12:00:00.000Z"
            record = DeviceRecord(
                mac(n), "mapped", at, at, epoch=1, walks=n, estimate=replace(place, x_m=float(n))
            )
            posterior = PosteriorRecord(record.mac, 1, (0.0, 0.0, 10.0, 8.0), 0.1, n, grid, at)
            await store.save_device(record, posterior if n % 3 == 0 else None)
            print(f"{record.mac} {n}", flush=True)

        while True:  # several at once, as joins, walks and a new map come together
            await asyncio.gather(*(keep(n) for n in range(number, number + 5)))
            number += 5


def live_and_die(path: Path, number: int, rng: random.Random, tally: Tally, known: dict[str, int]) -> int:
    """Start a writer, kill it at a random moment; the highest number it can have begun."""
    writer = subprocess.Popen(
        [sys.executable, __file__, "--write", str(path), str(number)], stdout=subprocess.PIPE, text=True
    )
    assert writer.stdout is not None
    mute = threading.Timer(MUTE_S, writer.kill)  # one that never says anything is killed, too
    mute.start()
    first = writer.stdout.readline()
    timer = threading.Timer(rng.uniform(0.0, LONGEST_S), writer.kill)
    timer.start()
    highest = number
    for line in [first, *writer.stdout]:
        if not line.endswith("\n"):
            break  # cut off in the middle of a word: not said
        said, n = line.split()
        known[said] = max(known.get(said, 0), int(n))
        highest = max(highest, int(n))
        tally.said += 1
    timer.cancel()
    mute.cancel()
    writer.kill()
    writer.stdout.close()
    writer.wait()
    tally.kills += 1
    return highest + 10


def look(path: Path, tally: Tally, known: dict[str, int]) -> None:
    """Open the store as the next start does, and compare."""
    begun_s, cpu_s = time.perf_counter(), time.process_time()
    with Store(path) as store:
        devices = {device.mac: device for device in store.devices()}
        posteriors = {one: store.posterior(one) for one in devices}
        tally.start_s.append(time.perf_counter() - begun_s)
        tally.start_cpu_s.append(time.process_time() - cpu_s)
        tally.set_aside += store.set_aside is not None
    for one, n in known.items():
        device = devices.get(one)
        if device is None or device.walks < n:
            tally.missing.append(f"{one}: {n} was said, {device.walks if device else 'nothing'} is kept")
        elif device.estimate is None or device.estimate.x_m != device.walks:
            tally.missing.append(f"{one}: half of it is of another write")
    for one, posterior in posteriors.items():
        if posterior is not None and posterior.walks > devices[one].walks:
            tally.missing.append(f"{one}: a posterior without its device")


@contextlib.contextmanager
def filled(folder: Path) -> Iterator[None]:
    """The file system of `folder` is full meanwhile."""
    ballast = folder / "ballast"
    with ballast.open("wb", buffering=0) as file, contextlib.suppress(OSError):
        while True:
            file.write(b"\0" * 4096)
    try:
        yield
    finally:
        ballast.unlink()


def torture(folder: Path, kills: int, seed: int, fill: bool) -> Tally:
    """Kill `kills` times; every third life is on a full disk where `fill`."""
    rng, tally, known = random.Random(seed), Tally(), dict[str, int]()
    path = folder / "vad.sqlite"
    number = 1
    for life in track(range(kills), "kills", console=Console(stderr=True)):
        if fill and life % 3 == 2:
            with filled(folder):
                number = starve(path, number, rng, tally)
                look(path, tally, known)
        else:
            number = live_and_die(path, number, rng, tally, known)
        look(path, tally, known)
    return tally


def starve(path: Path, number: int, rng: random.Random, tally: Tally) -> int:
    """A life on a full disk: it starts, writes nothing that it says, and dies."""
    writer = subprocess.Popen(
        [sys.executable, __file__, "--write", str(path), str(number)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    with contextlib.suppress(subprocess.TimeoutExpired):
        writer.wait(0.5 + rng.uniform(0.0, LONGEST_S))
        tally.missing.append(f"the writer ended on a full disk with code {writer.returncode}")
    writer.kill()
    writer.wait()
    tally.kills += 1
    return number + 1_000_000


def main(
    kills: Annotated[int, typer.Option(help="How often.")] = 200,
    seed: Annotated[int, typer.Option(help="Of the moments.")] = 1,
    folder: Annotated[
        Path | None, typer.Option(help="Where the database lies; a new folder if left out.")
    ] = None,
    fill: Annotated[bool, typer.Option(help="Fill the file system of --folder in every third life.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="JSON instead of sentences.")] = False,
) -> None:
    """Kill and look; exit code 1 where something that was said is not kept."""
    if fill and folder is None:
        raise typer.BadParameter("it needs --folder on a small file system, e.g. a tmpfs of 48 MB")
    with tempfile.TemporaryDirectory() as temporary:
        tally = torture(folder or Path(temporary), kills, seed, fill)
    slowest_s = max(tally.start_s)
    if as_json:
        facts = {
            "kills": tally.kills,
            "said": tally.said,
            "missing": tally.missing,
            "set_aside": tally.set_aside,
        }
        facts |= {
            "slowest_start_s": slowest_s,
            "slowest_start_cpu_s": max(tally.start_cpu_s),
            "kept": tally.kept,
        }
        print(json.dumps(facts, indent=1))
    else:
        print(f"{tally.kills} kills, {tally.said} writes said before them, {len(tally.missing)} missing,")
        print(f"{tally.set_aside} databases damaged; opened and read in {slowest_s:.2f} s at most")
        print(f"({max(tally.start_cpu_s):.2f} s of the processor)")
        for line in tally.missing[:20]:
            print(line)
    raise typer.Exit(0 if tally.kept else 1)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--write"]:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        asyncio.run(write(Path(sys.argv[2]), int(sys.argv[3])))
    else:
        typer.run(main)
