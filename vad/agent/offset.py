"""Another machine's clock by exchanges with it: the shortest way there and the shortest way back. Pure.

An exchange was asked, answered by the other clock, and came back: the answer's time lies between the two of
this machine, which bounds the offset from both sides, however long and unequal the ways were. Its age adds
what two crystals may have drifted apart since. The bounds of all exchanges together hold the offset: the
upper one comes from the shortest way there, the lower one from the shortest way back, of any round trips.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

DRIFT = 100e-6
"""How fast two clocks may drift apart; crystals of routers and boards stay within half of it each."""
KEPT = 240
SLEW = 0.01
"""A better estimate is worked in at this rate, so that intervals between packets keep their length."""
STEP_NS = 2_000_000
"""A larger correction comes at once: better some packets closer together than all of them too late."""


@dataclass(frozen=True, slots=True)
class _Exchange:
    """Asked and answered at these times of this machine; the other clock somewhere between."""

    asked_ns: int
    other_ns: int
    answered_ns: int

    def low_ns(self, t_ns: int) -> float:
        """The least offset at t_ns that this allows: the other clock was read as late as it could be."""
        return self.other_ns - self.answered_ns - DRIFT * abs(t_ns - self.answered_ns)

    def high_ns(self, t_ns: int) -> float:
        """The largest one."""
        return self.other_ns - self.asked_ns + DRIFT * abs(t_ns - self.asked_ns)


class ClockOffset:
    """The offset of the other clock: what is to be added to this machine's times.

    Attributes:
        restarts: how often exchanges contradicted those before: one of the machines had slept.
    """

    def __init__(self) -> None:
        self.restarts = 0
        self._exchanges: deque[_Exchange] = deque(maxlen=KEPT)
        self._used: tuple[int, int] | None = None  # a time of this machine and the offset handed out for it

    @property
    def known(self) -> bool:
        """Whether there has been any exchange."""
        return bool(self._exchanges)

    def add(self, asked_ns: int, other_ns: int, answered_ns: int) -> None:
        """An exchange: asked and answered at these times of this machine, the other's clock in between."""
        new = _Exchange(asked_ns, other_ns, answered_ns)
        if self._exchanges:
            low_ns, high_ns = self._bounds(answered_ns)
            if new.low_ns(answered_ns) > high_ns or new.high_ns(answered_ns) < low_ns:
                self._exchanges.clear()
                self.restarts += 1
        self._exchanges.append(new)

    def forget(self) -> None:
        """The other machine has begun a new timeline."""
        self._exchanges.clear()
        self._used = None

    def at(self, t_ns: int) -> int:
        """The offset at t_ns, this machine's clock; times should rise from call to call. Needs `known`."""
        wanted_ns = self._middle(t_ns)
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
        low_ns, high_ns = self._bounds(t_ns)
        used_ns = self._middle(t_ns) if self._used is None else self._used[1]
        return round(max(high_ns - used_ns, used_ns - low_ns))

    def _middle(self, t_ns: int) -> int:
        low_ns, high_ns = self._bounds(t_ns)
        return round((low_ns + high_ns) / 2)

    def _bounds(self, t_ns: int) -> tuple[float, float]:
        low_ns = max(exchange.low_ns(t_ns) for exchange in self._exchanges)
        return low_ns, min(exchange.high_ns(t_ns) for exchange in self._exchanges)
