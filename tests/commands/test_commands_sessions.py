"""`vad sessions` on real folders: what it lists, shows, packs, deletes, solves again, and tells."""

from __future__ import annotations

import json
import os
import shutil
import tarfile
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result
from walk_sessions import record_walk

from vad.capture.archive import CaptureResult, note_result, session_id, sessions_in
from vad.capture.session import load_session
from vad.commands.app import app
from vad.daemon.decisions import Decision, append
from vad.sim.scenario import make_home

HOME = make_home(1, walks=2)
TV = "f4:f5:d8:00:00:02"
BEGUN = datetime(2026, 3, 1, 12, tzinfo=UTC)
DONE, CUT, OTHER = (
    session_id(BEGUN + timedelta(minutes=k), mac)
    for k, mac in enumerate((HOME.device_mac, HOME.device_mac, TV))
)

Vad = Callable[..., Result]

SAFELY: dict[str, str] = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}
"""Debian 12's Python 3.11.2 knows no filters yet; a later one wants to be told."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A state folder with three sessions: a done one, one being recorded, one of another device."""
    state = tmp_path_factory.mktemp("state")
    archive = state / "sessions"
    record_walk(archive / DONE, HOME, packets_per_s=100.0)
    note_result(archive / DONE, CaptureResult(1.0, 2.0, 0.5, "lamp: mapped, Kitchen, ±0.5 m after 2 walks"))
    record_walk(archive / OTHER, replace(HOME, device_mac=TV), 1, packets_per_s=100.0)
    (archive / OTHER / "frames").mkdir()
    (archive / OTHER / "frames" / "000000.jpg").write_bytes(b"a person")
    shutil.copytree(archive / DONE, archive / CUT)
    plain = json.loads((archive / CUT / "session.json").read_text())
    plain["capture"] = {"state": "recording", "reason": ""}
    (archive / CUT / "session.json").write_text(json.dumps(plain))
    append(
        state,
        [
            Decision("2026-03-01T12:00:00.000Z", "somebody walks alone: measuring lamp (new)"),
            Decision("2026-03-01T12:00:20.000Z", "lamp: mapped, Kitchen", HOME.device_mac),
            Decision("2026-03-01T12:30:00.000Z", "tv waits: it is not heard at all", TV),
        ],
    )
    return state


@pytest.fixture
def state(recorded: Path, tmp_path: Path) -> Path:
    """A copy that a test may change."""
    return Path(shutil.copytree(recorded, tmp_path / "state"))


def vad(state: Path, *arguments: str, answer: str = "") -> Result:
    command, *rest = arguments
    return CliRunner().invoke(app, ["sessions", command, "--state-dir", str(state), *rest], input=answer)


def test_list_tells_what_was_recorded(recorded: Path) -> None:
    shown = vad(recorded, "list")
    assert shown.exit_code == 0
    assert DONE in shown.stdout
    assert "mapped, Kitchen" in shown.stdout
    assert "3 sessions," in shown.stdout
    found = json.loads(vad(recorded, "list", "--json").stdout)
    assert [s["state"] for s in found] == ["done", "recording", "done"]
    assert found[0]["result"]["radius90_m"] == 0.5
    assert [s["id"] for s in json.loads(vad(recorded, "list", "--json", "--device", TV).stdout)] == [OTHER]
    lamps = json.loads(vad(recorded, "list", "--json", "--device", "lamp", "--state", "done").stdout)
    assert [s["id"] for s in lamps] == [DONE, OTHER]


def test_nothing_there_is_exit_code_1_and_a_wrong_folder_2(tmp_path: Path, recorded: Path) -> None:
    nothing = vad(tmp_path, "list")
    assert (nothing.exit_code, "nothing has been recorded yet" in nothing.stderr) == (1, True)
    assert vad(recorded, "list", "--device", "aa:bb:cc:dd:ee:ff").exit_code == 1
    (tmp_path / "sessions").write_text("")
    assert vad(tmp_path, "list").exit_code == 2
    none = CliRunner().invoke(app, ["sessions", "list", "--config", str(tmp_path / "none.yaml")])
    assert (none.exit_code, "cannot be read" in none.stderr) == (2, True)


def test_show_tells_what_is_in_it(recorded: Path) -> None:
    shown = vad(recorded, "show", DONE)
    assert shown.exit_code == 0
    assert "lamp: mapped, Kitchen" in shown.stdout
    (told,) = json.loads(vad(recorded, "show", DONE, "--json").stdout)
    assert told["usable"]
    assert told["packets_of_device"] > 1000
    assert told["antennas"] == 3
    assert 8 < told["walked_m"] < 30
    assert vad(recorded, "show", CUT).exit_code == 1
    assert vad(recorded, "show", LAST := "last").exit_code == 0
    assert json.loads(vad(recorded, "show", LAST, "--json").stdout)[0]["id"] == OTHER


