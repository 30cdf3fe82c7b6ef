#!/usr/bin/env python3
"""What the daemon costs a hub: start-up, memory, processor and wake-ups, idle and busy.

tools/bench idle [--seed 1] [--idle 30] [--threads] [--json]

`vad run` as a process of its own on a simulated home: a camera at 15 pictures a second, a Neato on a pty,
hostapd, CSI. Idle: nobody moves. Busy: somebody walks, a new device sends 1000 packets a second and is
captured. Solving: until the device's place is told. Figures are of all the daemon's processes together; what
plays the home is not among them. Start-up is held to its bar by the processor's time, for the wall's says how
busy the machine is. Exit code 1 where a bar is not kept.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

from bench_idle_home import FPS, PACKETS_PER_S, PreparedHome
from rich.console import Console
from rich.table import Table

from vad.client import VadClient

TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")
READY_BAR_S, RSS_BAR_MB, BUSY_BAR, IDLE_BAR = 3.0, 300.0, 1.0, 0.05
START_LIMIT_S, SOLVE_LIMIT_S = 60.0, 240.0
SETTLED_FRAMES, SETTLE_LIMIT_S = 45, 60.0
"""Looked at before it counts: at first, everything might be somebody who stands still."""


@dataclass(frozen=True, slots=True)
class Thread:
    """What one thread did in a window."""

    process: str
    name: str
    waits_in: str
    cpu: float
    wakes_per_s: float


@dataclass(frozen=True, slots=True)
class Window:
    """What the daemon's processes did. cpu: of one core; rss_mb: each process's own, added up, its highest;
    pss_mb: with shared pages counted once."""

    seconds: float
    cpu: float
    rss_mb: float
    pss_mb: float
    wakes_per_s: float
    frames_per_s: float
    threads: list[Thread] = field(default_factory=list)


@dataclass(slots=True)
class Cost:
    """All figures."""

    ready_s: float
    ready_cpu_s: float
    idle: Window
    busy: Window
    solving: Window
    packets: int
    capture: str

    def rows(self) -> list[tuple[str, str, str, bool | None]]:
        """What, figure, bar, whether it is kept."""
        busy_mb = max(window.pss_mb for window in (self.idle, self.busy))
        ready = self.ready_cpu_s <= READY_BAR_S
        return [
            ("ready after, wall", f"{self.ready_s:.2f} s", "", None),
            ("ready after, processor", f"{self.ready_cpu_s:.2f} s", f"<= {READY_BAR_S:g} s", ready),
            ("idle, of a core", f"{self.idle.cpu:.1%}", f"<= {IDLE_BAR:.0%}", self.idle.cpu <= IDLE_BAR),
            ("idle, wake-ups a second", f"{self.idle.wakes_per_s:.0f}", "", None),
            (
                "  for each picture",
                f"{self.idle.wakes_per_s / max(self.idle.frames_per_s, 1e-9):.1f}",
                "",
                None,
            ),
            (
                "idle, memory",
                f"{self.idle.pss_mb:.0f} MB",
                f"<= {RSS_BAR_MB:g} MB",
                self.idle.pss_mb <= RSS_BAR_MB,
            ),
            ("busy, of a core", f"{self.busy.cpu:.0%}", f"<= {BUSY_BAR:.0%}", self.busy.cpu <= BUSY_BAR),
            ("busy, memory", f"{busy_mb:.0f} MB", f"<= {RSS_BAR_MB:g} MB", busy_mb <= RSS_BAR_MB),
            ("  pictures looked at a second", f"{self.busy.frames_per_s:.1f}", "", None),
            ("  packets recorded", f"{self.packets}", "", None),
            ("solving, of a core", f"{self.solving.cpu:.0%} for {self.solving.seconds:.0f} s", "", None),
            ("solving, memory", f"{self.solving.pss_mb:.0f} MB", "", None),
        ]

    @property
    def kept(self) -> bool:
        """Whether every bar is kept."""
        return all(good is not False for *_, good in self.rows())


class Processes:
    """A process and its children, as /proc tells."""

    def __init__(self, pid: int) -> None:
        self._pid = pid

    def pids(self) -> list[int]:
        """The process, its children and theirs."""
        found, waiting = [], [self._pid]
        while waiting:
            pid = waiting.pop()
            found.append(pid)
            for task in Path(f"/proc/{pid}/task").glob("*"):
                with contextlib.suppress(OSError):
                    waiting += [int(word) for word in (task / "children").read_text().split()]
        return found

    def memory_mb(self) -> tuple[float, float]:
        """Resident, and with shared pages counted once."""
        rss = pss = 0.0
        for pid in self.pids():
            with contextlib.suppress(OSError):
                for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
                    name, _, rest = line.partition(":")
                    if name in ("Rss", "Pss"):
                        kilobytes = int(rest.split()[0])
                        rss += kilobytes / 1024 * (name == "Rss")
                        pss += kilobytes / 1024 * (name == "Pss")
        return rss, pss

    def cpu_s(self) -> float:
        """Processor time of all of them, ended children's too."""
        return sum(sum(_times(Path(f"/proc/{pid}/stat"))) for pid in self.pids())

    def threads(self) -> dict[tuple[int, int], tuple[str, str, str, float, int]]:
        """For each thread: process, name, what it waits in, processor time, how often it woke."""
        found = {}
        for pid in self.pids():
            for task in Path(f"/proc/{pid}/task").glob("*"):
                with contextlib.suppress(OSError):
                    status = (task / "status").read_text()
                    wakes = int(status.rpartition("\nvoluntary_ctxt_switches:")[2].split()[0])
                    name = (task / "comm").read_text().strip()
                    process = "daemon" if pid == self._pid else Path(f"/proc/{pid}/comm").read_text().strip()
                    key = pid, int(task.name)
                    found[key] = (process, name, _waits_in(task), sum(_times(task / "stat")[:2]), wakes)
        return found


