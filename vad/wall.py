"""Wall time as text, for what is published and kept; durations are vad.clock's matter."""

from __future__ import annotations

import re
from datetime import UTC, datetime

_RFC3339 = re.compile(r"\d{4}-\d\d-\d\d[Tt ]\d\d:\d\d:\d\d(\.\d{1,9})?([Zz]|[+-]\d\d:\d\d)")


def now_rfc3339() -> str:
    """Wall time now, UTC, to the millisecond: `2026-01-31T12:00:00.000Z`."""
    return _text(datetime.now(UTC))


def normal_rfc3339(text: str) -> str:
    """Any RFC 3339 time in the form of `now_rfc3339`, so that texts compare as times; else ValueError."""
    if not _RFC3339.fullmatch(text):
        raise ValueError(f"{text!r} is not an RFC 3339 time")
    plain = re.sub(r"(\.\d{6})\d+", r"\1", text.upper())  # Python reads microseconds at most
    return _text(datetime.fromisoformat(plain).astimezone(UTC))


def seconds_between(earlier: str, later: str) -> float:
    """Seconds from one text of `now_rfc3339` to another; negative where the clock was set back."""
    return (datetime.fromisoformat(later) - datetime.fromisoformat(earlier)).total_seconds()


def _text(moment: datetime) -> str:
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")
