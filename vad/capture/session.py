"""Session folders: one capture of one device, as files that other tools open too (formats.md 1)."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from vad.clock import unwrap_nic_us
from vad.csi.attribution import Attribution
from vad.csi.logfile import read_log
from vad.csi.packets import CsiPackets
from vad.errors import SessionError
from vad.mac import UNKNOWN_MAC, mac_from_text

SCHEMA = "vad.session/1"

MAX_SIDE_M = 300.0
"""No home is larger: wider bounds are a slip that would only fill the memory."""

FloatArray = NDArray[np.float64]
Bounds = tuple[float, float, float, float]
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
    """csi: the card; carrier and channel width; array_end: whose receive antennas the CSI's rows are, the
    unknown device's (the paper's layout, the anchor sends) or the anchor's (the hub hears the device)."""

    csi: str = "intel5300"
    carrier_hz: Annotated[float, Meta(gt=0)] = 5.24e9
    bandwidth_mhz: int = 20
    array_end: Literal["device", "anchor"] = "device"


class SessionMap(msgspec.Struct, frozen=True):
    """epoch of the map; bounds_m [x0, y0, x1, y1] where the device may be."""

    epoch: int = 1
    bounds_m: Bounds | None = None


class SessionClock(msgspec.Struct, frozen=True):
    """csi_first_packet_ns: the first 0xBB record on the session timeline, where arrivals are not recorded."""

    csi_first_packet_ns: int | None = None


class SessionHeader(msgspec.Struct, frozen=True, kw_only=True):
    """session.json. Fields that a newer version added are ignored. id names files of reports, too."""

    schema: str
    id: Annotated[str, Meta(pattern=r"^[^/\x00]{1,200}$")]
    source: Source
    device: SessionDevice
    anchor: SessionAnchor
    radio: SessionRadio = SessionRadio()
    map: SessionMap = SessionMap()
    clock: SessionClock = SessionClock()


class _TruePlace(msgspec.Struct, frozen=True):
    x_m: float
    y_m: float


class _Truth(msgspec.Struct, frozen=True):
    """truth.json; what else it holds is ignored."""

    device: _TruePlace


@dataclass(frozen=True, slots=True)
class Session:
    """A session folder in memory.

    t_ns int64 (N,) strictly increasing, session timeline; csi complex64 (N, 30, R, T): the device's packets
    of the most frequent antenna shape; walk_t_ns (M,), walk_xy_m (M, 2), walk_sigma_m (M,): the walker,
    map frame; truth_m (2,) in test data only; notes: what was left out and why, one sentence each;
    damage: those of them that tell of evidence which is lost.
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
    damage: list[str] = field(default_factory=list)


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
    if len(packets) == 0:
        raise SessionError("no CSI packet in the log", where=str(log_path))
    t_ns = _arrivals(folder, header, packets, notes)
    keep = _usable(packets, header, t_ns, notes)
    shape = np.array([packets.n_rx[keep], packets.n_tx[keep]]).max(axis=1)
    csi = packets.csi[keep][:, :, : shape[0], : shape[1]]
    walk_t_ns, walk_xy_m, walk_sigma_m = _load_trajectory(folder / "trajectory.csv")
    damage = []
    if stats.truncated_bytes:
        cut = f"csi.dat ends in the middle of a record: {stats.truncated_bytes} bytes left out"
        missing_s = (int(walk_t_ns[-1]) - int(t_ns[keep[-1]])) / 1e9
        if missing_s > 0:  # else only the tail, as when log_to_file was stopped
            cut = f"{cut}; the last {missing_s:.1f} s of the walk are missing"
            damage.append(cut)
        notes.insert(0, cut)
    return Session(
        header,
        folder,
        t_ns[keep],
        csi,
        walk_t_ns,
        walk_xy_m,
        walk_sigma_m,
        _load_truth(folder),
        notes,
        damage,
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
        header = msgspec.json.decode(raw, type=SessionHeader)
    except msgspec.MsgspecError as error:
        raise SessionError(str(error), where=str(path)) from error
    if header.map.bounds_m is not None and (wrong := wrong_bounds(header.map.bounds_m)):
        raise SessionError(f"map.bounds_m: {wrong}", where=str(path))
    return header


def wrong_bounds(bounds_m: Bounds) -> str:
    """What is wrong with [x0, y0, x1, y1] as a home's bounds; empty when nothing is."""
    x0, y0, x1, y1 = bounds_m
    if not (x0 < x1 and y0 < y1):
        return "x0 < x1 and y0 < y1 are needed"
    if x1 - x0 > MAX_SIDE_M or y1 - y0 > MAX_SIDE_M:
        return f"a side is longer than {MAX_SIDE_M:.0f} m"
    return ""


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
        if arrival.ndim == 1 and arrival.dtype == np.int64 and len(arrival) > 0:
            # A crash came between the log and its times: the card's counter tells the last ones.
            notes.append(f"csi_arrival.npy lacks {len(packets) - len(arrival)} times: they are the card's")
            rest_us = unwrap_nic_us(packets.nic_us[len(arrival) - 1 :])
            return np.concatenate([arrival, arrival[-1] + (rest_us[1:] - rest_us[0]) * 1000]).astype(np.int64)
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
            t = int(row["t_ns"])
            if not all(map(math.isfinite, point)) or not -(2**63) <= t < 2**63:
                raise ValueError("out of range")
            rows.setdefault(row.get("track") or "", {})[t] = point
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
        truth = msgspec.json.decode(_read(path), type=_Truth)
    except msgspec.MsgspecError as error:
        raise SessionError(f"no device place in it ({error})", where=str(path)) from error
    return np.array([truth.device.x_m, truth.device.y_m])