def _times(stat: Path) -> list[float]:
    """utime, stime, and those of ended children; seconds. Nothing where it has gone."""
    try:
        words = stat.read_text().rpartition(")")[2].split()
    except OSError:
        return [0.0]
    return [int(words[k]) * TICK_S for k in (11, 12, 13, 14)]


SYSCALLS = {
    "0": "read",
    "7": "poll",
    "23": "select",
    "35": "nanosleep",
    "45": "recvfrom",
    "47": "recvmsg",
    "202": "futex",
    "230": "clock_nanosleep",
    "232": "epoll_wait",
    "270": "pselect6",
    "281": "epoll_pwait",
}
"""x86-64; others by their number."""


def _waits_in(task: Path) -> str:
    try:
        number = (task / "syscall").read_text().split()[0]
    except OSError:
        return "?"
    return SYSCALLS.get(number, number)


def observe(processes: Processes, frames: Callable[[], int], until: Callable[[float], bool]) -> Window:
    """Watch until `until(seconds)` says so."""
    begun_s, cpu_s, frames_before = time.monotonic(), processes.cpu_s(), frames()
    before = processes.threads()
    rss_mb = pss_mb = 0.0
    while not until(time.monotonic() - begun_s):
        rss, pss = processes.memory_mb()
        rss_mb, pss_mb = max(rss_mb, rss), max(pss_mb, pss)
        time.sleep(0.5)
    seconds = time.monotonic() - begun_s
    threads = []
    for key, (process, name, waits_in, cpu, wakes) in processes.threads().items():
        _, _, _, old_cpu, old_wakes = before.get(key, ("", "", "", 0.0, 0))
        threads.append(
            Thread(process, name, waits_in, (cpu - old_cpu) / seconds, (wakes - old_wakes) / seconds)
        )
    threads.sort(key=lambda thread: -thread.wakes_per_s)
    return Window(
        seconds,
        (processes.cpu_s() - cpu_s) / seconds,
        rss_mb,
        pss_mb,
        sum(thread.wakes_per_s for thread in threads),
        (frames() - frames_before) / seconds,
        threads,
    )


