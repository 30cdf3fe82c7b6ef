"""The folder of sessions: what is in it, what goes first, what never goes."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_capture_session import DEVICE, OTHER, batches, header, log_bytes

from vad.camera.folder import Recording
from vad.capture import archive as a
from vad.capture.quota import enforce, to_remove
from vad.capture.session import SessionDevice, SessionHeader, load_session
from vad.capture.session_writer import SessionWriter

T0 = datetime(2026, 3, 1, 12, tzinfo=UTC)
WALK = np.arange(10, dtype=np.int64) * 10**8, np.zeros((10, 2)), np.full(10, 0.03), 1


def named(minute: int, mac: str = DEVICE) -> SessionHeader:
    name = a.session_id(T0 + timedelta(minutes=minute), mac)
    return msgspec.structs.replace(header(name), device=SessionDevice(mac, "lamp"))


def record(
    archive: Path, minute: int, *, count: int = 100, twins: tuple[str, ...] = (), end: str = "done"
) -> SessionWriter:
    """A session of that minute; others measured in the same walk beside it."""
    first = named(minute)
    writer = SessionWriter(archive / first.id, first, [named(minute, mac) for mac in twins])
    for batch in batches(log_bytes(count, [DEVICE, *twins]), 4):
        writer.append(batch)
    if end == "done":
        writer.close(*WALK)
    elif end == "aborted":
        writer.abort("the walker left")
    return writer


def test_names_sort_by_time_in_any_time_zone() -> None:
    east = timezone(timedelta(hours=2))
    assert a.session_id(T0.astimezone(east), DEVICE) == "20260301T120000.000-f4f5d8000001"
    assert a.begun_at("20260301T120000.000-f4f5d8000001") == T0
    assert a.begun_at("my recording") is None
    assert a.begun_at("20261301T120000.000-f4f5d8000001") is None


def test_what_is_in_it(tmp_path: Path) -> None:
    assert a.sessions_in(tmp_path / "none") == []
    record(tmp_path, 1)
    record(tmp_path, 0, end="aborted")
    (tmp_path / "decisions.jsonl").write_text("{}")
    (tmp_path / "a folder of somebody").mkdir()
    broken = tmp_path / a.session_id(T0 + timedelta(minutes=2), DEVICE)
    broken.mkdir()
    (broken / "session.json").write_text("{")
    aborted, done, unreadable = a.sessions_in(tmp_path)
    assert (aborted.state, aborted.reason, aborted.walk_s) == ("aborted", "the walker left", 0.0)
    assert (done.state, done.mac, done.name, done.packets) == ("done", DEVICE, "lamp", 100)
    assert done.begun == T0 + timedelta(minutes=1)
    assert done.bytes > 20_000
    assert unreadable.state == "unknown"
    assert "broken" in unreadable.reason
    a.note_result(done.folder, a.CaptureResult(1.0, 2.0, 0.5, "sharper"))
    result = a.sessions_in(tmp_path)[1].result
    assert result == a.CaptureResult(1.0, 2.0, 0.5, "sharper")
    assert len(load_session(done.folder).t_ns) == 100


def test_one_walk_for_several_devices_takes_the_disk_once(tmp_path: Path) -> None:
    writer = record(tmp_path, 0, count=900, twins=(OTHER,))
    assert [writer.packets_of(f) for f in writer.folders] == [450, 450]
    one, other = (load_session(folder) for folder in writer.folders)
    assert (one.header.device.mac, other.header.device.mac) == (DEVICE, OTHER)
    assert len(one.t_ns) == len(other.t_ns) == 450
    assert one.t_ns[0] != other.t_ns[0]
    np.testing.assert_array_equal(one.walk_t_ns, other.walk_t_ns)
    sessions = a.sessions_in(tmp_path)
    assert a.total_bytes(sessions) < 0.6 * sum(s.bytes for s in sessions)
    a.remove(sessions[0])
    assert len(load_session(writer.folders[1]).t_ns) == 450, "the other one keeps its bytes"


def test_where_there_are_no_hard_links_the_bytes_are_copied(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(os, "link", refuse)
    writer = record(tmp_path, 0, twins=(OTHER,))
    one, other = (load_session(folder) for folder in writer.folders)
    assert (one.header.device.mac, other.header.device.mac) == (DEVICE, OTHER)
    assert len(other.t_ns) == 50


def test_a_crash_leaves_a_folder_that_can_be_solved_up_to_there(tmp_path: Path) -> None:
    first = named(0)
    writer = SessionWriter(tmp_path / first.id, first)
    fed = batches(log_bytes(200, [DEVICE]), 4)
    for batch in fed[:3]:
        writer.append(batch)
    writer.walk(*WALK)
    with (writer.folder / "csi.dat").open("ab") as log:
        log.write(fed[3].raw[:-7])  # the times of these were never written, nor their last record's end
    session = load_session(writer.folder)
    assert len(session.t_ns) == 199
    assert len(session.walk_t_ns) == 10
    assert any("lacks 49 times" in note for note in session.notes)
    known = np.concatenate([batch.packets.arrival_ns for batch in fed[:3]])
    np.testing.assert_array_equal(session.t_ns[: len(known)], known)
    assert np.allclose(np.diff(session.t_ns[len(known) - 1 :]), 2.5e6), "the card's counter goes on"
    assert a.close_cut_off(tmp_path) == [writer.folder]
    (found,) = a.sessions_in(tmp_path)
    assert (found.state, found.reason) == ("aborted", a.CUT_OFF)
    assert a.close_cut_off(tmp_path) == []
    writer.abort("test over")


def test_frames_are_a_camera_recording(tmp_path: Path) -> None:
    picture = np.full((48, 64, 3), 90, np.uint8)
    jpeg = cv2.imencode(".jpg", picture)[1].tobytes()
    writer = record(tmp_path, 0, twins=(OTHER,), end="")
    for k in range(3):
        writer.frame(k * 100, jpeg)
    writer.close(*WALK)
    for folder in writer.folders:
        frames = list(Recording(folder / "frames").frames())
        assert [frame.t_ns for frame in frames] == [0, 100, 200]
        assert frames[0].image.shape == (48, 64, 3)
    assert len(load_session(writer.folder).t_ns) == 50


def test_the_oldest_go_first_and_only_as_many_as_needed(tmp_path: Path) -> None:
    for minute in range(5):
        record(tmp_path, minute)
    sessions = a.sessions_in(tmp_path)
    each = sessions[0].bytes
    assert enforce(tmp_path, quota_bytes=5 * each, keep_free_bytes=0) == []
    assert enforce(tmp_path, quota_bytes=3 * each, keep_free_bytes=0) == [s.id for s in sessions[:2]]
    assert [s.id for s in a.sessions_in(tmp_path)] == [s.id for s in sessions[2:]]
    spare = {sessions[2].id}
    assert enforce(tmp_path, quota_bytes=2 * each, keep_free_bytes=0, spare=spare) == [sessions[3].id]


def test_a_full_disk_takes_sessions_away_too(tmp_path: Path) -> None:
    for minute in range(3):
        record(tmp_path, minute)
    everything = 1 << 60
    assert len(enforce(tmp_path, quota_bytes=everything, keep_free_bytes=everything)) == 3


@pytest.mark.parametrize(
    "keep",
    [
        lambda folder: (folder / "session.json").write_text(
            json.dumps(
                {**json.loads((folder / "session.json").read_text()), "capture": {"state": "recording"}}
            )
        ),
        lambda folder: folder.rename(folder.with_name("grandma's walk")),
    ],
)
def test_what_is_recorded_now_or_was_put_there_by_people_never_goes(
    tmp_path: Path, keep: Callable[[Path], object]
) -> None:
    keep(record(tmp_path, 0).folder)
    record(tmp_path, 1)
    gone = enforce(tmp_path, quota_bytes=0, keep_free_bytes=0)
    assert gone == [a.session_id(T0 + timedelta(minutes=1), DEVICE)]
    assert len(a.sessions_in(tmp_path)) == 1


@given(
    st.lists(st.tuples(st.integers(0, 5), st.integers(1, 1000), st.booleans()), max_size=12),
    st.integers(0, 6000),
)
def test_what_stays_fits_or_cannot_go(made: list[tuple[int, int, bool]], allowed: int) -> None:
    """Any sizes, any sharing: bytes of one walk (the same inode) have one size."""
    size_of = {inode: size for inode, size, _ in made}
    sessions = [
        a.SessionEntry(
            Path(f"20260301T1200{k:02d}.000-f4f5d8000001"),
            T0,
            None,
            None,
            "",
            "recording" if recording else "done",
            "",
            None,
            None,
            None,
            {inode: size_of[inode], 100 + k: 10},
        )
        for k, (inode, _, recording) in enumerate(made)
    ]
    gone = to_remove(sessions, allowed)
    stays = [s for s in sessions if s not in gone]
    assert all(s.state != "recording" for s in gone)
    assert a.total_bytes(stays) <= allowed or all(s.state == "recording" for s in stays)
    if gone:
        assert a.total_bytes([*stays, gone[-1]]) > allowed, "one too many went"
        first_kept = min((s.id for s in stays if s.state != "recording"), default="~")
        assert all(s.id < first_kept for s in gone)
