"""The daemon's memory: one SQLite file. Blocking; the event loop uses `vad.store.worker`."""

from __future__ import annotations

import json
import logging
import os
import sqlite3
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from vad.errors import VadError
from vad.store.migrations import MIGRATIONS
from vad.store.records import (
    CameraRecord,
    DeviceRecord,
    EpochRecord,
    Estimate,
    HistoryRecord,
    PosteriorRecord,
)

log = logging.getLogger(__name__)

BUSY_TIMEOUT_S = 5.0
HISTORY_KEPT = 1000
"""Rows of history a device keeps."""

_DEVICE_COLUMNS = (
    "mac, name, state, reason, epoch, walks, evidence, x_m, y_m, var_x_m2, cov_xy_m2, var_y_m2, "
    "radius90_m, region90, room, method, discovered_at, updated_at"
)


class StoreError(VadError):
    """The store cannot be read or written."""

    code = "store"


class Store:
    """What survives a restart: devices, posteriors, camera calibrations, map epochs, history.

    Opens (and where needed creates, migrates) the file at `path`. A file that is no sound database is
    renamed `<name>.corrupt-<time>` and a new one begun; `set_aside` then tells where the old one is. A file
    of a newer version is refused with StoreError and left alone. Every write is durable when its method
    returns. Not for two threads at once.
    """

    def __init__(self, path: Path, *, migrations: Sequence[str] = MIGRATIONS) -> None:
        self.path = path
        self.set_aside: Path | None = None
        with _explained(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                self._db = _open_checked(path)
            except sqlite3.DatabaseError as error:
                if not _is_corruption(error):
                    raise
                self.set_aside = _set_aside(path)
                log.warning("%s is damaged (%s); it was set aside as %s", path, error, self.set_aside)
                self._db = _open_checked(path)
            try:
                self._migrate(migrations)
            except BaseException:
                self._db.close()
                raise

    def close(self) -> None:
        """Write everything down and close; safe to call twice."""
        self._db.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def version(self) -> int:
        """The schema's version: how many migrations the file has been through."""
        (version,) = self._db.execute("SELECT version FROM schema_version").fetchone()
        return int(version)

    def devices(self) -> list[DeviceRecord]:
        """All devices, by MAC."""
        with _explained(self.path):
            rows = self._db.execute(f"SELECT {_DEVICE_COLUMNS} FROM devices ORDER BY mac").fetchall()
        return [_device(row) for row in rows]

    def device(self, mac: str) -> DeviceRecord | None:
        """One device."""
        with _explained(self.path):
            row = self._db.execute(f"SELECT {_DEVICE_COLUMNS} FROM devices WHERE mac = ?", (mac,)).fetchone()
        return None if row is None else _device(row)

    def save_device(self, device: DeviceRecord, posterior: PosteriorRecord | None = None) -> None:
        """Write a device, its posterior where given, and history where it has news: all or nothing."""
        if posterior is not None and posterior.mac != device.mac:
            raise ValueError(f"the posterior of {posterior.mac} cannot be kept with {device.mac}")
        with self._transaction() as db:
            _write_device(db, device)
            if posterior is not None:
                _write_posterior(db, posterior)

    def forget_device(self, mac: str) -> bool:
        """Delete a device with its posterior and history; False where it was not known."""
        with self._transaction() as db:
            return db.execute("DELETE FROM devices WHERE mac = ?", (mac,)).rowcount > 0

    def posterior(self, mac: str) -> PosteriorRecord | None:
        """A device's posterior; StoreError where the stored grid is damaged."""
        with _explained(self.path):
            row = self._db.execute(
                "SELECT epoch, x0_m, y0_m, x1_m, y1_m, step_m, width, height, walks, log_posterior, "
                "updated_at FROM posteriors WHERE mac = ?",
                (mac,),
            ).fetchone()
        if row is None:
            return None
        epoch, x0, y0, x1, y1, step_m, width, height, walks, blob, updated_at = row
        try:
            grid = np.frombuffer(zlib.decompress(blob), "<f4").astype(np.float32).reshape(height, width)
        except (zlib.error, ValueError) as error:
            raise StoreError(f"the posterior of {mac} is damaged: {error}", where=str(self.path)) from error
        return PosteriorRecord(mac, epoch, (x0, y0, x1, y1), step_m, walks, grid, updated_at)

    def history(self, mac: str, limit: int = HISTORY_KEPT) -> list[HistoryRecord]:
        """What was said of a device, the newest first."""
        with _explained(self.path):
            rows = self._db.execute(
                "SELECT mac, at, state, epoch, x_m, y_m, radius90_m FROM history "
                "WHERE mac = ? ORDER BY id DESC LIMIT ?",
                (mac, limit),
            ).fetchall()
        return [HistoryRecord(*row) for row in rows]

    def save_camera(self, camera: CameraRecord) -> None:
        """Write a camera's calibration for its epoch."""
        with self._transaction() as db:
            db.execute(
                "INSERT OR REPLACE INTO cameras (id, epoch, calibration, updated_at) VALUES (?, ?, ?, ?)",
                (camera.id, camera.epoch, json.dumps(camera.calibration), camera.updated_at),
            )

    def cameras(self, epoch: int) -> list[CameraRecord]:
        """The calibrations that hold in `epoch`, by id."""
        with _explained(self.path):
            rows = self._db.execute(
                "SELECT id, epoch, calibration, updated_at FROM cameras WHERE epoch = ? ORDER BY id", (epoch,)
            ).fetchall()
        return [CameraRecord(id_, at, json.loads(text), updated) for id_, at, text, updated in rows]

    def save_epoch(self, epoch: EpochRecord) -> None:
        """Write a map epoch."""
        with self._transaction() as db:
            db.execute(
                "INSERT OR REPLACE INTO epochs (epoch, fingerprint, since) VALUES (?, ?, ?)",
                (epoch.epoch, epoch.fingerprint, epoch.since),
            )

    def last_epoch(self) -> EpochRecord | None:
        """The map epoch with the highest number."""
        with _explained(self.path):
            row = self._db.execute(
                "SELECT epoch, fingerprint, since FROM epochs ORDER BY epoch DESC LIMIT 1"
            ).fetchone()
        return None if row is None else EpochRecord(*row)

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with _explained(self.path):
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield self._db
            except BaseException:
                self._db.execute("ROLLBACK")
                raise
            self._db.execute("COMMIT")

    def _migrate(self, migrations: Sequence[str]) -> None:
        self._db.execute("CREATE TABLE IF NOT EXISTS schema_version (version INTEGER NOT NULL)")
        if self._db.execute("SELECT count(*) FROM schema_version").fetchone() == (0,):
            self._db.execute("INSERT INTO schema_version VALUES (0)")
        version = self.version
        if version > len(migrations):
            raise StoreError(
                f"the file has version {version}, this vad knows {len(migrations)}",
                where=str(self.path),
                remedy="Install the newer vad again, or move the file away to begin anew",
            )
        for number, script in enumerate(migrations[version:], start=version + 1):
            # one transaction a step: a crash leaves the step before, whole
            try:
                self._db.executescript(
                    f"BEGIN IMMEDIATE;\n{script}\n;UPDATE schema_version SET version = {number};\nCOMMIT;"
                )
            except sqlite3.Error:
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
                raise


def _open_checked(path: Path) -> sqlite3.Connection:
    """A connection to a sound database; sqlite3.DatabaseError where it is not one."""
    # one thread at a time uses it, but not the one that made it (see worker.py)
    db = sqlite3.connect(path, timeout=BUSY_TIMEOUT_S, isolation_level=None, check_same_thread=False)
    try:
        db.execute("PRAGMA journal_mode = WAL")
        db.execute("PRAGMA synchronous = FULL")
        db.execute("PRAGMA foreign_keys = ON")
        (verdict,) = db.execute("PRAGMA quick_check(1)").fetchone()
        if verdict != "ok":
            raise sqlite3.DatabaseError(f"malformed: {verdict}")
    except BaseException:
        db.close()
        raise
    path.chmod(0o600)
    return db


def _is_corruption(error: sqlite3.DatabaseError) -> bool:
    """True where the bytes are wrong, not the disk, the lock or the rights."""
    code = getattr(error, "sqlite_errorcode", None)
    if code is None:
        return "malformed" in str(error)
    return code & 0xFF in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)


