"""Writes session folders while they are recorded, so that a crash leaves readable ones (formats.md 1).

All methods block for a moment (small writes): call them in a thread, one at a time.
"""

from __future__ import annotations

import csv
import errno
import io
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from vad.capture.session import SessionClock, SessionHeader
from vad.csi.packets import CsiBatch
from vad.mac import mac_from_text

FloatArray = NDArray[np.float64]

LOG, ARRIVALS, WALK, HEADER = "csi.dat", "csi_arrival.npy", "trajectory.csv", "session.json"
FRAMES, TIMES = "frames", "times.csv"

_NO_LINKS = (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EXDEV, errno.EMLINK)


class SessionWriter:
    """One walk being written; `close` or `abort` ends it.

    session.json says `capture.state` recording, done or aborted, so that a half-recorded session says so.

    Args:
        folder: of the session; made here.
        header: its session.json.
        twins: sessions of other devices measured in the same walk; their folders lie beside `folder`, named
            by their ids, and share the bytes of what is big (hard links; copies where there are none).
    """

    def __init__(self, folder: Path, header: SessionHeader, twins: Sequence[SessionHeader] = ()) -> None:
        folder.parent.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        self.packets = 0
        self._headers = {folder: header} | {folder.parent / twin.id: twin for twin in twins}
        self._heard = dict.fromkeys(self._headers, 0)
        self._walk_s = 0.0
        self._lost = 0
        self._frames = 0
        self._linked = True
        for made in self._headers:
            made.mkdir()
        self._log = (folder / LOG).open("wb")
        self._arrivals = (folder / ARRIVALS).open("wb")
        self._write_count()
        for twin in self._twins:
            self._link(folder / LOG, twin / LOG)
            self._link(folder / ARRIVALS, twin / ARRIVALS)
        self._write_headers("recording", "")

    @property
    def folders(self) -> tuple[Path, ...]:
        """All session folders of the walk, the first one first."""
        return tuple(self._headers)

    def packets_of(self, folder: Path) -> int:
        """The packets of that session's device so far."""
        return self._heard[folder]

    def append(self, batch: CsiBatch) -> None:
        """Add a batch's bytes to the log and its arrivals beside it."""
        self._log.write(batch.raw)
        self._log.flush()
        arrivals = batch.packets.arrival_ns
        if not len(arrivals):
            return
        self._arrivals.write(np.ascontiguousarray(arrivals, dtype="<i8").tobytes())
        if not self.packets:
            clock = SessionClock(csi_first_packet_ns=int(arrivals[0]))
            self._headers = {f: msgspec.structs.replace(h, clock=clock) for f, h in self._headers.items()}
            self._write_headers("recording", "")
        self.packets += len(arrivals)
        self._write_count()
        for folder, header in self._headers.items():
            mac = header.device.mac
            mine = len(arrivals) if mac is None else (batch.packets.mac == mac_from_text(mac)).sum()
            self._heard[folder] += int(mine)

    def lost(self, packets: int) -> None:
        """So many packets were given up on their way here: the folder says so."""
        self._lost += packets

    def walk(self, t_ns: NDArray[np.int64], xy_m: FloatArray, sigma_m: FloatArray, track: int) -> None:
        """Write the walker so far: (M,), (M, 2), (M,); the next call replaces it."""
        text = io.StringIO()
        rows = csv.writer(text, lineterminator="\n")
        rows.writerow(["t_ns", "x_m", "y_m", "sigma_m", "track"])
        for t, (x, y), sigma in zip(t_ns, xy_m, sigma_m, strict=True):
            rows.writerow([int(t), f"{x:.4f}", f"{y:.4f}", f"{sigma:.4f}", track])
        self._walk_s = float(t_ns[-1] - t_ns[0]) / 1e9 if len(t_ns) else 0.0
        for folder in self._headers:
            _replace(folder / WALK, text.getvalue().encode())

    def frame(self, t_ns: int, jpeg: bytes) -> None:
        """Keep a picture, in the form that a folder camera plays again."""
        name = f"{self._frames:06d}.jpg"
        for folder in self._headers:
            (folder / FRAMES).mkdir(exist_ok=True)
            with (folder / FRAMES / TIMES).open("a", newline="") as times:
                if not self._frames:
                    times.write("t_ns,file\n")
                times.write(f"{t_ns},{name}\n")
        first = self.folder / FRAMES / name
        first.write_bytes(jpeg)
        for twin in self._twins:
            self._link(first, twin / FRAMES / name)
        self._frames += 1

    def close(self, t_ns: NDArray[np.int64], xy_m: FloatArray, sigma_m: FloatArray, track: int) -> None:
        """Write the whole walk (M,), (M, 2), (M,): the session is complete."""
        self.walk(t_ns, xy_m, sigma_m, track)
        os.fsync(self._log.fileno())
        self._end("done", "")

    def abort(self, reason: str) -> None:
        """The session is void; what was recorded stays readable."""
        self._end("aborted", reason)

    @property
    def _twins(self) -> tuple[Path, ...]:
        return self.folders[1:]

    def _end(self, state: str, reason: str) -> None:
        self._log.close()
        self._arrivals.close()
        if not self._linked:
            for twin in self._twins:
                shutil.copytree(self.folder, twin, dirs_exist_ok=True, ignore=lambda *_: [HEADER])
        self._write_headers(state, reason)

    def _link(self, file: Path, twin: Path) -> None:
        """Give the bytes a second name; where the file system has none, they are copied at the end."""
        try:
            os.link(file, twin)
        except OSError as error:
            if error.errno not in _NO_LINKS:
                raise
            self._linked = False

    def _write_count(self) -> None:
        """NumPy's header for the arrivals so far: its length does not change as the count grows."""
        self._arrivals.seek(0)
        np.lib.format.write_array_header_1_0(
            self._arrivals, {"descr": "<i8", "fortran_order": False, "shape": (self.packets,)}
        )
        self._arrivals.seek(0, os.SEEK_END)
        self._arrivals.flush()

    def _write_headers(self, state: str, reason: str) -> None:
        for folder, header in self._headers.items():
            capture = {"packets": self._heard[folder], "walk_s": round(self._walk_s, 1)}
            if self._lost:
                capture["lost_packets"] = self._lost
            write_header(folder, msgspec.to_builtins(header), {"state": state, "reason": reason, **capture})


def write_header(folder: Path, header: dict[str, Any], capture: dict[str, Any]) -> None:
    """session.json from a header as plain values, with how the capture went."""
    plain = header | {"capture": capture}
    _replace(folder / HEADER, msgspec.json.format(msgspec.json.encode(plain), indent=1))


def _replace(path: Path, content: bytes) -> None:
    """The file is always whole: old or new."""
    draft = path.with_name(path.name + ".new")
    draft.write_bytes(content)
    os.replace(draft, path)  # noqa: PTH105 - the same words as the comment above