def test_a_name_that_fits_none_or_several_is_refused(recorded: Path) -> None:
    assert "no such session" in vad(recorded, "show", "nope").stderr
    several = vad(recorded, "show", "20260301")
    assert (several.exit_code, "several sessions" in several.stderr) == (2, True)


def test_export_packs_whole_sessions_without_people(recorded: Path, tmp_path: Path) -> None:
    target = tmp_path / "walks.tar.gz"
    packed = vad(recorded, "export", DONE, OTHER, "--to", str(target))
    assert packed.exit_code == 0, packed.stderr
    with tarfile.open(target) as archive:
        assert not any("frames" in name for name in archive.getnames())
        archive.extractall(tmp_path / "out", **SAFELY)
    assert len(load_session(tmp_path / "out" / DONE).t_ns) == len(
        load_session(recorded / "sessions" / DONE).t_ns
    )
    again = vad(recorded, "export", DONE, "--to", str(target))
    assert (again.exit_code, "is there already" in again.stderr) == (2, True)
    with_people = vad(recorded, "export", OTHER, "--frames", "--to", str(tmp_path / "people.tar.gz"))
    assert with_people.exit_code == 0
    with tarfile.open(tmp_path / "people.tar.gz") as archive:
        assert f"{OTHER}/frames/000000.jpg" in archive.getnames()


def test_sessions_of_one_walk_are_each_packed_whole(state: Path, tmp_path: Path) -> None:
    for name in ("csi.dat", "csi_arrival.npy"):
        (state / "sessions" / OTHER / name).unlink()
        os.link(state / "sessions" / DONE / name, state / "sessions" / OTHER / name)
    target = tmp_path / "walks.tar.gz"
    assert vad(state, "export", DONE, OTHER, "--to", str(target)).exit_code == 0
    with tarfile.open(target) as archive:
        assert all(member.isreg() for member in archive.getmembers())
        archive.extractall(tmp_path / "out", **SAFELY)
    expected = (state / "sessions" / DONE / "csi.dat").read_bytes()
    assert (tmp_path / "out" / OTHER / "csi.dat").read_bytes() == expected


def test_delete_asks_and_spares_what_is_being_recorded(state: Path) -> None:
    archive = state / "sessions"
    assert vad(state, "delete", OTHER, answer="n\n").exit_code == 1
    assert len(sessions_in(archive)) == 3
    assert vad(state, "delete", OTHER, answer="y\n").exit_code == 0
    assert [s.id for s in sessions_in(archive)] == [DONE, CUT]
    os.utime(archive / CUT / "csi.dat")
    busy = vad(state, "delete", CUT, "--yes")
    assert (busy.exit_code, "being recorded" in busy.stderr) == (2, True)
    long_ago = time.time() - 3600
    os.utime(archive / CUT / "csi.dat", (long_ago, long_ago))
    assert vad(state, "delete", CUT, "--yes").exit_code == 0
    assert vad(state, "delete").exit_code == 2
    assert vad(state, "delete", "--aborted", "--yes").exit_code == 1
    assert vad(state, "delete", "--device", "lamp", "--yes").exit_code == 0
    assert sessions_in(archive) == []


def test_replay_solves_it_again(recorded: Path) -> None:
    solved = vad(recorded, "replay", DONE, "--json")
    assert solved.exit_code == 0, solved.stderr
    (session,) = json.loads(solved.stdout)["sessions"]
    assert session["session"] == DONE
    assert session["radius90_m"] > 0


def test_log_reads_like_a_story(recorded: Path, tmp_path: Path) -> None:
    told = vad(recorded, "log")
    assert told.exit_code == 0
    lines = told.stdout.splitlines()
    assert [line.split("  ", 1)[1] for line in lines] == [
        "somebody walks alone: measuring lamp (new)",
        "lamp: mapped, Kitchen",
        "tv waits: it is not heard at all",
    ]
    assert len(vad(recorded, "log", "-n", "1").stdout.splitlines()) == 1
    (only,) = json.loads(vad(recorded, "log", "--device", TV, "--json").stdout)
    assert only["text"] == "tv waits: it is not heard at all"
    assert vad(tmp_path, "log").exit_code == 1