@contextlib.contextmanager
def daemon(folder: Path) -> Iterator[tuple[subprocess.Popen[bytes], float, float]]:
    """`vad run`; with how long it took to be ready, and its processor time until then."""
    address = folder / "notify.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock, (folder / "daemon.log").open("wb") as log:
        sock.bind(str(address))
        sock.settimeout(START_LIMIT_S)
        begun_s = time.monotonic()
        process = subprocess.Popen(
            [sys.executable, "-m", "vad", "run", "--config", str(folder / "vad.yaml")],
            stdout=log,
            stderr=log,
            env=os.environ | {"NOTIFY_SOCKET": str(address)},
        )
        try:
            while b"READY=1" not in sock.recv(4096):
                pass
            ready_s = time.monotonic() - begun_s
            yield process, ready_s, Processes(process.pid).cpu_s()
        finally:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(10.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def measure(seed: int, idle_s: float, folder: Path) -> Cost:
    """The figures of one start."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    home = PreparedHome(seed, folder, port)
    endpoint = f"tcp/127.0.0.1:{port}"
    with home, daemon(folder) as (process, ready_s, ready_cpu_s):
        processes = Processes(process.pid)

        def frames(part: str = "vision") -> int:
            with VadClient(endpoint) as client:  # gone again in between: nobody asks an idle hub
                status = client.status()
            counters = {} if status is None else {part.part: part.counters for part in status.parts}
            return counters.get(part, {}).get("frames", 0)

        until_s = time.monotonic() + SETTLE_LIMIT_S
        while frames("vision") < SETTLED_FRAMES and time.monotonic() < until_s:
            time.sleep(1.0)
        idle = observe(processes, frames, lambda seconds: seconds >= idle_s)
        home.join()
        time.sleep(1.0)
        walking = threading.Thread(target=home.walk)
        walking.start()
        busy = observe(processes, frames, lambda seconds: seconds >= home.walk_s)

        with VadClient(endpoint) as client:

            def told(seconds: float) -> bool:
                done = any(capture.state in ("done", "aborted") for capture in client.captures())
                return done or seconds > SOLVE_LIMIT_S or process.poll() is not None

            solving = observe(processes, frames, told)
            walking.join()
            captures = client.captures()
        states = ", ".join(f"{one.state} {one.reason}".strip() for one in captures) or "no capture"
        return Cost(ready_s, ready_cpu_s, idle, busy, solving, sum(one.packets for one in captures), states)


def main() -> None:
    options = argparse.ArgumentParser(prog="tools/bench idle", description=__doc__)
    options.add_argument("--seed", type=int, default=1, help="which home")
    options.add_argument("--idle", type=float, default=30.0, metavar="SECONDS", help="how long nobody moves")
    options.add_argument("--threads", action="store_true", help="what each thread did")
    options.add_argument("--json", action="store_true", dest="as_json")
    given = options.parse_args()
    with tempfile.TemporaryDirectory(prefix="vad-idle-") as name:
        cost = measure(given.seed, given.idle, Path(name))
    if given.as_json:
        print(json.dumps({**asdict(cost), "rows": cost.rows(), "kept": cost.kept}, indent=1))
    else:
        console = Console(width=120)
        console.print(cost_table(cost))
        console.print(f"the capture: {cost.capture}", highlight=False)
        for title, window in {"idle": cost.idle, "busy": cost.busy}.items() if given.threads else ():
            console.print(threads_table(title, window))
    sys.exit(0 if cost.kept else 1)


def cost_table(cost: Cost) -> Table:
    """All figures beside their bars."""
    table = Table(box=None, title=f"{FPS:g} pictures/s; busy: a walk, {PACKETS_PER_S:g} packets/s")
    for name in ("", "measured", "bar", ""):
        table.add_column(name)
    for what, figure, bar, kept in cost.rows():
        table.add_row(what, figure, bar, "" if kept is None else "kept" if kept else "NOT KEPT")
    return table


def threads_table(title: str, window: Window) -> Table:
    """What each thread did that did anything."""
    table = Table(box=None, title=title)
    for name in ("process", "thread", "waits in", "of a core", "wake-ups/s"):
        table.add_column(name)
    for one in window.threads:
        if one.wakes_per_s >= 0.05 or one.cpu >= 0.001:
            table.add_row(one.process, one.name, one.waits_in, f"{one.cpu:.2%}", f"{one.wakes_per_s:.1f}")
    return table


if __name__ == "__main__":
    main()
