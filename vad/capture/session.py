"""Session folders: one capture of one device, as files that other tools open too (formats.md 1)."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from vad.clock import unwrap_nic_us
from vad.csi.attribution import Attribution
from vad.csi.logfile import read_log
from vad.csi.packets import CsiPackets
from vad.errors import SessionError
from vad.mac import UNKNOWN_MAC, mac_from_text

SCHEMA = "vad.session/1"

FloatArray = NDArray[np.float64]
Source = Literal["live", "recorded", "simulated"]


class SessionDevice(msgspec.Struct, frozen=True):
    """mac: lower-case text or null; name: what people call it."""

    mac: str | None = None
    name: str | None = None


class SessionAnchor(msgspec.Struct, frozen=True):
    """The known end of the link, map frame."""

    x_m: float
    y_m: float
    z_m: float | None = None


class SessionRadio(msgspec.Struct, frozen=True):
    """csi: the card; carrier and channel width."""

    csi: str = "intel5300"
    carrier_hz: float = 5.24e9
    bandwidth_mhz: int = 20


class SessionMap(msgspec.Struct, frozen=True):
    """epoch of the map; bounds_m [x0, y0, x1, y1] where the device may be."""

    epoch: int = 1
    bounds_m: tuple[float, float, float, float] | None = None


class SessionClock(msgspec.Struct, frozen=True):
    """csi_first_packet_ns: the first 0xBB record on the session timeline, where arrivals are not recorded."""

    csi_first_packet_ns: int | None = None


class SessionHeader(msgspec.Struct, frozen=True, kw_only=True):
    """session.json. Fields that a newer version added are ignored."""

    schema: str
    id: str
    source: Source
    device: SessionDevice
    anchor: SessionAnchor
    radio: SessionRadio = SessionRadio()
    map: SessionMap = SessionMap()
    clock: SessionClock = SessionClock()


@dataclass(frozen=True, slots=True)
class Session:
    """A session folder in memory.

    t_ns int64 (N,) strictly increasing, session timeline; csi complex64 (N, 30, R, T): the device's packets
    of the most frequent antenna shape; walk_t_ns (M,), walk_xy_m (M, 2), walk_sigma_m (M,): the walker,
    map frame; truth_m (2,) in test data only; notes: what was left out and why, one sentence each.
    """

    header: SessionHeader
    folder: Path
    t_ns: NDArray[np.int64]
    csi: NDArray[np.complex64]
    walk_t_ns: NDArray[np.int64]
    walk_xy_m: FloatArray
    walk_sigma_m: FloatArray
    truth_m: FloatArray | None
    notes: list[str] = field(default_factory=list)


def load_session(folder: Path) -> Session:
    """Read a session folder; SessionError names the file that is missing or broken and why."""
    header = load_header(folder)
    notes: list[str] = []
    log_path = folder / "csi.dat"
    raw = _read(log_path)
    if not raw:
        raise SessionError("the CSI log is empty", where=str(log_path))
    attribution = Attribution() if header.device.mac else None
    packets, stats = read_log(raw, attribution)
    if stats.truncated_bytes:
        notes.append(f"csi.dat ends in the middle of a record: {stats.truncated_bytes} bytes left out")
    if len(packets) == 0:
        raise SessionError("no CSI packet in the log", where=str(log_path))
    t_ns = _arrivals(folder, header, packets, notes)
    keep = _usable(packets, header, t_ns, notes)
    shape = np.array([packets.n_rx[keep], packets.n_tx[keep]]).max(axis=1)
    csi = packets.csi[keep][:, :, : shape[0], : shape[1]]
    walk_t_ns, walk_xy_m, walk_sigma_m = _load_trajectory(folder / "trajectory.csv")
    return Session(
        header, folder, t_ns[keep], csi, walk_t_ns, walk_xy_m, walk_sigma_m, _load_truth(folder), notes
    )


def load_header(folder: Path) -> SessionHeader:
    """Read and check session.json alone."""
    if not folder.is_dir():
        raise SessionError("no such session folder", where=str(folder))
    path = folder / "session.json"
    raw = _read(path)
    try:
        named = msgspec.json.decode(raw, type=dict[str, object]).get("schema")
    except msgspec.MsgspecError as error:
        raise SessionError(f"not a JSON object ({error})", where=str(path)) from error
    if named != SCHEMA:
        raise SessionError(
            f"unknown schema {named!r}", where=str(path), remedy=f"This version reads {SCHEMA!r}"
        )
    try:
        return msgspec.json.decode(raw, type=SessionHeader)
    except msgspec.MsgspecError as error:
        raise SessionError(str(error), where=str(path)) from error


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise SessionError("the file is missing", where=str(path)) from error
    except OSError as error:
        raise SessionError(f"cannot be read ({error.strerror})", where=str(path)) from error


def _arrivals(
    folder: Path, header: SessionHeader, packets: CsiPackets, notes: list[str]
) -> NDArray[np.int64]:
    """Packet times on the session timeline: recorded arrivals, else the NIC's counter from the first one."""
    path = folder / "csi_arrival.npy"
    if path.exists():
        try:
            arrival = np.load(path, allow_pickle=False)
        except (OSError, ValueError) as error:
            raise SessionError(f"not a NumPy array ({error})", where=str(path)) from error
        if arrival.ndim == 1 and arrival.dtype == np.int64 and len(arrival) >= len(packets):
            return np.asarray(arrival[: len(packets)], dtype=np.int64)
        if arrival.ndim == 1 and len(arrival) > 0:
            notes.append(f"csi_arrival.npy has {len(arrival)} times for {len(packets)} packets: not used")
    first_ns = header.clock.csi_first_packet_ns
    if first_ns is None:
        raise SessionError("neither csi_arrival.npy nor clock.csi_first_packet_ns", where=str(folder))
    counter_us = unwrap_nic_us(packets.nic_us)
    return np.asarray(first_ns + (counter_us - counter_us[0]) * 1000, dtype=np.int64)


