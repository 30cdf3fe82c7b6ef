"""What a soak counts at each midnight, and the bars that the whole time is held against."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, field
from pathlib import Path

from rich.table import Table

GROWTH_BAR = 0.05
WARM_SHARE, WARM_DAYS = 0.2, 6
"""Caches fill and threads start in the first days, however long it goes on."""
SLACK = {"descriptors": 4, "threads": 6, "tasks": 2}
"""The solver's process comes and goes with its pipes, zenoh's threads do, and asyncio's pool fills."""


@dataclass(frozen=True, slots=True)
class Midnight:
    """What was counted at the end of a day. rss_mb, threads, descriptors, tasks: of the process; solver_mb:
    of the solver's, 0 while there is none; store_kb, sessions_mb: on the disk."""

    day: int
    rss_mb: float
    descriptors: int
    threads: int
    tasks: int
    solver_mb: float
    store_kb: int
    sessions_mb: float
    devices: int
    solved: int
    asked: int


@dataclass(slots=True)
class Month:
    """The whole time. lost: devices that are known no more, and answers that lacked one."""

    seconds: float = 0.0
    nights: list[Midnight] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    walks: int = 0
    removed: int = 0

    @property
    def warm(self) -> Midnight:
        """The end of the warm-up."""
        days = max(WARM_DAYS, round(len(self.nights) * WARM_SHARE))
        return self.nights[min(days, len(self.nights)) - 1]

    @property
    def after(self) -> list[Midnight]:
        """All nights from there on."""
        return self.nights[self.nights.index(self.warm) :]

    def rows(self) -> list[tuple[str, str, str, bool | None]]:
        """What, figure, bar, whether it is kept."""
        after, warm = self.after, self.warm
        growth = max(night.rss_mb for night in after) / warm.rss_mb - 1.0
        rows: list[tuple[str, str, str, bool | None]] = [
            ("days simulated", f"{len(self.nights)} in {self.seconds:.0f} s", "", None),
            ("walks, sessions solved", f"{self.walks}, {self.nights[-1].solved}", "", None),
            ("sessions deleted by the quota", str(self.removed), "", None),
            ("questions asked", str(self.nights[-1].asked), "", None),
            ("devices at the end", str(self.nights[-1].devices), "", None),
            ("memory after warm-up", f"{warm.rss_mb:.0f} MB, {growth:+.1%}", "<= +5 %", growth <= GROWTH_BAR),
        ]
        for name in ("descriptors", "threads", "tasks"):
            counts = [getattr(night, name) for night in after]
            told = f"{min(counts)} to {max(counts)}" if min(counts) != max(counts) else str(counts[0])
            rows.append((name, told, f"+{SLACK[name]} at most", max(counts) <= counts[0] + SLACK[name]))
        rows.append(("devices lost", str(len(self.lost)), "0", not self.lost))
        return rows

    @property
    def kept(self) -> bool:
        """Whether every bar is kept."""
        return all(good is not False for *_, good in self.rows())


def nights_table(nights: list[Midnight]) -> Table:
    """Each midnight."""
    table = Table(box=None)
    names = (
        "day",
        "RSS MB",
        "descriptors",
        "threads",
        "tasks",
        "solver MB",
        "store kB",
        "sessions MB",
        "devices",
    )
    for name in (*names, "solved", "asked"):
        table.add_column(name, justify="right")
    for night in nights:
        table.add_row(
            *(f"{value:.1f}" if isinstance(value, float) else str(value) for value in asdict(night).values())
        )
    return table


def rss_mb(pid: int) -> float:
    """Memory of a process in use; 0 where there is none."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except OSError:
        return 0.0
