"""What a part of the daemon says about itself."""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from dataclasses import dataclass, field
from typing import Literal

from vad.wall import now_rfc3339

RECENT = 512
"""Durations that are kept to tell a median from."""

State = Literal["starting", "ok", "degraded", "failed"]


@dataclass(slots=True)
class Timing:
    """How long one kind of work took. count, total_s: since the start; recent_s: of late."""

    count: int = 0
    total_s: float = 0.0
    recent_s: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT))

    def add(self, seconds: float) -> None:
        """It was done once more."""
        self.count += 1
        self.total_s += seconds
        self.recent_s.append(seconds)

    def quantile_s(self, share: float) -> float:
        """Which duration this share of the recent ones did not exceed; 0 where there are none."""
        ordered = sorted(self.recent_s)
        return ordered[min(int(share * len(ordered)), len(ordered) - 1)] if ordered else 0.0


@dataclass(slots=True)
class Health:
    """State of one part, its counters, and the reason for the last trouble.

    The owner calls `ok`, `trouble`, `took`; readers copy. `counters` never go down. last_error_at: wall time
    of when the last trouble began.
    """

    part: str
    state: State = "starting"
    detail: str = ""
    last_error: str = ""
    counters: Counter[str] = field(default_factory=Counter)
    last_error_at: str | None = None
    timings: defaultdict[str, Timing] = field(default_factory=lambda: defaultdict(Timing))

    def took(self, work: str, seconds: float) -> None:
        """The part did this kind of work once, in so many seconds."""
        self.timings[work].add(seconds)

    def ok(self, detail: str = "") -> None:
        """The part works."""
        self.state = "ok"
        self.detail = detail

    def trouble(self, reason: str, *, failed: bool = False) -> bool:
        """The part does not work as it should; True when this reason is new (log it then, once)."""
        fresh = reason != self.last_error or self.state == "ok"
        self.state = "failed" if failed else "degraded"
        self.detail = reason
        self.last_error = reason
        if fresh:
            self.last_error_at = now_rfc3339()
        return fresh
