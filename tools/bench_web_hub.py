"""A page with a home's worth of devices that change, in a process of its own, for tools/bench web."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Self

import msgspec

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "web"))

from waiting import until
from web_world import World, device, world

from vad.web.home import Robot


async def serve(devices: int) -> None:
    """Serve until standard input ends; `RATE SECONDS` on it: so many changes a second for so long."""
    loop = asyncio.get_running_loop()
    with tempfile.TemporaryDirectory() as folder:
        async with world(Path(folder), devices=devices, may_change=False) as made:
            page = asyncio.create_task(made.page.run())
            await until(lambda: made.page.health.state == "ok", "the page listens")
            print(made.page.port, flush=True)
            while line := await loop.run_in_executor(None, sys.stdin.readline):
                rate_hz, seconds = map(float, line.split())
                print(json.dumps(await change(made, devices, rate_hz, seconds)), flush=True)
            page.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await page


async def change(made: World, devices: int, rate_hz: float, seconds: float) -> dict[str, Any]:
    """Change one device after the other; the robot drives on. What it took."""
    base = [device(i) for i in range(devices)]
    before = made.page.health.counters.copy()
    cpu_s, begun_s = time.process_time(), time.monotonic()
    sent = 0
    while (spent_s := time.monotonic() - begun_s) < seconds:
        made.robot = Robot(status="localised", x_m=1 + spent_s % 3, y_m=1.5, yaw_rad=0.0, epoch=1)
        while rate_hz and sent < rate_hz * spent_s:
            one = base[sent % devices]
            sent += 1
            made.bus.publish_device(msgspec.structs.replace(one, walks=4 + sent))
        await asyncio.sleep(1 / rate_hz if rate_hz else 0.1)
    wall_s = time.monotonic() - begun_s
    cpu_s = time.process_time() - cpu_s
    await asyncio.sleep(0.2)  # the last ones go out
    counters = made.page.health.counters - before
    return {"sent": sent, "wall_s": wall_s, "cpu_s": cpu_s, "counters": dict(counters)}


class Hub:
    """The process."""

    def __init__(self, devices: int) -> None:
        self._process = subprocess.Popen(
            [sys.executable, __file__, str(devices)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        )
        self.port = int(self._line())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate(timeout=20)

    async def change(self, rate_hz: float, seconds: float) -> dict[str, Any]:
        """Have devices change; what it took."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{rate_hz} {seconds}\n")
        self._process.stdin.flush()
        told: dict[str, Any] = json.loads(await asyncio.to_thread(self._line))
        return told

    def _line(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError("the hub ended")
        return line


if __name__ == "__main__":
    asyncio.run(serve(int(sys.argv[1])))
