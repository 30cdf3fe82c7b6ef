"""Maps other clocks onto the one timeline (CLOCK_MONOTONIC, int ns); pure: times are arguments."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

COUNTER_RANGE = 1 << 32
TICK_NS = 1000

# A counter that steps back by less than this was reordered; by more, it wrapped.
_REORDER_US = 1_000_000
_BIN_US = 1_000_000
_WINDOW_US = 120_000_000
# Below this span the skew drowns in the jitter of the smallest delays, and costs less than 1 ms.
_SKEW_SPAN_US = 10_000_000
_MAX_SKEW = 500e-6
_SLEW = 0.01
_STEP_NS = 100_000_000
# What jitter cannot explain: the least delays of a living receiver differ by far less.
_JUMP_NS = 50_000_000
# How far two clocks may have drifted apart while nothing came and the skew was not known.
_DRIFT = 100e-6
# A stall of the receiver ends with packets in time; what stays late for so long was set back.
_LATE_NS = 2_000_000_000
_TOO_LATE_NS = 5_000_000_000
# A counter that says the same so often in a row does not count.
_STILL_PACKETS = 10


def unwrap_nic_us(nic_us: NDArray[np.uint32]) -> NDArray[np.int64]:
    """A recorded 1 MHz uint32 counter as int64 us without wraps; starts at its first value; (N,).

    A step back of less than 1 s stays one (reordered records); any other is a wrap. Without arrival times
    a pause of more than 71 minutes or a reset of the counter cannot be told from a shorter pause.
    """
    if not len(nic_us):
        return np.zeros(0, np.int64)
    wide = nic_us.astype(np.int64)
    step = (wide[1:] - wide[:-1]) % COUNTER_RANGE
    step[step > COUNTER_RANGE - _REORDER_US] -= COUNTER_RANGE
    return int(nic_us[0]) + np.concatenate([np.zeros(1, np.int64), np.cumsum(step)])


class ClockMap:
    """A 1 MHz uint32 counter onto the timeline, from pairs of counter and arrival time.

    Arrival is the source's time plus a delay that is never negative and sometimes small, so the line under
    all delays of the last two minutes is the map: its slope is the skew (lower convex hull, the edge over
    the mean time), its height the smallest delay. Jitter of arrival disappears; a constant least delay
    stays in. Corrections are slewed in by at most 1 %, so that intervals keep their length; one of more
    than 0.1 s is a step. The counter's wraps are resolved, across long pauses by the arrival times.

    A counter that leaves the line was reset, and the map starts anew: at once where packets come more than
    50 ms before the line (nothing arrives before it was sent) or more than 5 s after it; where all of
    them come more than 50 ms after it, once that has lasted for 2 s, as no stall does. A counter that does
    not advance cannot be mapped: the arrival times themselves are handed out until it does.

    Output rises with the counter, except across a step or a restart.

    Attributes:
        restarts: how often the map started anew.
        skew: rate of the timeline against the counter, minus 1.
        still: True while the counter does not advance.
    """

    def __init__(self) -> None:
        self.restarts = 0
        self.skew = 0.0
        self._lowest: deque[tuple[int, int]] = deque()  # counter us, smallest delay ns of each bin
        self._height_ns = 0.0  # delay of the line at self._pivot_us
        self._pivot_us = 0
        self._last_counter: int | None = None
        self._last_us = 0
        self._last_arrival_ns = 0
        self._late_since_ns: int | None = None
        self._repeats = 0  # packets in a row with the last counter value, after the first of them
        self._out: tuple[int, int] | None = None  # counter us, time ns: the end of what was handed out

    @property
    def still(self) -> bool:
        return self._repeats >= _STILL_PACKETS

    def update(self, counter: NDArray[np.uint32], arrival_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """The times of the next counter values (N,), which arrived at `arrival_ns` (N,); int64 ns (N,)."""
        if not len(counter):
            return np.zeros(0, np.int64)
        if self._stands_still(counter):
            return arrival_ns.copy()
        us = self._unwrap(counter, int(arrival_ns[0]))
        delay = arrival_ns - us * TICK_NS
        best = int((delay - self._line(us)).argmin())
        self._learn(int(us[best]), int(delay[best]), int(arrival_ns[-1]))
        self._last_us = int(us[-1])
        self._last_arrival_ns = int(arrival_ns[-1])
        return self._apply(us)

    def _stands_still(self, counter: NDArray[np.uint32]) -> bool:
        """Count repeated values; a counter that moves again after it stood still starts a new map."""
        was_still, last = self.still, int(counter[-1])
        if (counter == last).all():
            self._repeats = self._repeats + len(counter) if last == self._last_counter else len(counter) - 1
        else:
            self._repeats = 0
        self._last_counter = last
        if was_still and not self.still:
            self._restart()
        return self.still

    def _restart(self) -> None:
        self.restarts += 1
        self._lowest.clear()
        self._late_since_ns = None
        self._out = None

    def _unwrap(self, counter: NDArray[np.uint32], arrival_ns: int) -> NDArray[np.int64]:
        us = unwrap_nic_us(counter)
        if self._out is None:
            return us
        step = (int(us[0]) - self._last_us) % COUNTER_RANGE
        if step > COUNTER_RANGE - _REORDER_US:
            step -= COUNTER_RANGE
        paused_us = (arrival_ns - self._last_arrival_ns) / TICK_NS
        step += max(0, round((paused_us - step) / COUNTER_RANGE)) * COUNTER_RANGE
        return us + (self._last_us + step - int(us[0]))

    def _line(self, us: NDArray[np.int64]) -> NDArray[np.float64]:
        """Delay of the fitted line in ns."""
        return (us - self._pivot_us).astype(np.float64) * (TICK_NS * self.skew) + self._height_ns

    def _learn(self, us: int, delay_ns: int, now_ns: int) -> None:
        if self._lowest and self._was_reset(us, delay_ns, now_ns):
            self._restart()
        if self._lowest and us // _BIN_US == self._lowest[-1][0] // _BIN_US:
            if delay_ns >= self._lowest[-1][1]:
                self._height_ns += (us - self._pivot_us) * TICK_NS * self.skew
                self._pivot_us = us
                return
            self._lowest[-1] = (us, delay_ns)
        else:
            self._lowest.append((us, delay_ns))
            while us - self._lowest[0][0] > _WINDOW_US:
                self._lowest.popleft()
            self.skew = self._fit_skew()
        times, delays = np.array(self._lowest, np.int64).T
        self._pivot_us = us
        self._height_ns = float((delays - (times - us) * (TICK_NS * self.skew)).min())

    def _was_reset(self, us: int, delay_ns: int, now_ns: int) -> bool:
        """Whether the least delay of a batch contradicts the line."""
        above_ns = delay_ns - (us - self._pivot_us) * TICK_NS * self.skew - self._height_ns
        jump_ns = _JUMP_NS + _DRIFT * abs(us - self._pivot_us) * TICK_NS
        if above_ns <= jump_ns:
            self._late_since_ns = None
            return above_ns < -jump_ns
        if self._late_since_ns is None:
            self._late_since_ns = now_ns
        return above_ns > _TOO_LATE_NS or now_ns - self._late_since_ns >= _LATE_NS

    def _fit_skew(self) -> float:
        points = self._lowest
        if points[-1][0] - points[0][0] < _SKEW_SPAN_US:
            return 0.0
        hull: list[tuple[int, int]] = []
        for x, y in sorted(points):
            while len(hull) >= 2 and (hull[-1][0] - hull[-2][0]) * (y - hull[-2][1]) <= (
                hull[-1][1] - hull[-2][1]
            ) * (x - hull[-2][0]):
                hull.pop()
            hull.append((x, y))
        middle = sum(x for x, _ in points) / len(points)
        right = next(i for i, (x, _) in enumerate(hull) if x >= middle or i == len(hull) - 1)
        (x0, y0), (x1, y1) = hull[max(right - 1, 0)], hull[max(right, 1)]
        slope = (y1 - y0) / ((x1 - x0) * TICK_NS) if x1 > x0 else 0.0
        return min(max(slope, -_MAX_SKEW), _MAX_SKEW)

    def _apply(self, us: NDArray[np.int64]) -> NDArray[np.int64]:
        wanted = us * TICK_NS + np.rint(self._line(us)).astype(np.int64)
        newest = int(np.argmax(us))
        out = wanted
        if self._out is not None:
            from_us, from_ns = self._out
            span_ns = (int(us[newest]) - from_us) * TICK_NS
            rate = 1.0 + self.skew
            miss_ns = int(wanted[newest]) - from_ns - span_ns * rate
            rate_used = rate if span_ns <= 0 else rate + min(max(miss_ns / span_ns, -_SLEW), _SLEW)
            if abs(miss_ns) <= _STEP_NS:
                out = from_ns + np.rint((us - from_us) * (TICK_NS * rate_used)).astype(np.int64)
        if self._out is None or us[newest] >= self._out[0] or out is wanted:
            self._out = (int(us[newest]), int(out[newest]))
        return out
