"""Health of the parts, as the status tells it: counters with their rates, latencies."""

from __future__ import annotations

from collections import deque

from vad.bus import messages as m
from vad.health import Health, Timing

WINDOW_S = 10.0
"""Rates are told over this time."""


class Parts:
    """Makes the status's parts; remembers the counters of the last WINDOW_S to tell rates from."""

    def __init__(self) -> None:
        self._seen: dict[str, deque[tuple[float, dict[str, int]]]] = {}

    def tell(self, healths: list[Health], now_s: float) -> tuple[m.Part, ...]:
        """All parts as they are now. now_s: of a clock that never goes back. Equal names are numbered."""
        told: dict[str, m.Part] = {}
        for health in healths:
            name, number = health.part, 2
            while name in told:
                name, number = f"{health.part} {number}", number + 1
            told[name] = self._part(name, health, now_s)
        return tuple(told.values())

    def _part(self, name: str, health: Health, now_s: float) -> m.Part:
        counters = dict(health.counters)
        return m.Part(
            part=name,
            state=health.state,
            detail=health.detail,
            last_error=health.last_error,
            last_error_at=health.last_error_at,
            counters=counters,
            rates_per_s=self._rates(name, counters, now_s),
            latencies={work: _latency(timing) for work, timing in health.timings.items()},
        )

    def _rates(self, name: str, counters: dict[str, int], now_s: float) -> dict[str, float]:
        seen = self._seen.setdefault(name, deque())
        seen.append((now_s, counters))
        while len(seen) > 2 and seen[1][0] <= now_s - WINDOW_S:
            seen.popleft()
        begun_s, before = seen[0]
        if now_s <= begun_s:
            return {}
        moved = {name: count - before.get(name, 0) for name, count in counters.items()}
        return {name: round(step / (now_s - begun_s), 1) for name, step in moved.items() if step}


def _latency(timing: Timing) -> m.Latency:
    return m.Latency(
        count=timing.count,
        total_s=round(timing.total_s, 3),
        p50_ms=round(1e3 * timing.quantile_s(0.5), 2),
        p99_ms=round(1e3 * timing.quantile_s(0.99), 2),
        max_ms=round(1e3 * max(timing.recent_s, default=0.0), 2),
    )
