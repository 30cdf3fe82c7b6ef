"""Records to rows and back: the SQL of devices, posteriors and history. Inside somebody's transaction."""

from __future__ import annotations

import json
import sqlite3
import zlib
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vad.store.records import Covariance, DeviceRecord, Estimate, HistoryRecord, PosteriorRecord

HISTORY_KEPT = 1000
"""Rows of history a device keeps."""

DEVICE_COLUMNS = (
    "mac, name, state, reason, epoch, walks, evidence, x_m, y_m, var_x_m2, cov_xy_m2, var_y_m2, "
    "radius90_m, region90, room, method, discovered_at, updated_at, height_low_m, height_high_m"
)
HISTORY_COLUMNS = (
    "mac, at, state, epoch, x_m, y_m, radius90_m, name, room, walks, var_x_m2, cov_xy_m2, var_y_m2"
)
POSTERIOR_COLUMNS = (
    "mac, epoch, x0_m, y0_m, x1_m, y1_m, step_m, width, height, walks, log_posterior, updated_at, "
    "log_heard, heights"
)


def write_device(db: sqlite3.Connection, device: DeviceRecord, now: str) -> None:
    """Insert or update a device, and add to its history what is new. now: `vad.wall.now_rfc3339` form."""
    where = device.estimate
    xx, xy, yy = _three(where.covariance_m2 if where else None)
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
        *((where.height90_m if where else None) or (None, None)),
    )
    columns = DEVICE_COLUMNS.split(", ")
    updates = ", ".join(f"{column} = excluded.{column}" for column in columns[1:])
    # an upsert, for INSERT OR REPLACE would delete the row and with it the posterior and the history
    db.execute(
        f"INSERT INTO devices ({DEVICE_COLUMNS}) VALUES ({_marks(len(columns))}) "
        f"ON CONFLICT (mac) DO UPDATE SET {updates}",
        values,
    )
    _add_history(
        db,
        HistoryRecord(
            device.mac,
            now,
            device.state,
            device.epoch,
            where.x_m if where else None,
            where.y_m if where else None,
            where.radius90_m if where else None,
            device.name,
            where.room if where else None,
            device.walks,
            where.covariance_m2 if where else None,
        ),
    )


def _add_history(db: sqlite3.Connection, said: HistoryRecord) -> None:
    """Nothing where nothing changed but the name; what is above HISTORY_KEPT goes."""
    last = db.execute(
        f"SELECT {HISTORY_COLUMNS} FROM history WHERE mac = ? ORDER BY id DESC LIMIT 1", (said.mac,)
    ).fetchone()
    if last is not None and replace(read_history(last), at=said.at, name=said.name) == said:
        return
    values = (
        *(said.mac, said.at, said.state, said.epoch, said.x_m, said.y_m, said.radius90_m),
        *(said.name, said.room, said.walks, *_three(said.covariance_m2)),
    )
    db.execute(f"INSERT INTO history ({HISTORY_COLUMNS}) VALUES ({_marks(len(values))})", values)
    db.execute(
        "DELETE FROM history WHERE mac = ? AND id <= "
        "(SELECT id FROM history WHERE mac = ? ORDER BY id DESC LIMIT 1 OFFSET ?)",
        (said.mac, said.mac, HISTORY_KEPT),
    )


def write_posterior(db: sqlite3.Connection, posterior: PosteriorRecord) -> None:
    """Insert or replace a posterior; its grids are kept as zlib of little-endian float32, row by row."""
    rows, columns = posterior.log_posterior.shape
    values = (
        *(posterior.mac, posterior.epoch, *posterior.bounds_m, posterior.step_m, columns, rows),
        *(posterior.walks, _packed(posterior.log_posterior), posterior.updated_at),
        None if posterior.log_heard is None else _packed(posterior.log_heard),
        None if posterior.height is None else json.dumps(posterior.height),
    )
    db.execute(
        f"INSERT OR REPLACE INTO posteriors ({POSTERIOR_COLUMNS}) VALUES ({_marks(len(values))})", values
    )


def read_device(row: tuple[Any, ...]) -> DeviceRecord:
    """A row of DEVICE_COLUMNS; ValueError, KeyError or TypeError where it is damaged."""
    mac, name, state, reason, epoch, walks, evidence, x_m, y_m, xx, xy, yy, radius90_m = row[:13]
    region90, room, method, discovered_at, updated_at, low_m, high_m = row[13:]
    device = DeviceRecord(
        mac, state, discovered_at, updated_at, name, reason, epoch, walks, json.loads(evidence)
    )
    if x_m is None:
        return device
    region = tuple((float(x), float(y)) for x, y in json.loads(region90))
    height_m = None if low_m is None else (low_m, high_m)
    estimate = Estimate(x_m, y_m, ((xx, xy), (xy, yy)), radius90_m, region, room, method, height_m)
    return replace(device, estimate=estimate)


def read_history(row: tuple[Any, ...]) -> HistoryRecord:
    """A row of HISTORY_COLUMNS."""
    mac, at, state, epoch, x_m, y_m, radius90_m, name, room, walks, xx, xy, yy = row
    covariance: Covariance | None = None if xx is None else ((xx, xy), (xy, yy))
    return HistoryRecord(mac, at, state, epoch, x_m, y_m, radius90_m, name, room, walks, covariance)


def read_posterior(row: tuple[Any, ...]) -> PosteriorRecord:
    """A row of POSTERIOR_COLUMNS; ValueError or zlib.error where the grid is damaged."""
    mac, epoch, x0, y0, x1, y1, step_m, columns, rows, walks, blob, updated_at, heard_blob, height = row
    grid = _unpacked(blob, rows, columns)
    heard = None if heard_blob is None else _unpacked(heard_blob, rows, columns)
    heights = None if height is None else tuple(float(value) for value in json.loads(height))
    return PosteriorRecord(mac, epoch, (x0, y0, x1, y1), step_m, walks, grid, updated_at, heard, heights)


def _packed(grid: NDArray[np.float32]) -> bytes:
    return zlib.compress(grid.astype("<f4").tobytes())


def _unpacked(blob: bytes, rows: int, columns: int) -> NDArray[np.float32]:
    raw = zlib.decompressobj().decompress(blob, 4 * columns * rows + 1)  # never more than it states
    return np.frombuffer(raw, "<f4").astype(np.float32).reshape(rows, columns)


def _three(covariance: Covariance | None) -> tuple[float | None, float | None, float | None]:
    if covariance is None:
        return None, None, None
    (xx, xy), (_, yy) = covariance
    return xx, xy, yy


def _marks(count: int) -> str:
    return ", ".join("?" * count)
