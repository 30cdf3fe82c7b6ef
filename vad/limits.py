"""How deep and how fast messages may be; their size is the hand-over's matter. Pure: time is an argument."""

from __future__ import annotations

import msgspec

from vad.errors import ProtocolError

MAX_DEPTH = 32
"""Nesting of JSON; a parser that recurses gives up, or worse, somewhere beyond a thousand."""

UNREADABLE = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)
"""What msgspec raises for bytes that are not what they should be: text that is no UTF-8 and nesting without
an end come as errors that are not its own."""

_OPEN, _CLOSE, _QUOTE, _BACKSLASH = b"[{", b"]}", ord('"'), ord("\\")


class LimitError(ProtocolError):
    """More than is taken."""

    code = "limit"


def check_depth(json: bytes, max_depth: int = MAX_DEPTH) -> None:
    """LimitError where arrays and objects in `json` are nested deeper than `max_depth`.

    Brackets within strings do not count. Text that is no JSON passes or is refused; it is for the parser.
    """
    if json.count(b"[") + json.count(b"{") <= max_depth:
        return
    depth, quoted, escaped = 0, False, False
    for byte in json:
        if quoted:
            if escaped:
                escaped = False
            elif byte == _BACKSLASH:
                escaped = True
            elif byte == _QUOTE:
                quoted = False
        elif byte == _QUOTE:
            quoted = True
        elif byte in _OPEN:
            depth += 1
            if depth > max_depth:
                raise LimitError(f"nested deeper than {max_depth} levels")
        elif byte in _CLOSE:
            depth -= 1


class RateLimit:
    """So many a second on average, and so many at once; what is more is refused and counted.

    For one thread, or under the caller's lock.
    """

    def __init__(self, per_s: float, burst: int) -> None:
        if not per_s > 0 or burst < 1:
            raise ValueError("per_s must be above 0 and burst at least 1")
        self._per_ns = per_s / 1e9
        self._burst = float(burst)
        self._left = float(burst)
        self._last_ns: int | None = None
        self.refused = 0

    def allows(self, now_ns: int) -> bool:
        """Whether one more may come at `now_ns` (timeline); a clock that goes back adds nothing."""
        if self._last_ns is not None:
            gained = max(0, now_ns - self._last_ns) * self._per_ns
            self._left = min(self._burst, self._left + gained)
        self._last_ns = now_ns
        if self._left < 1.0:
            self.refused += 1
            return False
        self._left -= 1.0
        return True
