"""A daemon's bus and store with a home's worth of devices, in a process of its own, for tools/bench bus."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Self

import numpy as np

from vad.bus import messages as m
from vad.bus.node import Bus, now_rfc3339
from vad.bus.session import BusSettings
from vad.daemon.parts import Parts
from vad.daemon.past import StoredPast
from vad.daemon.solver import Solver
from vad.store.records import DeviceRecord, Estimate
from vad.store.worker import StoreWorker

REGION = tuple((2 + 0.01 * (i % 40), 1 + 0.02 * i) for i in range(40))
HEATMAPS = 8


def mac(i: int) -> str:
    """The MAC of device i."""
    return f"aa:bb:cc:dd:{i >> 8:02x}:{i & 255:02x}"


def device(i: int, x_m: float) -> m.DeviceMessage:
    """A mapped device, with an outline as long as they are in practice."""
    return m.DeviceMessage(
        source="simulated",
        mac=mac(i),
        name=f"device {i}",
        state="mapped",
        x_m=x_m,
        y_m=1.0,
        covariance_m2=((0.04, 0.01), (0.01, 0.09)),
        radius90_m=0.6,
        region90=REGION,
        room="Kitchen" if i % 2 else "Living room",
        epoch=1,
        walks=3,
        evidence={"packets": 12000.0, "walk_s": 31.5},
        updated_at=now_rfc3339(),
        method="spectrogram-likelihood",
    )


async def serve(folder: Path, devices: int, session: Path | None, port: int) -> None:
    """Play the daemon until a line comes on standard input."""
    loop = asyncio.get_running_loop()
    endpoint = f"tcp/127.0.0.1:{port}"
    solver = Solver()
    async with (
        StoreWorker(folder / "vad.sqlite") as store,
        Bus(BusSettings(listen=(endpoint,)), source="simulated") as bus,
    ):
        bus.ask_past(StoredPast(store, "simulated"))
        place = Estimate(1.0, 1.0, ((0.04, 0.01), (0.01, 0.09)), 0.6, REGION, "Kitchen", "bench")
        now = now_rfc3339()
        await store.save_devices(
            [
                DeviceRecord(mac(i), "mapped", now, now, epoch=1, walks=3, estimate=place)
                for i in range(devices)
            ]
        )
        for i in range(devices):
            bus.publish_device(device(i, float(i % 10)))
        for i in range(HEATMAPS):
            heat = np.random.default_rng(i).random((80, 100))
            bus.publish_heatmap(
                m.heatmap_message(
                    heat, source="simulated", mac=mac(i), epoch=1, bounds_m=(0, 0, 10, 8), step_m=0.1
                )
            )
        kept = await store.devices()  # as the daemon's registry holds them
        gc.collect()
        gc.freeze()  # as the daemon does, once it knows everything
        over = loop.run_in_executor(None, sys.stdin.readline)
        begun_s = time.monotonic()
        tasks = [asyncio.create_task(_live(bus, store, begun_s))]
        if session is not None:
            tasks.append(asyncio.create_task(_solve(solver, session)))
            while not solver.health.counters["solved"]:  # noqa: ASYNC110 - health has no event
                await asyncio.sleep(0.05)
        print(f"up {len(kept)}", flush=True)
        await over
        for task in tasks:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
        await solver.close()
        print(json.dumps({"solved": solver.health.counters["solved"], "counters": bus.health.counters}))


async def _live(bus: Bus, store: StoreWorker, begun_s: float) -> None:
    """What a daemon does anyway: a status, and a device that changes now and then."""
    parts, tick = Parts(), 0
    while True:
        await asyncio.sleep(0.2)
        tick += 1
        bus.publish_device(device(tick % 50, float(tick % 10)))
        if tick % 3 == 0:
            bus.publish_status(
                m.StatusMessage(
                    source="simulated",
                    version="bench",
                    uptime_s=time.monotonic() - begun_s,
                    parts=parts.tell([bus.health, store.health], time.monotonic()),
                )
            )


async def _solve(solver: Solver, session: Path) -> None:
    while True:
        await solver.solve(session)


class Hub:
    """The process; `end` it for what it counted."""

    def __init__(self, folder: Path, devices: int, session: Path | None) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        self.endpoint = f"tcp/127.0.0.1:{port}"
        self.devices = devices
        arguments = [str(folder), str(devices), str(session or ""), str(port)]
        self._process = subprocess.Popen(
            [sys.executable, __file__, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert self._process.stdout is not None
        if not self._process.stdout.readline().startswith("up"):
            raise RuntimeError("the hub did not start")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()

    def before_all_others(self) -> None:
        """Give the hub's threads and ours the processor whenever they want it, as on a machine of their own.

        The solver comes after them, and before the rest of the machine. Needs root.
        """
        children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children").read_text()
        for child in children.split():
            os.setpriority(os.PRIO_PROCESS, int(child), -15)
        for pid in (self._process.pid, os.getpid()):
            for task in Path(f"/proc/{pid}/task").iterdir():
                os.sched_setscheduler(int(task.name), os.SCHED_RR, os.sched_param(1))

    def rss_mb(self) -> float:
        """Resident memory of the hub, without its solver."""
        pages = int(Path(f"/proc/{self._process.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6

    def end(self) -> dict[str, Any]:
        """Stop it; what it counted."""
        said, _ = self._process.communicate("\n", timeout=20)
        counted: dict[str, Any] = json.loads(said)
        return counted


if __name__ == "__main__":
    asyncio.run(
        serve(
            Path(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]) if sys.argv[3] else None, int(sys.argv[4])
        )
    )
