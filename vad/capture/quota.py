"""Keeps the session folder within its share of the disk: the oldest sessions go first."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import Path

from vad.capture.archive import SessionEntry, remove, sessions_in, total_bytes
from vad.errors import SessionError


def to_remove(sessions: Sequence[SessionEntry], allowed_bytes: int) -> list[SessionEntry]:
    """Which of `sessions` go, oldest first, so that the rest takes `allowed_bytes` at most.

    A session that is being recorded, or that the daemon did not name (somebody put it there), never goes.
    Bytes that sessions share are free only when the last of these is gone.
    """
    held = total_bytes(sessions)
    owners = Counter(inode for session in sessions for inode in session.files)
    gone = []
    for session in sorted(sessions, key=lambda s: s.id):
        if held <= allowed_bytes:
            break
        if session.begun is None or session.state == "recording":
            continue
        for inode, size in session.files.items():
            owners[inode] -= 1
            held -= size if owners[inode] == 0 else 0
        gone.append(session)
    return gone


def enforce(
    archive: Path, *, quota_bytes: int, keep_free_bytes: int, spare: Collection[str] = ()
) -> list[str]:
    """Remove the oldest sessions until they take `quota_bytes` at most and the disk has `keep_free_bytes`.

    Blocking. spare: ids that stay whatever happens. Returns what was removed, by id. Raises SessionError.
    """
    sessions = sessions_in(archive)
    if not sessions:
        return []
    held = total_bytes(sessions)
    try:
        disk = os.statvfs(archive)
    except OSError as error:
        raise SessionError(f"cannot be read ({error.strerror})", where=str(archive)) from error
    free = disk.f_bavail * disk.f_frsize
    allowed = min(quota_bytes, held + free - keep_free_bytes)
    spared = [s for s in sessions if s.id not in spare]
    rest = held - total_bytes(spared)
    gone = to_remove(spared, allowed - rest)
    for session in gone:
        remove(session)
    return [session.id for session in gone]
