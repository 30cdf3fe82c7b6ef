"""The folder of sessions: what is in it, what became of each, and how one is taken away."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import msgspec

from vad.capture.session_writer import HEADER, write_header
from vad.errors import SessionError

CaptureState = Literal["recording", "done", "aborted", "unknown"]

CUT_OFF = "the daemon ended without warning while this was recorded"

_NAME = re.compile(r"(\d{8}T\d{6}\.\d{3})-[0-9a-f]{12}")


class CaptureResult(msgspec.Struct, frozen=True):
    """What the walk by itself said of the device, map frame; note: one sentence."""

    x_m: float | None = None
    y_m: float | None = None
    radius90_m: float | None = None
    note: str = ""


class _Device(msgspec.Struct, frozen=True):
    mac: str | None = None
    name: str | None = None


class _Capture(msgspec.Struct, frozen=True):
    state: str = "unknown"
    reason: str = ""
    packets: int | None = None
    walk_s: float | None = None
    result: CaptureResult | None = None


class _Header(msgspec.Struct, frozen=True):
    device: _Device = _Device()
    source: str = ""
    capture: _Capture = _Capture()


@dataclass(frozen=True, slots=True)
class SessionEntry:
    """One session folder at a glance.

    begun: UTC, None where the name does not tell; state `unknown`: recorded by something else, or its
    session.json cannot be read (then `reason` says why); files: inode -> bytes, for several sessions may
    share the bytes of one walk.
    """

    folder: Path
    begun: datetime | None
    mac: str | None
    name: str | None
    source: str
    state: str
    reason: str
    packets: int | None
    walk_s: float | None
    result: CaptureResult | None
    files: dict[int, int]

    @property
    def id(self) -> str:
        """The folder's name."""
        return self.folder.name

    @property
    def bytes(self) -> int:
        """Of all its files, shared or not."""
        return sum(self.files.values())


def session_id(begun: datetime, mac: str) -> str:
    """The folder's name for a walk that began then: names sort by time."""
    return f"{begun.astimezone(UTC).strftime('%Y%m%dT%H%M%S.%f')[:-3]}-{mac.replace(':', '')}"


def begun_at(name: str) -> datetime | None:
    """When a session began by its folder's name; None where the daemon did not name it."""
    match = _NAME.fullmatch(name)
    if match is None:
        return None
    try:
        return datetime.strptime(match[1], "%Y%m%dT%H%M%S.%f").replace(tzinfo=UTC)
    except ValueError:
        return None


def sessions_in(archive: Path) -> list[SessionEntry]:
    """Every session folder, the oldest first; empty where the folder does not exist yet.

    Raises SessionError where it cannot be read.
    """
    try:
        folders = [Path(entry.path) for entry in os.scandir(archive) if entry.is_dir(follow_symlinks=False)]
    except FileNotFoundError:
        return []
    except OSError as error:
        raise SessionError(f"cannot be read ({error.strerror})", where=str(archive)) from error
    return [
        _entry(folder) for folder in sorted(folders) if (folder / HEADER).exists() or begun_at(folder.name)
    ]


def total_bytes(sessions: Iterable[SessionEntry]) -> int:
    """What they take on the disk; shared bytes count once."""
    files: dict[int, int] = {}
    for session in sessions:
        files |= session.files
    return sum(files.values())


def remove(session: SessionEntry) -> None:
    """Delete the folder. Raises SessionError where that fails."""
    try:
        shutil.rmtree(session.folder)
    except OSError as error:
        raise SessionError(f"cannot be deleted ({error.strerror})", where=str(session.folder)) from error


def note_result(folder: Path, result: CaptureResult) -> None:
    """Write into session.json what the walk said. Raises OSError."""
    plain = _plain(folder)
    if plain is not None:
        capture = plain.pop("capture", {}) | {"result": msgspec.to_builtins(result)}
        write_header(folder, plain, capture)


def close_cut_off(archive: Path) -> list[Path]:
    """Say of every session which a crash cut off that it is void; they stay readable. The folders."""
    found = []
    for session in sessions_in(archive):
        if session.state != "recording":
            continue
        plain = _plain(session.folder)
        if plain is not None:
            capture = plain.pop("capture") | {"state": "aborted", "reason": CUT_OFF}
            write_header(session.folder, plain, capture)
            found.append(session.folder)
    return found


def _plain(folder: Path) -> dict[str, Any] | None:
    """session.json as plain values; None where it is no JSON object."""
    try:
        return msgspec.json.decode((folder / HEADER).read_bytes(), type=dict[str, Any])
    except msgspec.MsgspecError:
        return None


def _entry(folder: Path) -> SessionEntry:
    header = _Header()
    try:
        header = msgspec.json.decode((folder / HEADER).read_bytes(), type=_Header)
    except OSError as error:
        header = _Header(capture=_Capture(reason=f"session.json cannot be read ({error.strerror})"))
    except msgspec.MsgspecError as error:
        header = _Header(capture=_Capture(reason=f"session.json is broken ({error})"))
    capture = header.capture
    return SessionEntry(
        folder,
        begun_at(folder.name),
        header.device.mac,
        header.device.name,
        header.source,
        capture.state,
        capture.reason,
        capture.packets,
        capture.walk_s,
        capture.result,
        _files(folder),
    )


def _files(folder: Path) -> dict[int, int]:
    """inode -> bytes of everything below; what vanishes meanwhile is left out."""
    found: dict[int, int] = {}
    for root, _, names in os.walk(folder):
        for name in names:
            try:
                stat = os.lstat(os.path.join(root, name))  # noqa: PTH118 - thousands of frames
            except OSError:
                continue
            found[stat.st_ino] = stat.st_size
    return found
