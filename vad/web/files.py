"""The page's files, which come along in the package: read once, served from memory."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from importlib.resources import files

_KINDS = {
    ".html": "text/html",
    ".css": "text/css",
    ".js": "text/javascript",
    ".svg": "image/svg+xml",
    ".webmanifest": "application/manifest+json",
}


@dataclass(frozen=True, slots=True)
class StaticFile:
    """One file. kind: its media type; etag: changes with the content."""

    content: bytes
    kind: str
    charset: str
    etag: str


def static_files() -> dict[str, StaticFile]:
    """Every file by its name."""
    found = {}
    for file in (files("vad.web") / "static").iterdir():
        suffix = file.name[file.name.rfind(".") :]
        if suffix in _KINDS:
            content = file.read_bytes()
            etag = f'"{hashlib.sha256(content).hexdigest()[:16]}"'
            found[file.name] = StaticFile(content, _KINDS[suffix], "utf-8", etag)
    return found
