"""How values are written for people."""

from __future__ import annotations


def printable(text: str) -> str:
    """`text` without control characters: a name comes off the air, and must not steer a terminal."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


def metres(value: float | None, sign: str = "") -> str:
    """Metres with two decimals, an en dash where there is none."""
    return "–" if value is None else f"{sign}{value:.2f}"


def duration(seconds: float) -> str:
    """Seconds as `12 s`, `3 min 5 s`, `2 h 10 min`, `4 d 3 h`."""
    whole = int(seconds)
    for size, unit, below, below_unit in (
        (86400, "d", 3600, "h"),
        (3600, "h", 60, "min"),
        (60, "min", 1, "s"),
    ):
        if whole >= size:
            return f"{whole // size} {unit} {whole % size // below} {below_unit}"
    return f"{whole} s"
