"""What the installed unit says, drop-ins included."""

from __future__ import annotations

from pathlib import Path

UNIT = "vad.service"
_PLACES = ("usr/lib/systemd/system", "lib/systemd/system", "run/systemd/system", "etc/systemd/system")
"""Later ones count instead of earlier ones."""


def unit_file(root: Path) -> Path | None:
    """The unit in force below `root`; None where it is not installed."""
    return next((f for place in reversed(_PLACES) if (f := root / place / UNIT).is_file()), None)


def unit_values(root: Path, key: str) -> list[str]:
    """The values of a key that may be given more than once; an empty one takes back those before it."""
    file = unit_file(root)
    files = [] if file is None else [file]
    drop_ins = {f.name: f for place in _PLACES for f in (root / place / f"{UNIT}.d").glob("*.conf")}
    values: list[str] = []
    for one in [*files, *(drop_ins[name] for name in sorted(drop_ins))]:
        for line in one.read_text(encoding="utf-8", errors="replace").splitlines():
            name, found, value = line.partition("=")
            if found and name.strip() == key:
                values = [*values, value.strip()] if value.strip() else []
    return values
