"""The budget of provoked packets: a home's Wi-Fi has other things to do. Pure; `now_ns` is an argument."""

from __future__ import annotations

ECHO_AIRTIME_S = 0.0005
"""A request and its reply of some 100 bytes each at HT20: preambles, spacing, back-off, acknowledgements."""
HOUR_S = 3600.0


class Airtime:
    """What is left of the share of the channel's time, averaged over an hour; it starts full.

    Args:
        share: of the channel's time, 0 to 1.
    """

    def __init__(self, share: float, now_ns: int) -> None:
        self._share = share
        self._left_s = share * HOUR_S
        self._at_ns = now_ns

    def left_s(self, now_ns: int) -> float:
        """Seconds of airtime that may be used now; below 0 after a walk that took more than was left."""
        gained = (now_ns - self._at_ns) / 1e9 * self._share
        return min(self._share * HOUR_S, self._left_s + max(0.0, gained))

    def spend(self, now_ns: int, packets: int) -> None:
        """So many echo requests were sent."""
        self._left_s = self.left_s(now_ns) - packets * ECHO_AIRTIME_S
        self._at_ns = max(self._at_ns, now_ns)

    def allows(self, now_ns: int, packets_per_s: float, seconds: float) -> bool:
        """Whether a walk of so long may be provoked at this rate (all devices together)."""
        return self.left_s(now_ns) >= packets_per_s * seconds * ECHO_AIRTIME_S
