#!/usr/bin/env python3
"""The bus over loopback: 500 devices asked for while the solver works, many clients, memory.

tools/bench bus [--alone] [--devices 500] [--queries 100000] [--clients 50] [--seed 1] [--json]

A process of its own plays the daemon: the bus, the store, a status twice a second, a device that changes five
times a second, and the daemon's solver at work without a pause. Exit code 1 where a limit is not kept.
"""

from __future__ import annotations

import asyncio
import json
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
import zenoh
from bench_bus_hub import Hub, mac
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from vad.bus.session import BusSettings, open_session
from vad.client import AsyncVadClient, VadClient
from vad.errors import VadError
from vad.sim.scenario import make_home

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from walk_sessions import record_walk

ONE_MS, ALL_MS = 3.0, 30.0
RSS_GROWTH_MB = 4.0
WARM_UP = 2000


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table; limit: what p99 (or the value) may be, None where it is only told."""

    what: str
    count: int
    p50_ms: float
    p99_ms: float
    max_ms: float
    errors: int = 0
    limit_ms: float | None = None

    @property
    def kept(self) -> bool:
        """Whether it is as fast and sound as it must be."""
        return self.errors == 0 and (self.limit_ms is None or self.p99_ms <= self.limit_ms)


def timed(what: str, times_s: list[float], errors: int = 0, limit_ms: float | None = None) -> Row:
    """A row of durations."""
    p50, p99 = np.percentile(np.array(times_s) * 1e3, [50, 99]).tolist()
    return Row(what, len(times_s), p50, p99, max(times_s) * 1e3, errors, limit_ms)


def repeated(work: Callable[[int], object], count: int) -> list[float]:
    """Seconds of each of `count` calls."""
    times_s = []
    for i in range(count):
        begun_s = time.perf_counter()
        work(i)
        times_s.append(time.perf_counter() - begun_s)
    return times_s


def latencies(hub: Hub, rounds: int, seed: int) -> list[Row]:
    """One client that asks again and again, as the CLI and a home automation do."""
    chosen = np.random.default_rng(seed).integers(hub.devices, size=max(rounds, 1000))

    def one(client: VadClient, i: int) -> None:
        assert client.device(mac(int(chosen[i % len(chosen)]))) is not None

    def everything(client: VadClient) -> None:
        assert len(client.devices()) == hub.devices

    selector = "vad/home/devices/*"
    rows = []
    with VadClient(hub.endpoint) as client:
        repeated(lambda i: one(client, i), 200)
        rows.append(timed("one device", repeated(lambda i: one(client, i), rounds), limit_ms=ONE_MS))
        rows.append(
            timed("all, one reply", repeated(lambda _: everything(client), rounds // 10), limit_ms=ALL_MS)
        )
        inside = repeated(lambda _: client.devices(bbox=(0, 0, 5, 5), max_sigma_m=0.5), rounds // 10)
        rows.append(timed("those in a box, known to 0.5 m", inside))
        rows.append(timed("all as GeoJSON", repeated(lambda _: client.devices_geojson(), rounds // 10)))
        rows.append(
            timed("a heatmap as array", repeated(lambda _: client.heatmap_array(mac(0)), rounds // 10))
        )
        then = client.devices()[0].published_at
        rows.append(timed("one as it was", repeated(lambda _: client.device(mac(0), at=then), rounds // 10)))
        rows.append(timed("the status", repeated(lambda _: client.status(), rounds // 10)))
    with closing(open_session(BusSettings(mode="client", connect=(hub.endpoint,)))) as session:

        def each() -> None:
            # NONE: consolidated, more replies than the channel holds can block `get` itself for ever
            replies = session.get(selector, consolidation=zenoh.ConsolidationMode.NONE, timeout=10.0)
            assert sum(1 for reply in replies if reply.ok is not None) == hub.devices

        rows.append(
            timed(f"all, {hub.devices} replies (plain zenoh)", repeated(lambda _: each(), rounds // 10))
        )
    return rows


def crowd(hub: Hub, clients: int, queries: int) -> Row:
    """Many connections at once, each with its share of the queries."""

    async def one(number: int, client: AsyncVadClient) -> tuple[list[float], int]:
        times_s, errors = [], 0
        for i in range(queries // clients):
            begun_s = time.perf_counter()
            try:
                found = await client.device(mac((number * 7 + i) % hub.devices))
                errors += found is None
            except VadError:
                errors += 1
            times_s.append(time.perf_counter() - begun_s)
        return times_s, errors

    async def together() -> list[tuple[list[float], int]]:
        everybody = [AsyncVadClient(hub.endpoint) for _ in range(clients)]
        await asyncio.gather(*(client.open() for client in everybody))
        try:
            return await asyncio.gather(*(one(k, client) for k, client in enumerate(everybody)))
        finally:
            await asyncio.gather(*(client.close() for client in everybody))

    results = asyncio.run(together())
    times_s = [took for taken, _ in results for took in taken]
    return timed(f"one device, {clients} clients at once", times_s, sum(errors for _, errors in results))


def memory(hub: Hub, queries: int, show: Callable[[int], None]) -> tuple[list[tuple[int, float]], float]:
    """(queries so far, MB resident) along `queries` queries of every kind, and queries per second."""
    seen: list[tuple[int, float]] = []
    with VadClient(hub.endpoint) as client:
        kinds: list[Callable[[int], object]] = [lambda i: client.device(mac(i % hub.devices))] * 44
        kinds += [lambda _: client.devices(room="Kitchen"), lambda _: client.status()]
        kinds += [lambda i: client.heatmap_png(mac(i % 8)), lambda i: client.history(mac(i % hub.devices))]
        kinds += [lambda i: client.device(mac(i % hub.devices), at="2099-01-01T00:00:00Z"), _refused(client)]
        for i in range(WARM_UP):
            kinds[i % len(kinds)](i)
        begun_s = time.perf_counter()
        for i in range(queries):
            kinds[i % len(kinds)](i)
            if i % max(1, queries // 20) == 0:
                seen.append((i, hub.rss_mb()))
                show(i)
        took_s = time.perf_counter() - begun_s
    seen.append((queries, hub.rss_mb()))
    return seen, queries / took_s


def _refused(client: VadClient) -> Callable[[int], object]:
    def ask(_: int) -> None:
        try:
            client.history("aa:bb:cc:dd:00:00", limit=5000)
        except VadError:
            return
        raise AssertionError("a limit of 5000 must be refused")

    return ask


def main(
    devices: Annotated[int, typer.Option(help="Devices the daemon knows.")] = 500,
    rounds: Annotated[int, typer.Option(help="Questions of the commonest kind; others a tenth.")] = 3000,
    queries: Annotated[int, typer.Option(help="Over which memory is watched; 0 leaves it out.")] = 100_000,
    clients: Annotated[int, typer.Option(help="That ask 10,000 questions at once; 0 leaves it out.")] = 50,
    solve: Annotated[bool, typer.Option(help="Keep the solver at work.")] = True,
    alone: Annotated[
        bool, typer.Option("--alone", help="Leave other programs out: real-time priority (root).")
    ] = False,
    seed: Annotated[int, typer.Option(help="Of which devices are asked for.")] = 1,
    as_json: Annotated[bool, typer.Option("--json", help="JSON instead of tables.")] = False,
) -> None:
    """Measure the bus; exit code 1 where a limit is not kept."""
    out = Console()
    with tempfile.TemporaryDirectory() as name, Progress(console=Console(stderr=True)) as progress:
        folder = Path(name)
        session = record_walk(folder / "walk", make_home(1)) if solve else None
        with Hub(folder, devices, session) as hub:
            if alone:
                hub.before_all_others()
            rows = latencies(hub, rounds, seed)
            if clients:
                rows.append(crowd(hub, clients, 10_000))
            seen: list[tuple[int, float]] = []
            per_s = 0.0
            if queries:
                task = progress.add_task("memory", total=queries)
                seen, per_s = memory(hub, queries, lambda i: progress.update(task, completed=i))
            facts = hub.end()
    growth_mb = seen[-1][1] - seen[len(seen) // 4][1] if seen else 0.0
    kept = all(row.kept for row in rows) and growth_mb <= RSS_GROWTH_MB
    if as_json:
        plain = {"rows": [asdict(row) for row in rows], "rss_mb": seen, "queries_per_s": per_s, **facts}
        print(json.dumps(plain | {"kept": kept}, indent=1))
    else:
        table = Table(title=f"{devices} devices, {facts['solved']} walks solved meanwhile")
        for column in ("question", "asked", "p50 ms", "p99 ms", "max ms", "errors", "limit p99 ms", ""):
            table.add_column(column, justify="left" if column == "question" else "right")
        for row in rows:
            limit = "" if row.limit_ms is None else f"{row.limit_ms:g}"
            numbers = [f"{row.p50_ms:.2f}", f"{row.p99_ms:.2f}", f"{row.max_ms:.1f}", str(row.errors)]
            table.add_row(row.what, str(row.count), *numbers, limit, "" if row.kept else "MISSED")
        out.print(table)
        if seen:
            told = ", ".join(f"{mb:.1f}" for _, mb in seen[:: max(1, len(seen) // 8)])
            out.print(
                f"resident MB along {queries} queries ({per_s:.0f}/s): {told}; {growth_mb:+.1f} at last"
            )
    raise typer.Exit(0 if kept else 1)


if __name__ == "__main__":
    typer.run(main)
