"""What each setting means: read from the docstring of its class.

A docstring is a sentence about the class, an empty line, and a line `name: meaning` for each field; a line
that goes on is indented. A field whose type is itself a class of settings may be left out: it says what that
says.
"""

from __future__ import annotations

import inspect
import re
from dataclasses import dataclass

import msgspec

_ENTRY = re.compile(r"([a-z][a-z0-9_]*): (.+)")

UNITS = {
    "_per_s": "per second",
    "_m": "metres",
    "_s": "seconds",
    "_h": "hours",
    "_ms": "ms",
    "_mb": "MB",
    "_mhz": "MHz",
    "_hz": "Hz",
    "_px": "pixels",
    "_percent": "%",
}
"""What the end of a name says; the longest counts."""


@dataclass(frozen=True, slots=True)
class Meaning:
    """A sentence about a class of settings, and what each of its fields means."""

    summary: str
    fields: dict[str, str]


def meaning(kind: type[msgspec.Struct]) -> Meaning:
    """What the docstring says; ValueError where a field is missing in it, or named that does not exist."""
    head, _, rest = inspect.cleandoc(kind.__doc__ or "").partition("\n\n")
    said: dict[str, str] = {}
    name = ""
    for line in rest.splitlines():
        entry = _ENTRY.fullmatch(line)
        if entry is not None:
            name = entry[1]
            said[name] = entry[2].strip()
        elif line.startswith(" ") and name:
            said[name] += f" {line.strip()}"
        elif line:
            raise ValueError(f"{kind.__name__}: neither `name: meaning` nor indented: {line!r}")
    fields = msgspec.structs.fields(kind)
    for field in fields:
        if field.name not in said and isinstance(field.type, type) and issubclass(field.type, msgspec.Struct):
            said[field.name] = meaning(field.type).summary.rstrip(".")
    if wrong := set(said) ^ {field.name for field in fields}:
        raise ValueError(
            f"{kind.__name__}: {sorted(wrong)}: a line in the docstring for each field, and no other"
        )
    return Meaning(" ".join(head.split()), said)


def unit(name: str) -> str:
    """The unit that a field's name ends on; empty where it has none."""
    ends = [end for end in UNITS if name.endswith(end)]
    return UNITS[max(ends, key=len)] if ends else ""
