"""Writes a session folder while it is recorded, so that a crash leaves a readable one (formats.md 1).

All methods block for a moment (small writes): call them in a thread.
"""

from __future__ import annotations

import csv
import os
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from vad.capture.session import SessionClock, SessionHeader
from vad.csi.packets import CsiBatch

FloatArray = NDArray[np.float64]


class SessionWriter:
    """One session folder being written; `close` or `abort` ends it.

    session.json says `capture.state` recording, done or aborted, so that a half-recorded session says so.
    """

    def __init__(self, folder: Path, header: SessionHeader) -> None:
        folder.mkdir(parents=True)
        self.folder = folder
        self.packets = 0
        self._header = header
        self._arrivals: list[NDArray[np.int64]] = []
        self._log = (folder / "csi.dat").open("wb")
        self._write_header("recording", "")

    def append(self, batch: CsiBatch) -> None:
        """Add a batch's bytes to the log; its arrivals are kept for `close`."""
        self._log.write(batch.raw)
        self._log.flush()
        if len(batch.packets) and self._header.clock.csi_first_packet_ns is None:
            clock = SessionClock(csi_first_packet_ns=int(batch.packets.arrival_ns[0]))
            self._header = msgspec.structs.replace(self._header, clock=clock)
            self._write_header("recording", "")
        self._arrivals.append(batch.packets.arrival_ns)
        self.packets += len(batch.packets)

    def close(self, t_ns: NDArray[np.int64], xy_m: FloatArray, sigma_m: FloatArray, track: int) -> None:
        """Write the walker (M,), (M, 2), (M,) and the arrivals: the session is complete."""
        with (self.folder / "trajectory.csv").open("w", newline="") as file:
            rows = csv.writer(file, lineterminator="\n")
            rows.writerow(["t_ns", "x_m", "y_m", "sigma_m", "track"])
            for t, (x, y), sigma in zip(t_ns, xy_m, sigma_m, strict=True):
                rows.writerow([int(t), f"{x:.4f}", f"{y:.4f}", f"{sigma:.4f}", track])
        self._end("done", "")

    def abort(self, reason: str) -> None:
        """The session is void; what was recorded stays readable."""
        self._end("aborted", reason)

    def _end(self, state: str, reason: str) -> None:
        self._log.close()
        arrivals = np.concatenate([np.empty(0, np.int64), *self._arrivals])
        np.save(self.folder / "csi_arrival.npy", arrivals)
        self._write_header(state, reason)

    def _write_header(self, state: str, reason: str) -> None:
        plain = msgspec.to_builtins(self._header) | {"capture": {"state": state, "reason": reason}}
        path = self.folder / "session.json"
        draft = path.with_suffix(".json.new")
        draft.write_bytes(msgspec.json.format(msgspec.json.encode(plain), indent=1))
        os.replace(draft, path)  # noqa: PTH105 - the header is always whole: old or new
