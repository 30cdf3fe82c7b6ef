"""What the tests of `vad doctor` share: a visit to a hub that is in a folder."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import yaml

from vad.commands.doctor.identity import Identity
from vad.commands.doctor.visit import Finding, Visit
from vad.config import parse_settings

PLAIN: dict[str, Any] = {
    "robot": {"type": "neato", "port": "/dev/none"},
    "camera": {"source": {"type": "v4l2", "device": "/dev/none"}},
    "radio": {},
    "devices": {},
    "map": {"file": "floor.yaml"},
    "state_dir": "state",
}
STRANGER = Identity("vad", 54_321, frozenset({54_321}))
"""Nobody on this machine: what is not for everybody is not for it."""


def visit(folder: Path, *, listen_s: float = 1.0, service: Identity | None = None, **sections: Any) -> Visit:
    """A visit with settings in `folder`, sections replaced as given; /sys and /proc are there, too."""
    file = folder / "vad.yaml"
    file.write_text(yaml.safe_dump(PLAIN | sections))
    settings = parse_settings(file.read_text(), where="vad.yaml")
    return Visit(settings, file, listen_s, root=folder / "root", service=service)


def verdicts(findings: list[Finding]) -> list[tuple[str, str]]:
    """What is said of what; whatever is wrong has a remedy."""
    for finding in findings:
        assert finding.text, finding
        assert finding.remedy or finding.verdict == "ok", finding
    return [(finding.check, finding.verdict) for finding in findings]


def write(root: Path, name: str, text: str) -> Path:
    """A file below the root folder."""
    file = root / "root" / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    return file


def open_to_all(folder: Path) -> None:
    """Let everybody into `folder`: pytest makes its own for this user alone."""
    for one in (folder, *folder.parents):
        if one != Path("/") and one.stat().st_uid == os.geteuid():
            one.chmod(one.stat().st_mode | 0o055)
