"""How the database file is opened: checked, brought up to date behind a backup, set aside where damaged."""

from __future__ import annotations

import contextlib
import logging
import os
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from vad.errors import VadError

log = logging.getLogger(__name__)

BUSY_TIMEOUT_S = 5.0
BACKUPS_KEPT = 3

_CORRUPT = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
_PASSING = (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_BUSY, sqlite3.SQLITE_READONLY)


class StoreError(VadError):
    """The store cannot be read or written. passing: the same may succeed later (a full disk, a lock)."""

    code = "store"

    def __init__(self, what: str, *, where: str = "", remedy: str = "", passing: bool = False) -> None:
        super().__init__(what, where=where, remedy=remedy)
        self.passing = passing


def connect(path: Path) -> sqlite3.Connection:
    """A connection to a sound database; sqlite3.DatabaseError where it is not one."""
    new = not path.exists()
    # one thread at a time uses it, but not the one that made it (see worker.py)
    db = sqlite3.connect(path, timeout=BUSY_TIMEOUT_S, isolation_level=None, check_same_thread=False)
    try:
        # One owner: a second daemon is refused, and no shared-memory file is needed, which could not be made
        # on a full disk.
        db.execute("PRAGMA locking_mode = EXCLUSIVE")
        db.execute("PRAGMA journal_mode = WAL")
        # FULL: a commit is on the disk before it is acknowledged; NORMAL would lose the last at a power cut
        db.execute("PRAGMA synchronous = FULL")
        db.execute("PRAGMA foreign_keys = ON")
        (verdict,) = db.execute("PRAGMA integrity_check(1)").fetchone()
        if verdict != "ok":
            raise sqlite3.DatabaseError(f"malformed: {verdict}")
    except BaseException:
        db.close()
        raise
    path.chmod(0o600)
    if new:
        _sync_folder(path.parent)  # the file's name, too, outlives a power cut
    return db


def is_corruption(error: sqlite3.DatabaseError) -> bool:
    """True where the bytes are wrong, not the disk, the lock or the rights."""
    code = getattr(error, "sqlite_errorcode", None)
    if code is None:
        return "malformed" in str(error)
    return code & 0xFF in _CORRUPT


def set_aside(path: Path) -> Path:
    """Rename a damaged database with its log; the new name."""
    aside = path.with_name(f"{path.name}.corrupt-{_stamp()}")
    for suffix in ("-wal", "-shm"):
        side = path.with_name(path.name + suffix)
        if side.exists():
            side.rename(aside.with_name(aside.name + suffix))
    path.rename(aside)
    return aside


def migrate(db: sqlite3.Connection, path: Path, migrations: Sequence[str]) -> Path | None:
    """Bring the schema up to date; where the backup is that was made before, None where none was needed."""
    db.execute("CREATE TABLE IF NOT EXISTS schema_version (version INTEGER NOT NULL)")
    if db.execute("SELECT count(*) FROM schema_version").fetchone() == (0,):
        db.execute("INSERT INTO schema_version VALUES (0)")
    version = version_of(db)
    if version > len(migrations):
        raise StoreError(
            f"the file has version {version}, this vad knows {len(migrations)}",
            where=str(path),
            remedy="Install the newer vad again, or move the file away to begin anew",
        )
    backup = _back_up(db, path, version) if 0 < version < len(migrations) else None
    for number, script in enumerate(migrations[version:], start=version + 1):
        # one transaction a step: a crash leaves the step before, whole
        try:
            db.executescript(
                f"BEGIN IMMEDIATE;\n{script}\n;UPDATE schema_version SET version = {number};\nCOMMIT;"
            )
        except sqlite3.Error:
            if db.in_transaction:
                db.execute("ROLLBACK")
            raise
    return backup


def version_of(db: sqlite3.Connection) -> int:
    """How many migrations the file has been through."""
    (version,) = db.execute("SELECT version FROM schema_version").fetchone()
    return int(version)


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """SQLite's and the file system's errors as StoreError."""
    try:
        yield
    except sqlite3.Error as error:
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        raise StoreError(
            f"the store cannot be used: {error}",
            where=str(path),
            remedy="Another vad uses it: stop that one"
            if code == sqlite3.SQLITE_BUSY
            else "Check the disk's space and the rights",
            passing=code in _PASSING,
        ) from error
    except OSError as error:
        raise StoreError(
            f"the store cannot be used: {os.strerror(error.errno or 0)}",
            where=str(path),
            remedy="Check the folder's rights and the disk's space, or set another state folder",
        ) from error


def _back_up(db: sqlite3.Connection, path: Path, version: int) -> Path:
    """Copy the database as it is, and keep the last BACKUPS_KEPT copies; an error leaves no half copy."""
    backup = path.with_name(f"{path.name}.v{version}-{_stamp()}.bak")
    draft = backup.with_suffix(".new")
    try:
        with contextlib.closing(sqlite3.connect(draft)) as copy:
            draft.chmod(0o600)
            db.backup(copy)
            copy.execute("PRAGMA journal_mode = DELETE")
        with draft.open("rb") as file:
            os.fsync(file.fileno())
        draft.rename(backup)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)
    # By the time in the name: a file's own counts milliseconds, and is another one where it was copied.
    made = sorted(path.parent.glob(f"{path.name}.v*.bak"), key=lambda one: one.name.rpartition("-")[2])
    for old in made[:-BACKUPS_KEPT]:
        old.unlink()
    log.info("the database is brought up to date; as it was before, it is kept as %s", backup)
    return backup


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _stamp() -> str:
    return datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%fZ")