def _usable(
    packets: CsiPackets, header: SessionHeader, t_ns: NDArray[np.int64], notes: list[str]
) -> NDArray[np.int64]:
    """Indices of the device's packets of one antenna shape, in strictly increasing time."""
    keep = np.ones(len(packets), dtype=np.bool_)
    if header.device.mac and (packets.mac != UNKNOWN_MAC).any():
        keep &= packets.mac == mac_from_text(header.device.mac)
        if not keep.any():
            raise SessionError(f"no packet of {header.device.mac} in the log", where=header.id)
        if (~keep).any():
            notes.append(f"{(~keep).sum()} packets of other or unknown stations left out")
    shapes = packets.n_rx.astype(np.int64) * 8 + packets.n_tx
    values, counts = np.unique(shapes[keep], return_counts=True)
    odd = keep & (shapes != values[np.argmax(counts)])
    if odd.any():
        notes.append(f"{odd.sum()} packets of another antenna shape left out")
        keep &= ~odd
    highest = np.maximum.accumulate(np.where(keep, t_ns, np.iinfo(np.int64).min))
    before = np.concatenate([[np.iinfo(np.int64).min], highest[:-1]])
    late = keep & (t_ns <= before)
    if late.any():
        notes.append(f"{late.sum()} packets without an increasing time left out")
        keep &= ~late
    return np.flatnonzero(keep)


def _load_trajectory(path: Path) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:
    """trajectory.csv of the track with the most points."""
    text = _read(path).decode("utf-8", errors="replace")
    rows: dict[str, dict[int, tuple[float, float, float]]] = {}
    for number, row in enumerate(csv.DictReader(io.StringIO(text)), start=2):
        try:
            point = (float(row["x_m"]), float(row["y_m"]), float(row.get("sigma_m") or 0.1))
            rows.setdefault(row.get("track") or "", {})[int(row["t_ns"])] = point
        except (KeyError, TypeError, ValueError) as error:
            raise SessionError(f"line {number} is not t_ns,x_m,y_m,sigma_m,track", where=str(path)) from error
    if not rows:
        raise SessionError("the trajectory is empty", where=str(path))
    track = max(rows.values(), key=len)
    t_ns = np.array(sorted(track), dtype=np.int64)
    values = np.array([track[int(t)] for t in t_ns])
    return t_ns, values[:, :2], values[:, 2]


def _load_truth(folder: Path) -> FloatArray | None:
    path = folder / "truth.json"
    if not path.exists():
        return None
    try:
        place = msgspec.json.decode(_read(path), type=dict[str, dict[str, float]])["device"]
        return np.array([place["x_m"], place["y_m"]])
    except (msgspec.MsgspecError, KeyError) as error:
        raise SessionError(f"no device place in it ({error})", where=str(path)) from error
