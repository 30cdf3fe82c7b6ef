#!/usr/bin/env python3
"""A month in fast motion: does anything grow, does anything get lost?

tools/bench soak [--days 30] [--walks 3] [--devices 8] [--seed 5] [--json]

One process holds what the daemon holds: bus with real clients, registry, store with its history, schedule,
sessions with a quota, solver, log of decisions, eyes with the pose network, ears. Every simulated half hour
the schedule decides; devices join, leave in the morning and are back in the evening; a guest with an address
of its own comes every day and never again; some of the day's walks are recorded and solved by the real
estimator (all would take hours: --walks says how many a day, the others pass with the camera covered);
pictures, packets and poses come by the hundred; clients ask everything there is to ask. At each midnight
memory, descriptors, threads and tasks are counted. The radio is simulated in a process of its own. Exit code
1 where memory grew by more than 5 % after the first fifth of the time (six days at least), where descriptors,
threads or tasks did for good, or where a device was lost.
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import json
import logging
import os
import socket
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from bench_idle_home import still_and_moving
from bench_soak_month import Midnight, Month, nights_table, rss_mb
from bench_week_sim import Simulation, Week, _Bus, settings_for
from rich.console import Console
from rich.table import Table

from vad.bus import messages as m
from vad.bus.node import Bus
from vad.bus.session import BusSettings
from vad.camera.frame import Frame, FrameQueue
from vad.camera.http_stream import decode_jpeg
from vad.capture.schedule import View
from vad.client import VadClient
from vad.csi.packets import CsiBatch
from vad.csi.select import take_packets
from vad.daemon.ears import Ears
from vad.daemon.eyes import Eyes
from vad.daemon.past import StoredPast
from vad.devices.station import StationEvent
from vad.health import Health
from vad.robot.pose import RobotPose
from vad.sim.calibration import true_calibration
from vad.sim.household import DAY_S, HomeDevice, Household, Visit, hear, make_household
from vad.store.store import Store
from vad.streams import DropOldestQueue
from vad.vision.people import PoseNetwork

LEAVES_H, RETURNS_H = 8.5, 17.5
GUEST_H = (18.0, 20.0)
PICTURES, MOVING, BATCHES, STATUSES, POSES = 90, 45, 100, 100, 500
"""Of each of these a day."""


class LiveBus(_Bus):
    """The daemon's bus, with a network; what is published is kept for the week's own book, too."""

    def __init__(self, week: Week, endpoint: str) -> None:
        Bus.__init__(self, BusSettings(listen=(endpoint,)), source="simulated")
        self.now_s = 0.0
        self._week = week

    def publish_event(self, message: m.EventMessage) -> None:
        Bus.publish_event(self, message)

    def publish_device(self, message: m.DeviceMessage) -> None:
        super().publish_device(message)
        Bus.publish_device(self, message)


class Soak(Simulation):
    """Plays the days, and everything else that a daemon does in them."""

    def __init__(
        self, house: Household, days: int, folder: Path, walks: int, pool: ProcessPoolExecutor
    ) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self._endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        settings = settings_for(folder, quota_mb=30)
        super().__init__(house, days, folder, settings, lambda week: LiveBus(week, self._endpoint))
        self.month = Month()
        self._walks, self._pool = walks, pool
        self._present: set[str] = set()
        self._guest = ""
        self._asked = 0
        self._night = 0
        self.on_night: Callable[[Midnight], None] = lambda _night: None
        still, moving = still_and_moving(house.home, MOVING)
        self._pictures = [decode_jpeg(jpeg) for jpeg in still[:6]]
        self._moving = [decode_jpeg(jpeg) for jpeg in moving[:MOVING]]
        self._eyes = Eyes(
            PoseNetwork(None, threads=1),
            max_fps=1000.0,
            focal_px=None,
            known=true_calibration(house.home),
            on_calibration=lambda _calibration: None,
        )
        self._ears = Ears()
        self._frames = FrameQueue(2)
        self._poses: DropOldestQueue[RobotPose] = DropOldestQueue(2048)
        self._batches: DropOldestQueue[CsiBatch] = DropOldestQueue(256)
        self._sample: CsiBatch | None = None
        self._seq = 0

    async def _play(self) -> None:
        self._bus.ask_past(StoredPast(self._store, "simulated"))
        begun_s = time.monotonic()
        async with self._bus, asyncio.TaskGroup() as group:
            tasks = [
                group.create_task(self._eyes.run(self._frames)),
                group.create_task(self._eyes.follow_robot(self._poses)),
                group.create_task(self._ears.run(self._batches)),
            ]
            await super()._play()
            for task in tasks:
                task.cancel()
        self.month.seconds = time.monotonic() - begun_s
        self.month.walks, self.month.removed = self.week.walks, self.week.removed

    async def _nobody(self, t_s: float) -> None:
        await super()._nobody(t_s)
        await self._come_and_go(t_s)
        if t_s // DAY_S > self._night:
            self._night += 1
            await self._live_pipeline()
            await self._midnight()

    async def _come_and_go(self, t_s: float) -> None:
        """Half of the devices are out of the house in the day; a guest's phone comes once."""
        hour = t_s % DAY_S / 3600
        events = []
        for number, device in enumerate(self._house.devices):
            if device.mac not in self.week.records:
                continue
            there = number % 2 == 0 or not LEAVES_H <= hour < RETURNS_H
            if there != (device.mac in self._present):
                events.append(
                    StationEvent(round(t_s * 1e9), "joined" if there else "left", device.mac, "wlan0")
                )
                (self._present.add if there else self._present.discard)(device.mac)
        guest = GUEST_H[0] <= hour < GUEST_H[1]
        if guest and not self._guest:
            self._guest = f"0a:00:00:00:{self._night // 256:02x}:{self._night % 256:02x}"
            events.append(StationEvent(round(t_s * 1e9), "joined", self._guest, "wlan0"))
        elif self._guest and not guest:
            events.append(StationEvent(round(t_s * 1e9), "left", self._guest, "wlan0"))
            self._guest = ""
        for mac in await self._registry.take(events) if events else ():
            self._measuring.joined(mac, round(t_s * 1e9))

    async def _visit(self, visit: Visit) -> None:
        number = self._house.visits.index(visit) % self._a_day
        if number % max(1, self._a_day // self._walks) == 0:
            await super()._visit(visit)
            return
        self._bus.now_s = visit.walk.start_s
        covered = View("the camera is covered")
        await self._measuring.decide(
            round(visit.walk.start_s * 1e9), covered, lambda mac: self._hearing((), mac)
        )
        self.week.unused += 1

    @property
    def _a_day(self) -> int:
        return max(1, len(self._house.visits) // self.week.days)

    def _device(self, mac: str) -> HomeDevice:
        """A device of the household; any other is a guest's, which never answers."""
        known = [device for device in self._house.devices if device.mac == mac]
        return known[0] if known else HomeDevice(mac, "guest", 0.0, ((0.0, (0.0, 0.0, 1.0)),), answers=False)

    async def _live_pipeline(self) -> None:
        """A day's share of pictures, packets, poses and statuses, and every question there is."""
        now_ns = time.monotonic_ns()
        for number in range(POSES):
            t_ns = now_ns + number * 1_000_000
            self._poses.put(RobotPose(t_ns, 0.1, 0.2, 0.0, 0.02, 0.02, 1, "slam", "docked"))
        for number in range(PICTURES):
            walking = number < len(self._moving)
            image = self._moving[number] if walking else self._pictures[number % len(self._pictures)]
            assert image is not None
            self._seq += 1
            seen = self._eyes.frames
            self._frames.put(Frame(self._seq * 66_000_000, self._seq, image))
            while self._eyes.frames == seen:  # noqa: ASYNC110 - the eyes have no event
                await asyncio.sleep(0.002)
        if self._sample is not None:
            for number in range(BATCHES):
                self._batches.put(_of_a_stranger(self._sample, self._night * BATCHES + number))
                await asyncio.sleep(0)
        health = Health("daemon")
        for number in range(STATUSES):
            health.counters["poses"] = number
            part = m.Part(part="daemon", state="ok", counters=dict(health.counters))
            message = m.StatusMessage(
                source="simulated", version="0", uptime_s=number, step="soak", parts=(part,)
            )
            self._bus.publish_status(message)
            await asyncio.sleep(0)
        self._asked += await asyncio.to_thread(self._ask_everything, [d.mac for d in self._registry.all()])

    def _ask_everything(self, macs: list[str]) -> int:
        """What clients ask; a device that is missing in an answer is lost."""
        with VadClient(self._endpoint) as client:
            told = {device.mac for device in client.devices()}
            self.month.lost += [
                f"day {self._night}: {mac} is missing in an answer" for mac in set(macs) - told
            ]
            client.status()
            client.captures()
            client.recent_events()
            client.devices_geojson()
            for mac in macs:
                if client.device(mac) is None:
                    self.month.lost.append(f"day {self._night}: {mac} is not told")
                client.history(mac)
                client.heatmap_png(mac)
        return 5 + 3 * len(macs)

    async def _midnight(self) -> None:
        self._count()

    def _count(self) -> None:
        gc.collect()
        sessions = sum(path.stat().st_size for path in self._archive.rglob("*") if path.is_file())
        self.month.nights.append(
            Midnight(
                len(self.month.nights) + 1,
                rss_mb(os.getpid()),
                len(list(Path("/proc/self/fd").iterdir())),
                len(list(Path("/proc/self/task").iterdir())),
                len(asyncio.all_tasks()),
                rss_mb(self._solver.pid) if self._solver.pid else 0.0,
                sum(path.stat().st_size for path in self._folder.glob("vad.sqlite*")) // 1000,
                sessions / 1e6,
                len(self._registry.all()),
                self.week.solved,
                self._asked,
            )
        )
        self.on_night(self.month.nights[-1])

    def _hear(self, visit: Visit, rates: dict[str, float], from_s: float, to_s: float) -> CsiBatch:
        self._sample = self._pool.submit(hear, self._house, visit, rates, from_s, to_s).result()
        return self._sample


def _of_a_stranger(batch: CsiBatch, number: int) -> CsiBatch:
    """Fifty packets as if another station had sent them."""
    some = take_packets(batch.packets, np.arange(min(50, len(batch.packets))))
    stranger = np.full(len(some), 0x0C_0000_0000_00 + number, np.int64)
    arrivals = np.full(len(some), time.monotonic_ns(), np.int64)
    return CsiBatch(replace(some, mac=stranger, arrival_ns=arrivals), b"", np.zeros(len(some), np.int64))


def soak(
    days: int, walks: int, devices: int, seed: int, on_night: Callable[[Midnight], None] = lambda _night: None
) -> Month:
    """Play the days."""
    house = make_household(seed, days=days, devices=devices)
    # The simulated radio's arrays would be most of this process's memory.
    with (
        tempfile.TemporaryDirectory(prefix="vad-soak-") as name,
        ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool,
    ):
        simulation = Soak(house, days, Path(name), walks, pool)
        simulation.on_night = on_night
        asyncio.run(simulation.run())
        month = simulation.month
        with Store(Path(name) / "vad.sqlite") as store:
            kept = {record.mac for record in store.devices()}
        joined = {device.mac for device in house.devices if device.mac in simulation.week.records}
        month.lost += [f"{mac} is not in the store" for mac in sorted(joined - kept)]
    return month


def main() -> None:
    options = argparse.ArgumentParser(prog="tools/bench soak", description=__doc__)
    options.add_argument("--days", type=int, default=30)
    options.add_argument("--walks", type=int, default=3, help="recorded a day")
    options.add_argument("--devices", type=int, default=8, help="of the household")
    options.add_argument("--seed", type=int, default=5, help="which household")
    options.add_argument("--json", action="store_true", dest="as_json")
    given = options.parse_args()
    logging.basicConfig(level=logging.WARNING)
    console, progress = Console(width=130), Console(stderr=True)

    def tell(night: Midnight) -> None:
        progress.print(f"day {night.day}: {night.rss_mb:.0f} MB, {night.solved} solved", highlight=False)

    month = soak(given.days, given.walks, given.devices, given.seed, tell)
    if given.as_json:
        print(json.dumps({**asdict(month), "rows": month.rows(), "kept": month.kept}, indent=1))
    else:
        console.print(nights_table(month.nights))
        table = Table(box=None)
        for name in ("", "measured", "bar", ""):
            table.add_column(name)
        for what, figure, bar, kept in month.rows():
            table.add_row(what, figure, bar, "" if kept is None else "kept" if kept else "NOT KEPT")
        console.print(table)
        for sentence in month.lost:
            console.print(sentence, highlight=False)
    sys.exit(0 if month.kept else 1)


if __name__ == "__main__":
    main()
