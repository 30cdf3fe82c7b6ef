"""The daemon's memory: one SQLite file. Blocking; the event loop uses `vad.store.worker`."""

from __future__ import annotations

import json
import logging
import sqlite3
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Self

from vad.devices.device import Device
from vad.store import identities, rows
from vad.store.migrations import MIGRATIONS
from vad.store.opening import (
    StoreError,
    connect,
    explained,
    is_corruption,
    migrate,
    set_aside,
    version_of,
)
from vad.store.records import (
    AgentRecord,
    CameraRecord,
    DeviceRecord,
    EpochRecord,
    HistoryRecord,
    PastRecord,
    PosteriorRecord,
)
from vad.store.rows import DEVICE_COLUMNS, HISTORY_COLUMNS, HISTORY_KEPT, POSTERIOR_COLUMNS
from vad.store.salvage import salvage
from vad.wall import now_rfc3339

__all__ = ["HISTORY_KEPT", "Store", "StoreError"]

log = logging.getLogger(__name__)

_DAMAGED_ROW = (ValueError, KeyError, TypeError, zlib.error)


class Store:
    """What survives a restart: devices, posteriors, cameras, map epochs, agents, history.

    Opens (and where needed creates, checks, migrates behind a backup) the file at `path`. A file that is no
    sound database is renamed `<name>.corrupt-<time>` and a new one begun with what could be read of it;
    `set_aside`, `saved` and `backup` then tell. A file of a newer version is refused with StoreError and left
    alone; so is one that another process uses. Every write is durable, a power cut included, when its method
    returns. Not for two threads at once.

    now: wall time for history, `vad.wall.now_rfc3339` form.
    """

    def __init__(
        self,
        path: Path,
        *,
        migrations: Sequence[str] = MIGRATIONS,
        now: Callable[[], str] = now_rfc3339,
    ) -> None:
        self.path = path
        self.set_aside: Path | None = None
        self.saved: dict[str, int] = {}
        self.backup: Path | None = None
        self._now = now
        with explained(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                self._db = connect(path)
            except sqlite3.DatabaseError as error:
                if not is_corruption(error):
                    raise
                self.set_aside = set_aside(path)
                self._db = connect(path)
            try:
                self.backup = migrate(self._db, path, migrations)
                if self.set_aside is not None:
                    self._begin_anew(self.set_aside)
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
        return version_of(self._db)

    def devices(self) -> list[DeviceRecord]:
        """All devices, by MAC."""
        with explained(self.path):
            found = self._db.execute(f"SELECT {DEVICE_COLUMNS} FROM devices ORDER BY mac").fetchall()
        return [rows.read_device(row) for row in found]

    def device(self, mac: str) -> DeviceRecord | None:
        """One device."""
        with explained(self.path):
            row = self._db.execute(f"SELECT {DEVICE_COLUMNS} FROM devices WHERE mac = ?", (mac,)).fetchone()
        return None if row is None else rows.read_device(row)

    def save_device(self, device: DeviceRecord, posterior: PosteriorRecord | None = None) -> None:
        """Write a device, its posterior where given, and history where it has news: all or nothing."""
        if posterior is not None and posterior.mac != device.mac:
            raise ValueError(f"the posterior of {posterior.mac} cannot be kept with {device.mac}")
        with self._transaction() as db:
            rows.write_device(db, device, self._now())
            if posterior is not None:
                rows.write_posterior(db, posterior)

    def save_devices(self, devices: Iterable[DeviceRecord]) -> None:
        """Write several devices in one go, all or nothing: one wait for the disk."""
        with self._transaction() as db:
            for device in devices:
                rows.write_device(db, device, self._now())

    def forget_device(self, mac: str) -> bool:
        """Delete a device with its posterior and history; False where it was not known."""
        with self._transaction() as db:
            return db.execute("DELETE FROM devices WHERE mac = ?", (mac,)).rowcount > 0

    def posterior(self, mac: str) -> PosteriorRecord | None:
        """A device's posterior; StoreError where the stored grid is damaged."""
        with explained(self.path):
            row = self._db.execute(
                f"SELECT {POSTERIOR_COLUMNS} FROM posteriors WHERE mac = ?", (mac,)
            ).fetchone()
        try:
            return None if row is None else rows.read_posterior(row)
        except _DAMAGED_ROW as error:
            raise StoreError(f"the posterior of {mac} is damaged: {error}", where=str(self.path)) from error

    def history(
        self, mac: str, limit: int = HISTORY_KEPT, *, since: str | None = None, until: str | None = None
    ) -> list[HistoryRecord]:
        """What was said of a device after `since` and up to `until`, the newest first."""
        with explained(self.path):
            found = self._db.execute(
                f"SELECT {HISTORY_COLUMNS} FROM history WHERE mac = ? AND at > ? AND at <= ? "
                "ORDER BY id DESC LIMIT ?",
                (mac, since or "", until or "~", limit),
            ).fetchall()
        return [rows.read_history(row) for row in found]

    def past(self, at: str, mac: str | None = None) -> list[PastRecord]:
        """What was known at `at` (`now_rfc3339` form) of the devices discovered by then: one, or all."""
        which, known = ("", (at,)) if mac is None else ("AND mac = ?", (at, mac))
        with explained(self.path):
            macs = self._db.execute(
                f"SELECT mac FROM devices WHERE discovered_at <= ? {which} ORDER BY mac", known
            ).fetchall()
            return [self._past_of(one, at) for (one,) in macs]

    def _past_of(self, mac: str, at: str) -> PastRecord:
        row = self._db.execute(
            f"SELECT {HISTORY_COLUMNS} FROM history WHERE mac = ? AND at <= ? "
            "ORDER BY at DESC, id DESC LIMIT 1",
            (mac, at),
        ).fetchone()
        (oldest,) = self._db.execute("SELECT min(at) FROM history WHERE mac = ?", (mac,)).fetchone()
        return PastRecord(mac, None if row is None else rows.read_history(row), oldest)

    def save_camera(self, camera: CameraRecord) -> None:
        """Write a camera's calibration for its epoch."""
        with self._transaction() as db:
            db.execute(
                "INSERT OR REPLACE INTO cameras (id, epoch, calibration, updated_at) VALUES (?, ?, ?, ?)",
                (camera.id, camera.epoch, json.dumps(camera.calibration), camera.updated_at),
            )

    def cameras(self, epoch: int) -> list[CameraRecord]:
        """The calibrations that hold in `epoch`, by id."""
        with explained(self.path):
            found = self._db.execute(
                "SELECT id, epoch, calibration, updated_at FROM cameras WHERE epoch = ? ORDER BY id", (epoch,)
            ).fetchall()
        return [CameraRecord(id_, at, json.loads(text), updated) for id_, at, text, updated in found]

    def save_epoch(self, epoch: EpochRecord) -> None:
        """Write a map epoch; nothing is written where it is known with this fingerprint: `since` stays."""
        with explained(self.path):
            known = self._db.execute(
                "SELECT fingerprint FROM epochs WHERE epoch = ?", (epoch.epoch,)
            ).fetchone()
        if known == (epoch.fingerprint,):
            return
        with self._transaction() as db:
            db.execute(
                "INSERT OR REPLACE INTO epochs (epoch, fingerprint, since) VALUES (?, ?, ?)",
                (epoch.epoch, epoch.fingerprint, epoch.since),
            )

    def last_epoch(self) -> EpochRecord | None:
        """The map epoch with the highest number."""
        with explained(self.path):
            row = self._db.execute(
                "SELECT epoch, fingerprint, since FROM epochs ORDER BY epoch DESC LIMIT 1"
            ).fetchone()
        return None if row is None else EpochRecord(*row)

    def save_agent(self, agent: AgentRecord) -> None:
        """Write what is known of an agent; when it was first seen stays as it was."""
        with self._transaction() as db:
            db.execute(
                "INSERT INTO agents (id, info, first_seen, last_seen) VALUES (?, ?, ?, ?) "
                "ON CONFLICT (id) DO UPDATE SET info = excluded.info, last_seen = excluded.last_seen",
                (agent.id, json.dumps(agent.info), agent.first_seen, agent.last_seen),
            )

    def agents(self) -> list[AgentRecord]:
        """All agents that were ever met, by id."""
        with explained(self.path):
            found = self._db.execute(
                "SELECT id, info, first_seen, last_seen FROM agents ORDER BY id"
            ).fetchall()
        return [AgentRecord(id_, json.loads(info), first, last) for id_, info, first, last in found]

    def save_identities(self, kept: Iterable[Device], gone: Iterable[str] = ()) -> None:
        """Write who devices are, and forget those in `gone` (MACs) with all their walks: all or nothing."""
        with self._transaction() as db:
            identities.write_identities(db, kept, gone)

    def identities(self) -> list[Device]:
        """Who the devices are, in order of discovery; a damaged row is left out."""
        with explained(self.path):
            found = self._db.execute(
                f"SELECT {identities.COLUMNS} FROM identities ORDER BY first_seen, mac"
            ).fetchall()
        known = []
        for row in found:
            try:
                known.append(identities.read_identity(row))
            except _DAMAGED_ROW as error:
                log.warning("%s: %s", self.path, error)
        return known

    def _begin_anew(self, damaged: Path) -> None:
        """Take over what can be read of the damaged file; say what became of it."""
        with self._transaction() as db:
            self.saved = salvage(db, damaged)
            for row in db.execute(f"SELECT {DEVICE_COLUMNS} FROM devices").fetchall():
                try:
                    rows.read_device(row)
                except _DAMAGED_ROW:
                    db.execute("DELETE FROM devices WHERE mac = ?", (row[0],))
                    self.saved["devices"] -= 1
        log.warning("%s", damage_report(damaged, self.saved))

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with explained(self.path):
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield self._db
            except BaseException:
                if self._db.in_transaction:  # a full disk has rolled it back already
                    self._db.execute("ROLLBACK")
                raise
            try:
                self._db.execute("COMMIT")
            except sqlite3.Error:
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
                raise


def damage_report(damaged: Path, saved: dict[str, int]) -> str:
    """One sentence on a database that was set aside."""
    devices = saved.get("devices", 0)
    took = (
        f"{devices} of its devices could be read and were taken over"
        if devices
        else "nothing could be read of it"
    )
    return f"the database was damaged: it was set aside as {damaged}, {took}"
