"""`vad replay`: recordings in, places beside the paper's out; what cannot be read is one line each."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result
from walk_sessions import record_walk

from vad.commands.app import app
from vad.sim.scenario import make_home

pytestmark = pytest.mark.timeout(600)
"""Much work for the processor: a busy machine takes many times as long as an idle one."""

ROOT = Path(__file__).parents[2]
HOME = make_home(3)
NEAR_M = 0.8
NEAR = "--bounds=" + ",".join(
    f"{at + by:.2f}" for by in (-NEAR_M, NEAR_M) for at in (HOME.device_m[0], HOME.device_m[1])
)
"""Where the place itself is not the point, a small map saves time."""
ISSUE_MEDIAN_M = 1.2
A_FEW = ("circle_ccw_t1_rx1", "circle_ccw_t2_rx3", "diamond_ccw_t1_rx2", "diamond_ccw_corridor_t2_rx1")


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two walks of one simulated home; not to be changed."""
    folder = tmp_path_factory.mktemp("walks")
    return [record_walk(folder / f"walk-{k}", HOME, k) for k in (0, 1)]


@pytest.fixture
def walk(walks: list[Path], tmp_path: Path) -> Path:
    """A walk of one's own, to be damaged."""
    return Path(shutil.copytree(walks[0], tmp_path / "damaged"))


def replay(*arguments: str | Path, code: int = 0) -> Result:
    result = CliRunner().invoke(app, ["replay", *map(str, arguments)])
    assert result.exit_code == code, (result.output, result.exception)
    return result


def replay_json(*arguments: str | Path, code: int = 0) -> dict[str, Any]:
    return dict(json.loads(replay(*arguments, "--json", code=code).stdout))


def lines(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.strip()]


def check_fields(one: dict[str, Any]) -> None:
    """What the JSON promises of a session that was placed."""
    assert one["method"] == "spectrogram-likelihood"
    assert one["status"] in ("located", "uncertain")
    assert (one["reason"] == "") == (one["status"] == "located")
    covariance = np.array(one["covariance_m2"])
    assert covariance.shape == (2, 2)
    assert np.allclose(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance)[0] > 0
    assert one["radius90_m"] > 0
    for outline in one["region90_m"]:
        assert np.asarray(outline).shape[1] == 2
        assert len(outline) >= 3
    assert one["error_m"] >= 0
    assert one["paper"]["method"] == "paper-algorithm-1"
    assert set(one["paper"]) == {"method", "x_m", "y_m", "error_m"}


@pytest.fixture(scope="module")
def told(walks: list[Path]) -> dict[str, Any]:
    """Both walks, fused."""
    return replay_json(*walks, "--fuse")


def test_json_tells_everything_of_a_session(told: dict[str, Any]) -> None:
    assert [one["session"] for one in told["sessions"]] == ["walk-0", "walk-1"]
    for one in told["sessions"]:
        check_fields(one)
        assert one["device"] == HOME.device_mac
        assert one["source"] == "simulated"
        x_m, y_m, _ = HOME.device_m
        assert one["error_m"] == pytest.approx(np.hypot(one["x_m"] - x_m, one["y_m"] - y_m), abs=2e-3)
        assert one["error_m"] < 1.0
        assert any("packets of other" in note for note in one["notes"])
    assert told["unreadable"] == []
    for method in ("spectrogram-likelihood", "paper-algorithm-1"):
        assert told["summary"][method]["count"] == 2
        assert set(told["summary"][method]) == {"count", "median_m", "mean_m", "p80_m"}


def test_fusing_gives_one_sharper_place_for_the_device(told: dict[str, Any]) -> None:
    (fused,) = told["fused"]
    assert fused["device"] == HOME.device_mac
    assert fused["sessions"] == ["walk-0", "walk-1"]
    assert fused["radius90_m"] < max(one["radius90_m"] for one in told["sessions"])
    assert fused["error_m"] < 1.0


def test_people_get_tables_and_pictures(walks: list[Path], tmp_path: Path) -> None:
    folder = tmp_path / "new" / "pictures"
    result = replay(walks[0], "--fuse", "--plot", folder, NEAR)
    assert "paper's error" in result.stdout
    assert "Fused by device" in result.stdout
    assert "spectrogram-likelihood: median" in result.stdout
    assert "paper-algorithm-1: median" in result.stdout
    assert "walk-0: " in result.stderr, "what was left out is said"
    assert sorted(path.name for path in folder.iterdir()) == ["walk-0_map.png", "walk-0_spectrogram.png"]
    for path in folder.iterdir():
        picture = cv2.imread(str(path))
        assert picture is not None
        assert min(picture.shape[:2]) > 300
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 200, "not a blank page"


