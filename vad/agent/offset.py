"""Another machine's clock by exchanges with it: the shortest round trip tells most. Pure.

An exchange bounds the offset to half its round trip, however unequal the two ways were; its age adds what two
crystals may have drifted apart since. Of all exchanges the one with the smallest bound counts.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

DRIFT = 100e-6
"""How fast two clocks may drift apart; crystals of routers and boards stay within half of it each."""
KEPT = 240
SLEW = 0.01
"""A better estimate is worked in at this rate, so that intervals between packets keep their length."""
STEP_NS = 100_000_000
"""A correction that is larger than this was no refinement: it comes at once."""


@dataclass(frozen=True, slots=True)
class _Exchange:
    at_ns: int
    offset_ns: int
    half_trip_ns: int

    def bound_ns(self, t_ns: int) -> float:
        """How wrong the offset can be at t_ns, this machine's clock."""
        return self.half_trip_ns + DRIFT * abs(t_ns - self.at_ns)


class ClockOffset:
    """The offset of the other clock: what is to be added to this machine's times."""

    def __init__(self) -> None:
        self._exchanges: deque[_Exchange] = deque(maxlen=KEPT)
        self._used: tuple[int, int] | None = None  # a time of this machine and the offset handed out for it

    @property
    def known(self) -> bool:
        """Whether there has been any exchange."""
        return bool(self._exchanges)

    def add(self, asked_ns: int, other_ns: int, answered_ns: int) -> None:
        """An exchange: asked and answered at these times of this machine, the other's clock in between."""
        half_ns = (answered_ns - asked_ns) // 2
        middle_ns = asked_ns + half_ns
        self._exchanges.append(_Exchange(middle_ns, other_ns - middle_ns, half_ns))

    def forget(self) -> None:
        """The other machine has begun a new timeline."""
        self._exchanges.clear()
        self._used = None

    def at(self, t_ns: int) -> int:
        """The offset at t_ns, this machine's clock; times should rise from call to call. Needs `known`."""
        wanted_ns = self._best(t_ns).offset_ns
        if self._used is None:
            self._used = (t_ns, wanted_ns)
            return wanted_ns
        from_ns, used_ns = self._used
        miss_ns = wanted_ns - used_ns
        if abs(miss_ns) <= STEP_NS:
            most_ns = int(SLEW * max(0, t_ns - from_ns))
            wanted_ns = used_ns + min(max(miss_ns, -most_ns), most_ns)
        self._used = (max(t_ns, from_ns), wanted_ns)
        return wanted_ns

    def error_ns(self, t_ns: int) -> int:
        """How wrong the offset at t_ns can be. Needs `known`."""
        best = self._best(t_ns)
        used_ns = best.offset_ns if self._used is None else self._used[1]
        return round(best.bound_ns(t_ns)) + abs(used_ns - best.offset_ns)

    def _best(self, t_ns: int) -> _Exchange:
        return min(self._exchanges, key=lambda exchange: exchange.bound_ns(t_ns))
