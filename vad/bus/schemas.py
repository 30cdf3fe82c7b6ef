"""JSON Schemas of the messages, generated from their types.

`python -m vad.bus.schemas FOLDER` writes one `<schema id>.json` each; the checked-in copies in
tests/bus/schemas make every change of the wire format a visible one.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import msgspec

from vad.bus.messages import ALL, schema_id

SCHEMA_ENCODING = "application/schema+json"


def json_schemas() -> dict[str, str]:
    """Schema id -> JSON Schema (2020-12) as indented text with sorted keys; a hub answers them, too."""
    return {
        schema_id(kind): json.dumps(msgspec.json.schema(kind), indent=2, sort_keys=True) + "\n"
        for kind in ALL
    }


def write_schemas(folder: Path) -> list[Path]:
    """Write every schema into `folder`; the files written."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, text in json_schemas().items():
        path = folder / f"{name}.json"
        path.write_text(text, encoding="utf-8")
        written.append(path)
    return written


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m vad.bus.schemas FOLDER")
    write_schemas(Path(sys.argv[1]))
