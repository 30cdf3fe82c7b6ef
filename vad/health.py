"""What a part of the daemon says about itself."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Literal

State = Literal["starting", "ok", "degraded", "failed"]


@dataclass(slots=True)
class Health:
    """State of one part, its counters, and the reason for the last trouble.

    The owner calls `ok`, `trouble`; readers copy. `counters` never go down.
    """

    part: str
    state: State = "starting"
    detail: str = ""
    last_error: str = ""
    counters: Counter[str] = field(default_factory=Counter)

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
        return fresh
