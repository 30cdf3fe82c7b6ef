"""A walk's folders: devices of one card share a log, a remote card has its own, all end alike."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from vad.capture.session import SCHEMA, SessionAnchor, SessionDevice, SessionHeader, SessionRadio
from vad.capture.walk_writer import OWN_CARD, WalkWriter
from vad.csi.bfee import encode_bodies
from vad.csi.logfile import LogReader, record
from vad.csi.packets import CsiBatch

MACS = {"lamp": "aa:bb:cc:00:00:01", "tv": "aa:bb:cc:00:00:02", "node": "00:16:ea:00:00:01"}
CARDS = {"lamp": OWN_CARD, "node": "attic", "tv": OWN_CARD}


def header(name: str) -> SessionHeader:
    return SessionHeader(
        schema=SCHEMA,
        id=name,
        source="simulated",
        device=SessionDevice(MACS[name], name),
        anchor=SessionAnchor(0.0, 0.0),
        radio=SessionRadio(array_end="device" if CARDS[name] else "anchor"),
    )


def batch(n: int, first: int) -> CsiBatch:
    csi = np.ones((n, 30, 3, 1, 2), np.int8)
    bodies = encode_bodies(
        csi, nic_us=1000 * np.arange(n), bfee_count=first + np.arange(n), rssi=(30, 31, 32)
    )
    return LogReader().feed(b"".join(record(0xBB, body) for body in bodies))


def capture(folder: Path) -> dict[str, object]:
    told = json.loads((folder / "session.json").read_text())["capture"]
    assert isinstance(told, dict)
    return told


def test_each_card_has_its_log(tmp_path: Path) -> None:
    writer = WalkWriter(tmp_path, [(CARDS[name], header(name)) for name in CARDS])
    own, remote, nobodys = batch(5, 0), batch(7, 100), batch(3, 200)
    writer.append(own)
    writer.append(remote, "attic")
    writer.append(nobodys, "cellar")
    writer.lost(4, "attic")
    assert [folder.name for folder in writer.folders] == ["lamp", "node", "tv"]
    assert writer.packets == 12
    t_ns, xy_m = np.arange(3) * 10**9, np.zeros((3, 2))
    writer.close(t_ns, xy_m, np.ones(3), 1)
    for name, log in (("lamp", own.raw), ("tv", own.raw), ("node", remote.raw)):
        assert (tmp_path / name / "csi.dat").read_bytes() == log
        assert (tmp_path / name / "trajectory.csv").read_text().count("\n") == 4
        assert capture(tmp_path / name)["state"] == "done"
    assert capture(tmp_path / "node")["lost_packets"] == 4
    assert "lost_packets" not in capture(tmp_path / "lamp")
    assert json.loads((tmp_path / "node" / "session.json").read_text())["radio"]["array_end"] == "device"


def test_a_folder_that_cannot_be_made_leaves_none_half_recorded(tmp_path: Path) -> None:
    (tmp_path / "node").write_text("in the way")
    with pytest.raises(FileExistsError):
        WalkWriter(tmp_path, [(CARDS[name], header(name)) for name in ("lamp", "node")])
    told = capture(tmp_path / "lamp")
    assert told["state"] == "aborted"
    assert "another session folder of this walk" in str(told["reason"])
