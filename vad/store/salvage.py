"""What can still be read of a damaged database is taken over into the new one."""

from __future__ import annotations

import contextlib
import logging
import sqlite3
from pathlib import Path

log = logging.getLogger(__name__)

_TABLES = {
    "epochs": "rowid",
    "cameras": "id",
    "agents": "id",
    "identities": "mac",
    "devices": "mac",
    "posteriors": "rowid",
    "history": "rowid",
}
"""Table -> what its rows lie in order of; in the order that references between them want."""


def salvage(db: sqlite3.Connection, damaged: Path) -> dict[str, int]:
    """Copy row by row what is whole; how many rows of which table. Never fails for the damage's sake."""
    taken: dict[str, int] = {}
    with contextlib.closing(_read_only(damaged)) as old:
        for table, key in _TABLES.items():
            columns = _shared_columns(old, db, table)
            if columns:
                taken[table] = _copy(old, db, table, key, columns)
    return {table: count for table, count in taken.items() if count}


def _read_only(path: Path) -> sqlite3.Connection:
    # immutable: the damaged file stays byte for byte what it was
    return sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)


def _shared_columns(old: sqlite3.Connection, new: sqlite3.Connection, table: str) -> list[str]:
    try:
        had = {row[1] for row in old.execute(f"PRAGMA table_info({table})")}
    except sqlite3.Error:
        return []
    return [row[1] for row in new.execute(f"PRAGMA table_info({table})") if row[1] in had]


def _copy(old: sqlite3.Connection, new: sqlite3.Connection, table: str, key: str, columns: list[str]) -> int:
    """From both ends towards the damage: rows behind it are found from the other side."""
    names = ", ".join(columns)
    marks = ", ".join("?" * len(columns))
    count = 0
    for order in ("ASC", "DESC"):
        try:
            rows = old.execute(f"SELECT {names} FROM {table} ORDER BY {key} {order}")
            for row in rows:
                with contextlib.suppress(sqlite3.IntegrityError):  # torn: no value where one must be
                    sql = f"INSERT OR IGNORE INTO {table} ({names}) VALUES ({marks})"
                    count += new.execute(sql, row).rowcount
        except sqlite3.DatabaseError as error:
            log.debug("salvaging %s: %s", table, error)
    return count