def test_bounds_say_where_to_look(walks: list[Path]) -> None:
    x_m, y_m, _ = HOME.device_m
    (one,) = replay_json(walks[0], NEAR)["sessions"]
    assert abs(one["x_m"] - x_m) <= NEAR_M
    assert abs(one["y_m"] - y_m) <= NEAR_M
    for wrong in ("1,2,3", "a,b,c,d", "5,0,1,1", "0,0,nan,1", "-9e9,-9e9,9e9,9e9"):
        assert "--bounds" in replay(walks[0], f"--bounds={wrong}", code=2).stderr


def test_a_plot_folder_that_cannot_be_made_is_said_before_the_work(walks: list[Path], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert "--plot" in replay(walks[0], "--plot", tmp_path / "file", code=2).stderr


def other_schema(folder: Path) -> None:
    plain = json.loads((folder / "session.json").read_text())
    (folder / "session.json").write_text(json.dumps(plain | {"schema": "vad.session/7"}))


def walk_of_yesterday(folder: Path) -> None:
    head, *rows = (folder / "trajectory.csv").read_text().splitlines()
    earlier = [f"{int(row.split(',')[0]) - 86_400 * 10**9},{row.split(',', 1)[1]}" for row in rows]
    (folder / "trajectory.csv").write_text("\n".join([head, *earlier]) + "\n")


def cut_in_the_middle(folder: Path) -> None:
    raw = (folder / "csi.dat").read_bytes()
    (folder / "csi.dat").write_bytes(raw[: 3 * len(raw) // 4])


def trajectory_row(text: str) -> Callable[[Path], object]:
    def damage(folder: Path) -> None:
        with (folder / "trajectory.csv").open("a") as file:
            file.write(text + "\n")

    return damage


def hours_between_packets(folder: Path) -> None:
    arrivals = np.load(folder / "csi_arrival.npy")
    arrivals[-1] += 10**15
    np.save(folder / "csi_arrival.npy", arrivals)


def header(**changes: object) -> Callable[[Path], object]:
    def damage(folder: Path) -> None:
        plain = json.loads((folder / "session.json").read_text())
        (folder / "session.json").write_text(json.dumps(plain | changes))

    return damage


DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "no csi.dat": (lambda f: (f / "csi.dat").unlink(), "csi.dat: the file is missing"),
    "empty log": (lambda f: (f / "csi.dat").write_bytes(b""), "csi.dat: the CSI log is empty"),
    "no packet": (lambda f: (f / "csi.dat").write_bytes(bytes(500)), "csi.dat: no CSI packet in the log"),
    "other time": (walk_of_yesterday, "the trajectory and the CSI do not overlap in time"),
    "unknown schema": (other_schema, "unknown schema 'vad.session/7'"),
    "no trajectory": (lambda f: (f / "trajectory.csv").unlink(), "trajectory.csv: the file is missing"),
    "nowhere": (trajectory_row("1,nan,2.0,0.1,1"), "is not t_ns,x_m,y_m,sigma_m,track"),
    "beyond time": (trajectory_row(f"{10**30},1.0,2.0,0.1,1"), "is not t_ns,x_m,y_m,sigma_m,track"),
    "hours": (hours_between_packets, "more than 600 s"),
    "a path as id": (header(id="../../elsewhere"), "$.id"),
    "no wave": (header(radio={"carrier_hz": 0}), "$.radio.carrier_hz"),
    "a country": (header(map={"bounds_m": [0, 0, 1e6, 1e6]}), "longer than 300 m"),
    "inside out": (header(map={"bounds_m": [0, 0, -1, 1]}), "x0 < x1"),
    "bad truth": (lambda f: (f / "truth.json").write_text("{}"), "truth.json: no device place"),
    "no folder": (shutil.rmtree, "no such session folder"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_bad_input_is_one_line_and_exit_code_2(walks: list[Path], walk: Path, name: str) -> None:
    damage, said = DAMAGES[name]
    damage(walk)
    result = replay(walk, "--json", code=2)
    (line,) = lines(result.stderr)
    assert said in line
    assert "damaged" in line, "the folder is named"
    told = json.loads(result.stdout)
    assert told["sessions"] == []
    assert [one["folder"] for one in told["unreadable"]] == [str(walk)]


def test_a_log_cut_in_the_middle_is_solved_up_to_there_and_said(walk: Path) -> None:
    cut_in_the_middle(walk)
    result = replay(walk, "--json", NEAR, code=2)
    (line,) = lines(result.stderr)
    assert "middle of a record" in line
    assert "damaged" in line
    assert "of the walk are missing" in line
    told = json.loads(result.stdout)
    check_fields(told["sessions"][0])
    assert "middle of a record" in told["sessions"][0]["notes"][0]
    assert told["unreadable"] == []


def test_a_tail_cut_off_after_the_walk_is_no_more_than_a_note(walk: Path) -> None:
    """log_to_file ends like this whenever it is stopped."""
    head, *rows = (walk / "trajectory.csv").read_text().splitlines()
    (walk / "trajectory.csv").write_text("\n".join([head, *rows[:-5]]) + "\n")
    raw = (walk / "csi.dat").read_bytes()
    (walk / "csi.dat").write_bytes(raw[:-100])
    result = replay(walk, NEAR)
    assert len([line for line in lines(result.stderr) if "middle of a record" in line]) == 1


def test_the_other_sessions_are_still_solved(walks: list[Path], tmp_path: Path) -> None:
    broken = []
    for k, name in enumerate(("no csi.dat", "empty log", "other time", "unknown schema")):
        broken.append(Path(shutil.copytree(walks[0], tmp_path / f"broken-{k}")))
        DAMAGES[name][0](broken[-1])
    cut = Path(shutil.copytree(walks[0], tmp_path / "cut"))
    cut_in_the_middle(cut)
    result = replay(
        broken[0], walks[0], broken[1], broken[2], cut, broken[3], walks[1], "--json", NEAR, code=2
    )
    assert len(lines(result.stderr)) == 5
    told = json.loads(result.stdout)
    assert [one["session"] for one in told["sessions"]] == ["walk-0", "walk-0", "walk-1"]
    assert all(one["x_m"] is not None for one in told["sessions"])
    assert [one["folder"] for one in told["unreadable"]] == [str(folder) for folder in broken]


def test_a_session_that_tells_nothing_is_refused_with_a_reason(walk: Path, tmp_path: Path) -> None:
    slow = record_walk(tmp_path / "slow", HOME, packets_per_s=30.0)
    head, *rows = (walk / "trajectory.csv").read_text().splitlines()
    (walk / "trajectory.csv").write_text("\n".join([head, *rows[:20]]) + "\n")
    result = replay(slow, walk, "--json", code=1)
    assert lines(result.stderr) == []
    told = json.loads(result.stdout)
    for one, reason in zip(told["sessions"], ("packets/s are too few", "overlap in 1.9 s only"), strict=True):
        assert one["status"] == "refused"
        assert reason in one["reason"]
        assert one["x_m"] is None
        assert one["paper"] is None
    assert told["summary"]["refused"] == 2


def test_as_a_process_it_prints_json_alone(walks: list[Path]) -> None:
    """Standard output is for programs, whatever else is said on standard error."""
    done = subprocess.run(
        [sys.executable, "-m", "vad", "replay", walks[0], "--json", "--fuse", NEAR],
        cwd=ROOT,
        capture_output=True,
        check=True,
    )
    assert len(json.loads(done.stdout)["sessions"]) == 1
    assert done.stderr == b""


def recordings(shared_data: Path) -> Path:
    folder = shared_data / "csi" / "witraj"
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}")
    return folder


def test_a_few_recordings(shared_data: Path) -> None:
    told = replay_json(*(recordings(shared_data) / name for name in A_FEW), "--fuse")
    assert len(told["sessions"]) == len(A_FEW)
    for one in told["sessions"]:
        check_fields(one)
        assert one["source"] == "replay"
    summary = told["summary"]
    assert summary["spectrogram-likelihood"]["median_m"] <= ISSUE_MEDIAN_M
    assert summary["paper-algorithm-1"]["count"] == len(A_FEW)
    assert {one["device"] for one in told["sessions"]} == {one["device"] for one in told["fused"]}


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_all_recordings(shared_data: Path) -> None:
    folders = sorted(recordings(shared_data).iterdir())
    assert len(folders) == 42
    told = replay_json(*folders)
    assert len(told["sessions"]) == 42
    assert told["unreadable"] == []
    for one in told["sessions"]:
        check_fields(one)
    summary = told["summary"]
    assert summary["spectrogram-likelihood"]["count"] == summary["paper-algorithm-1"]["count"] == 42
    assert summary["spectrogram-likelihood"]["median_m"] <= ISSUE_MEDIAN_M
    assert summary["spectrogram-likelihood"]["median_m"] < summary["paper-algorithm-1"]["median_m"]
    errors = [one["error_m"] for one in told["sessions"]]
    assert summary["spectrogram-likelihood"]["median_m"] == pytest.approx(np.median(errors), abs=1e-3)