def _set_aside(path: Path) -> Path:
    """Rename a damaged database with its log; the new name."""
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%fZ")
    aside = path.with_name(f"{path.name}.corrupt-{stamp}")
    for suffix in ("-wal", "-shm"):
        side = path.with_name(path.name + suffix)
        if side.exists():
            side.rename(aside.with_name(aside.name + suffix))
    path.rename(aside)
    return aside


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """SQLite's and the file system's errors as StoreError."""
    try:
        yield
    except sqlite3.Error as error:
        raise StoreError(
            f"the store cannot be used: {error}",
            where=str(path),
            remedy="Check the disk's space and the rights",
        ) from error
    except OSError as error:
        raise StoreError(
            f"the store cannot be used: {os.strerror(error.errno or 0)}",
            where=str(path),
            remedy="Check the folder's rights, or set another state folder",
        ) from error


def _write_device(db: sqlite3.Connection, device: DeviceRecord) -> None:
    where = device.estimate
    (xx, xy), (_, yy) = where.covariance_m2 if where else ((None, None), (None, None))
    values: tuple[Any, ...] = (
        device.mac,
        device.name,
        device.state,
        device.reason,
        device.epoch,
        device.walks,
        json.dumps(device.evidence),
        where.x_m if where else None,
        where.y_m if where else None,
        xx,
        xy,
        yy,
        where.radius90_m if where else None,
        json.dumps(where.region90) if where else None,
        where.room if where else None,
        where.method if where else None,
        device.discovered_at,
        device.updated_at,
    )
    columns = _DEVICE_COLUMNS.split(", ")
    updates = ", ".join(f"{column} = excluded.{column}" for column in columns[1:])
    # an upsert, for INSERT OR REPLACE would delete the row and with it the posterior and the history
    db.execute(
        f"INSERT INTO devices ({_DEVICE_COLUMNS}) VALUES ({', '.join('?' * len(columns))}) "
        f"ON CONFLICT (mac) DO UPDATE SET {updates}",
        values,
    )
    said = (device.state, device.epoch, values[7], values[8], values[12])
    last = db.execute(
        "SELECT state, epoch, x_m, y_m, radius90_m FROM history WHERE mac = ? ORDER BY id DESC LIMIT 1",
        (device.mac,),
    ).fetchone()
    if said == last:
        return
    db.execute(
        "INSERT INTO history (mac, at, state, epoch, x_m, y_m, radius90_m) VALUES (?, ?, ?, ?, ?, ?, ?)",
        (device.mac, device.updated_at, *said),
    )
    db.execute(
        "DELETE FROM history WHERE mac = ? AND id <= "
        "(SELECT id FROM history WHERE mac = ? ORDER BY id DESC LIMIT 1 OFFSET ?)",
        (device.mac, device.mac, HISTORY_KEPT),
    )


