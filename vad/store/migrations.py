"""How the database came to its present form; a step that was released is never changed, only followed."""

from __future__ import annotations

MIGRATIONS: tuple[str, ...] = (
    """
    CREATE TABLE devices (
        mac TEXT PRIMARY KEY,
        name TEXT,
        state TEXT NOT NULL,
        reason TEXT NOT NULL,
        epoch INTEGER NOT NULL,
        walks INTEGER NOT NULL,
        evidence TEXT NOT NULL,
        x_m REAL, y_m REAL,
        var_x_m2 REAL, cov_xy_m2 REAL, var_y_m2 REAL,
        radius90_m REAL,
        region90 TEXT,
        room TEXT,
        method TEXT,
        discovered_at TEXT NOT NULL,
        updated_at TEXT NOT NULL
    ) WITHOUT ROWID;
    CREATE TABLE posteriors (
        mac TEXT PRIMARY KEY REFERENCES devices(mac) ON DELETE CASCADE,
        epoch INTEGER NOT NULL,
        x0_m REAL NOT NULL, y0_m REAL NOT NULL, x1_m REAL NOT NULL, y1_m REAL NOT NULL,
        step_m REAL NOT NULL,
        width INTEGER NOT NULL, height INTEGER NOT NULL,
        walks INTEGER NOT NULL,
        log_posterior BLOB NOT NULL,
        updated_at TEXT NOT NULL
    );
    CREATE TABLE cameras (
        id TEXT NOT NULL,
        epoch INTEGER NOT NULL,
        calibration TEXT NOT NULL,
        updated_at TEXT NOT NULL,
        PRIMARY KEY (id, epoch)
    ) WITHOUT ROWID;
    CREATE TABLE epochs (
        epoch INTEGER PRIMARY KEY,
        fingerprint TEXT NOT NULL,
        since TEXT NOT NULL
    );
    CREATE TABLE history (
        id INTEGER PRIMARY KEY,
        mac TEXT NOT NULL REFERENCES devices(mac) ON DELETE CASCADE,
        at TEXT NOT NULL,
        state TEXT NOT NULL,
        epoch INTEGER NOT NULL,
        x_m REAL, y_m REAL, radius90_m REAL
    );
    CREATE INDEX history_by_device ON history (mac, at);
    """,
    """
    ALTER TABLE history ADD COLUMN name TEXT;
    ALTER TABLE history ADD COLUMN room TEXT;
    ALTER TABLE history ADD COLUMN walks INTEGER NOT NULL DEFAULT 0;
    ALTER TABLE history ADD COLUMN var_x_m2 REAL;
    ALTER TABLE history ADD COLUMN cov_xy_m2 REAL;
    ALTER TABLE history ADD COLUMN var_y_m2 REAL;
    CREATE TABLE agents (
        id TEXT PRIMARY KEY,
        info TEXT NOT NULL,
        first_seen TEXT NOT NULL,
        last_seen TEXT NOT NULL
    ) WITHOUT ROWID;
    """,
    """
    CREATE TABLE identities (
        mac TEXT PRIMARY KEY,
        macs TEXT NOT NULL,
        first_seen TEXT NOT NULL,
        last_seen TEXT NOT NULL,
        name TEXT, host_name TEXT, client_id TEXT, ip TEXT, vendor TEXT, agent TEXT,
        ignored INTEGER NOT NULL DEFAULT 0,
        moved INTEGER NOT NULL DEFAULT 0,
        shared INTEGER NOT NULL DEFAULT 0
    ) WITHOUT ROWID;
    """,
    """
    ALTER TABLE posteriors ADD COLUMN log_heard BLOB;
    ALTER TABLE posteriors ADD COLUMN heights TEXT;
    ALTER TABLE devices ADD COLUMN height_low_m REAL;
    ALTER TABLE devices ADD COLUMN height_high_m REAL;
    """,
)
"""Step i leads from version i to i + 1."""
