"""Session folders: what is written is read back; what is broken says so in one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import pytest

from vad.capture.session import (
    SCHEMA,
    SessionAnchor,
    SessionClock,
    SessionDevice,
    SessionHeader,
    SessionMap,
    load_session,
)
from vad.capture.session_writer import SessionWriter
from vad.csi.attribution import Attribution
from vad.csi.bfee import encode_bodies
from vad.csi.dot11 import data_frame
from vad.csi.logfile import LogReader, record
from vad.csi.packets import CsiBatch
from vad.csi.stamping import Stamper
from vad.errors import SessionError
from vad.mac import mac_from_text

DEVICE = "f4:f5:d8:00:00:01"
OTHER = "f4:f5:d8:00:00:02"
HUB = "00:16:ea:00:00:01"


def log_bytes(count: int, senders: list[str], *, seed: int = 0) -> bytes:
    """A log of `count` packets whose frames name the senders in turn."""
    rng = np.random.default_rng(seed)
    csi = rng.integers(-40, 40, (count, 30, 3, 1, 2), dtype=np.int8)
    bodies = encode_bodies(
        csi,
        nic_us=np.arange(count, dtype=np.uint32) * 2500,
        bfee_count=np.arange(count, dtype=np.uint16),
        rssi=np.full((count, 3), 40, np.uint8),
    )
    hub = mac_from_text(HUB)
    out = b""
    for k, body in enumerate(bodies):
        sender = mac_from_text(senders[k % len(senders)])
        out += record(0xC1, data_frame(sender, hub, hub, k % 4096)) + record(0xBB, body)
    return out


def batches(raw: bytes, pieces: int) -> list[CsiBatch]:
    """The log as a live source would hand it over."""
    reader, stamper = LogReader(Attribution()), Stamper()
    cut = np.linspace(0, len(raw), pieces + 1).astype(int)
    fed = [reader.feed(raw[a:b]) for a, b in pairwise(cut)]
    return [stamper.stamp(batch, 10**9 * (k + 1)) for k, batch in enumerate(fed)]


def header(name: str = "s1") -> SessionHeader:
    return SessionHeader(
        schema=SCHEMA,
        id=name,
        source="simulated",
        device=SessionDevice(DEVICE, "lamp"),
        anchor=SessionAnchor(0.5, 0.25, 2.0),
        map=SessionMap(3, (-1.0, -1.0, 4.0, 5.0)),
    )


def written(folder: Path, *, count: int = 300, senders: list[str] | None = None) -> Path:
    writer = SessionWriter(folder, header(folder.name))
    for batch in batches(log_bytes(count, senders or [DEVICE]), 4):
        writer.append(batch)
    t_ns = np.arange(10, dtype=np.int64) * 10**8
    writer.close(t_ns, np.stack([t_ns / 1e9, t_ns / 2e9], axis=1), np.full(10, 0.03), 1)
    return folder


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    session = load_session(written(tmp_path / "s1"))
    first_ns = session.header.clock.csi_first_packet_ns
    assert first_ns is not None
    assert msgspec.structs.replace(session.header, clock=SessionClock()) == header()
    assert session.t_ns[0] == first_ns
    assert len(session.t_ns) == 300
    assert session.csi.shape == (300, 30, 3, 1)
    assert np.all(np.diff(session.t_ns) > 0)
    assert session.walk_xy_m[-1] == pytest.approx([0.9, 0.45])
    assert session.truth_m is None
    assert json.loads((tmp_path / "s1" / "session.json").read_text())["capture"] == {
        "state": "done",
        "reason": "",
        "packets": 300,
        "walk_s": 0.9,
    }


def test_packets_of_other_stations_are_left_out_and_counted(tmp_path: Path) -> None:
    session = load_session(written(tmp_path / "s1", senders=[DEVICE, DEVICE, OTHER]))
    assert len(session.t_ns) == 200
    assert any("100 packets of other" in note for note in session.notes)


def test_a_session_cut_off_by_a_crash_keeps_its_packets(tmp_path: Path) -> None:
    writer = SessionWriter(tmp_path / "s1", header())
    for batch in batches(log_bytes(100, [DEVICE]), 2):
        writer.append(batch)
    # No close: the process died here.
    state = json.loads((tmp_path / "s1" / "session.json").read_text())
    assert state["capture"]["state"] == "recording"
    assert state["clock"]["csi_first_packet_ns"] is not None
    (tmp_path / "s1" / "trajectory.csv").write_text("t_ns,x_m,y_m,sigma_m,track\n0,0,0,0.1,1\n")
    assert len(load_session(tmp_path / "s1").t_ns) == 100
    writer.abort("test over")
    assert json.loads((tmp_path / "s1" / "session.json").read_text())["capture"]["reason"] == "test over"


def test_a_truncated_log_is_read_up_to_there(tmp_path: Path) -> None:
    folder = written(tmp_path / "s1")
    raw = (folder / "csi.dat").read_bytes()
    (folder / "csi.dat").write_bytes(raw[:-50])
    session = load_session(folder)
    assert len(session.t_ns) == 299
    assert "middle of a record" in session.notes[0]


def broken_json(folder: Path) -> None:
    (folder / "session.json").write_text("{")


def other_schema(folder: Path) -> None:
    plain = json.loads((folder / "session.json").read_text())
    (folder / "session.json").write_text(json.dumps(plain | {"schema": "vad.session/9"}))


def without_anchor(folder: Path) -> None:
    plain = json.loads((folder / "session.json").read_text())
    del plain["anchor"]
    (folder / "session.json").write_text(json.dumps(plain))


def without_clock(folder: Path) -> None:
    plain = json.loads((folder / "session.json").read_text())
    del plain["clock"]
    (folder / "session.json").write_text(json.dumps(plain))
    (folder / "csi_arrival.npy").unlink()


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda f: (f / "csi.dat").unlink(), "csi.dat: the file is missing"),
        (lambda f: (f / "csi.dat").write_bytes(b""), "csi.dat: the CSI log is empty"),
        (lambda f: (f / "csi.dat").write_bytes(b"\x00\x05\xbb"), "csi.dat: no CSI packet in the log"),
        (lambda f: (f / "trajectory.csv").unlink(), "trajectory.csv: the file is missing"),
        (lambda f: (f / "trajectory.csv").write_text("t_ns,x_m\n1,2\n"), "line 2 is not t_ns,x_m"),
        (lambda f: (f / "trajectory.csv").write_text("t_ns,x_m,y_m\n"), "the trajectory is empty"),
        (broken_json, "session.json: not a JSON object"),
        (other_schema, "unknown schema 'vad.session/9'"),
        (without_anchor, "missing required field `anchor`"),
        (without_clock, "neither csi_arrival.npy nor"),
        (lambda f: (f / "truth.json").write_text("[]"), "truth.json: no device place"),
    ],
)
def test_a_broken_folder_says_what_is_broken(
    tmp_path: Path, damage: Callable[[Path], object], said: str
) -> None:
    folder = written(tmp_path / "s1")
    damage(folder)
    with pytest.raises(SessionError, match=said.replace("[", r"\[")) as caught:
        load_session(folder)
    assert "\n" not in str(caught.value)


def test_no_folder_at_all_is_an_error_with_its_name(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="no such session folder"):
        load_session(tmp_path / "none")
