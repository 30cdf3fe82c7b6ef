"""A stream's own stamps onto the one timeline: which clock they are is decided once per connection. Pure."""

from __future__ import annotations

from typing import Literal

StampSource = Literal["undecided", "monotonic", "wall", "arrival"]

# Pictures are not from the future, but for the rounding of clocks, and in a live stream not older than this.
_FUTURE_NS = 20_000_000
_OLDEST_NS = 2_000_000_000

# ustreamer sends the time of sending (wall clock) as X-Timestamp and, with ?extra_headers=1, the time of
# grabbing (CLOCK_MONOTONIC); mjpg-streamer passes the driver's stamp on, CLOCK_MONOTONIC on Linux; an
# ESP32's counts from its own start and fits neither clock.
_GRABBED = "x-ustreamer-grab-time"
_STAMP = "x-timestamp"


def parse_seconds_ns(text: str) -> int | None:
    """`123.456789` to ns, exactly; None if it is not such a number."""
    whole, _, part = text.strip().partition(".")
    if not (whole.isascii() and whole.isdigit() and len(whole) <= 11):
        return None
    if part and not (part.isascii() and part.isdigit()):
        return None
    return int(whole) * 1_000_000_000 + int(part[:9].ljust(9, "0"))


def is_plausible(t_ns: int, arrival_ns: int, oldest_ns: int = _OLDEST_NS) -> bool:
    """Whether a picture that came at `arrival_ns` can have been taken at `t_ns`."""
    return -_FUTURE_NS <= arrival_ns - t_ns <= oldest_ns


class StreamClock:
    """Exposure times of one connection's pictures.

    `source` tells which clock the stamps were found to be, by the first picture. A later stamp that is not
    plausible counts in `refused`, and its picture gets its arrival.
    """

    def __init__(self) -> None:
        self.source: StampSource = "undecided"
        self.refused = 0
        self._header = _STAMP

    def stamp(self, headers: dict[str, str], arrival_ns: int, wall_ns: int) -> int:
        """Timeline ns of one picture.

        Args:
            headers: of its part, names in lower case. arrival_ns: timeline; wall_ns: wall clock, same moment.
        """
        if self.source == "undecided":
            self._decide(headers, arrival_ns, wall_ns)
        if self.source == "arrival":
            return arrival_ns
        t_ns = self._read(headers, self._header, arrival_ns - wall_ns if self.source == "wall" else 0)
        if t_ns is None or not is_plausible(t_ns, arrival_ns):
            self.refused += 1
            return arrival_ns
        return min(t_ns, arrival_ns)

    def _decide(self, headers: dict[str, str], arrival_ns: int, wall_ns: int) -> None:
        for header in (_GRABBED, _STAMP):
            for source, shift_ns in (("monotonic", 0), ("wall", arrival_ns - wall_ns)):
                t_ns = self._read(headers, header, shift_ns)
                if t_ns is not None and is_plausible(t_ns, arrival_ns):
                    self.source = "wall" if source == "wall" else "monotonic"
                    self._header = header
                    return
        self.source = "arrival"

    @staticmethod
    def _read(headers: dict[str, str], header: str, shift_ns: int) -> int | None:
        own_ns = parse_seconds_ns(headers.get(header, ""))
        return None if own_ns is None else own_ns + shift_ns