def _write_posterior(db: sqlite3.Connection, posterior: PosteriorRecord) -> None:
    height, width = posterior.log_posterior.shape
    blob = zlib.compress(posterior.log_posterior.astype("<f4").tobytes())
    db.execute(
        "INSERT OR REPLACE INTO posteriors (mac, epoch, x0_m, y0_m, x1_m, y1_m, step_m, width, height, "
        "walks, log_posterior, updated_at) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
        (
            posterior.mac,
            posterior.epoch,
            *posterior.bounds_m,
            posterior.step_m,
            width,
            height,
            posterior.walks,
            blob,
            posterior.updated_at,
        ),
    )


def _device(row: tuple[Any, ...]) -> DeviceRecord:
    mac, name, state, reason, epoch, walks, evidence, x_m, y_m, xx, xy, yy, radius90_m = row[:13]
    region90, room, method, discovered_at, updated_at = row[13:]
    device = DeviceRecord(
        mac, state, discovered_at, updated_at, name, reason, epoch, walks, json.loads(evidence)
    )
    if x_m is None:
        return device
    region = tuple((float(x), float(y)) for x, y in json.loads(region90))
    estimate = Estimate(x_m, y_m, ((xx, xy), (xy, yy)), radius90_m, region, room, method)
    return replace(device, estimate=estimate)
