"""`vad camera`: tables and overlay from a simulated drive; the whole command on a simulated home is slow."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner
from waiting import wait_until

from vad.commands.app import app
from vad.commands.camera_tables import check_json, check_table, progress_table, result_json, rows_of
from vad.mapping.camera_calibration import CameraCalibration, Deviations
from vad.mapping.camera_stage import CameraMapper
from vad.report.camera_overlay import draw_overlay
from vad.sim.camera_drive import POSE_SIGMA_M, Drive, make_drive
from vad.sim.scenario import make_home

S_NS = 1_000_000_000


@pytest.fixture(scope="module")
def result() -> tuple[Drive, CameraCalibration, Deviations]:
    drive = make_drive(1, "L", laps=1)
    mapper = CameraMapper(640, 480)
    rng = np.random.default_rng(0)
    for t, (x, y) in zip(*drive.poses(rng, rate_hz=10.0), strict=True):
        mapper.add_pose(round(t * S_NS), x, y, POSE_SIGMA_M)
    for frame in drive.candidates(rng, rate_hz=10.0):
        mapper.add_candidates(round(frame.t_s * S_NS), frame.px, frame.sigma_px)
    found = mapper.solve()
    assert found.status == "valid"
    against = mapper.deviations(found)
    assert against is not None
    return drive, found, against


def shown(table: object) -> str:
    console = Console(width=120)
    with console.capture() as captured:
        console.print(table)
    return captured.get()


def test_deviations_by_part_of_the_picture(result: tuple[Drive, CameraCalibration, Deviations]) -> None:
    _, found, against = result
    rows = rows_of(against, found)
    assert rows[0].part == "all"
    assert rows[0].pairs == len(against.robot_m)
    assert sum(row.pairs for row in rows if "third" in row.part) == rows[0].pairs
    assert 0.0 < rows[0].median_m <= rows[0].mean_m <= rows[0].p95_m <= rows[0].worst_m
    assert rows[0].mean_m < 0.06
    assert against.agreeing > 0.7
    assert f"{100 * rows[0].mean_m:.1f}" in shown(check_table(rows))
    plain = json.loads(json.dumps(check_json(rows, against.agreeing, right=True)))
    assert plain["right"] is True
    assert plain["parts"][0]["mean_m"] == rows[0].mean_m
    moved = Deviations(
        against.robot_m,
        np.add(against.camera_m, (0.3, 0.0)),
        against.image_px,
        against.agreeing,
        against.path_m,
    )
    assert rows_of(moved, found)[0].bias_x_m == pytest.approx(rows[0].bias_x_m + 0.3, abs=1e-3)


def test_progress_says_every_estimate_and_what_is_missing(
    result: tuple[Drive, CameraCalibration, Deviations],
) -> None:
    _, found, against = result
    text = shown(progress_table(found, "camera: no pictures", against))
    for word in ("valid", "100 %", "focal length", "±", "ms", "this drive", "no pictures"):
        assert word in text
    text = shown(
        progress_table(CameraCalibration("collecting", 40, "drive across", unseen=("left",), pairs=9))
    )
    assert "drive across" in text
    assert "left" in text
    plain = json.loads(json.dumps(result_json(found)))
    assert "view" not in plain
    assert len(plain["position_m"]) == 3


def test_overlay_draws_the_floor_where_it_is(result: tuple[Drive, CameraCalibration, Deviations]) -> None:
    drive, found, against = result
    blank = np.full((480, 640, 3), 90, dtype=np.uint8)
    walls = drive.robot_xy_m(np.array([10.0]))
    drawn = draw_overlay(blank, found, walls_m=walls)
    place = drive.pixels(walls)[0]
    around = drawn[int(place[1]) - 6 : int(place[1]) + 7, int(place[0]) - 6 : int(place[0]) + 7].astype(int)
    assert np.any((around[..., 2] > 180) & (around[..., 1] < 120)), (
        "the wall's dot is where the camera sees it"
    )
    assert not np.array_equal(drawn, blank)
    everything = draw_overlay(
        blank,
        found,
        walls_m=walls,
        path_m=against.path_m,
        found_px=against.image_px,
        robot_m=against.robot_m,
        errors=True,
        lines=["±3 cm"],
    )
    assert everything.shape == blank.shape
    assert np.all(blank == 90), "the picture given is left as it was"
    with pytest.raises(ValueError, match="not calibrated"):
        draw_overlay(blank, CameraCalibration("collecting", 0, ""))


def test_overlay_draws_no_floor_behind_a_wall(result: tuple[Drive, CameraCalibration, Deviations]) -> None:
    drive, found, _ = result
    assert found.position_m is not None
    xy = drive.robot_xy_m(np.linspace(5.0, 25.0, 200))
    px = drive.pixels(xy)
    # A wall across the line of sight to the farthest place of the drive, half way there.
    far = int(
        np.nanargmax(np.where(np.isfinite(px[:, 0]), np.linalg.norm(xy - found.position_m[:2], axis=1), 0))
    )
    sight = xy[far] - found.position_m[:2]
    across = np.array([-sight[1], sight[0]]) / np.linalg.norm(sight)
    wall = found.position_m[:2] + 0.5 * sight + np.linspace(-1.0, 1.0, 81)[:, None] * across
    blank = np.full((480, 640, 3), 90, dtype=np.uint8)

    def ink(walls_m: np.ndarray | None) -> int:
        x, y = px[far].astype(int)
        drawn = draw_overlay(blank, found, walls_m=walls_m, errors=True)
        return int(np.count_nonzero(drawn[y - 5 : y + 6, x - 5 : x + 6] != 90))

    assert ink(None) > 100
    assert ink(wall) == 0
    # What the camera hangs on hides nothing.
    assert ink(found.position_m[:2] + 0.2 * across * np.linspace(-1.0, 1.0, 9)[:, None]) > 100


def test_wrong_use_is_told_in_one_line(tmp_path: Path) -> None:
    run = CliRunner()
    for command in ("calibrate", "check"):
        done = run.invoke(app, ["camera", command, "--config", str(tmp_path / "none.yaml")])
        assert done.exit_code == 2
        assert "none.yaml" in done.output
        assert "Traceback" not in done.output


@contextmanager
def home(folder: Path, seed: int) -> Iterator[Path]:
    """A simulated home from its beginning, the robot about to drive; gives the settings."""
    settings = folder / "vad.yaml"
    settings.unlink(missing_ok=True)
    command = [sys.executable, "-m", "vad", "sim", "--dir", str(folder), "--seed", str(seed), "--fifo"]
    with (folder.with_suffix(".log")).open("wb") as log:
        playing = subprocess.Popen(command, stdout=log, stderr=log)
    try:
        wait_until(settings.exists, "the home begins")
        yield settings
    finally:
        playing.terminate()
        playing.wait()


def camera(command: str, settings: Path, picture: Path, *more: str) -> tuple[int, dict[str, object]]:
    """Exit code and JSON of `vad camera COMMAND`; it ends by itself."""
    line = [sys.executable, "-m", "vad", "camera", command, "--config", str(settings), "--json"]
    done = subprocess.run(
        [*line, "--picture", str(picture), *more], capture_output=True, check=False, timeout=400
    )
    assert b"Traceback" not in done.stderr, done.stderr.decode()
    return done.returncode, json.loads(done.stdout)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_calibrate_ends_when_the_robot_has_come_home_and_check_agrees(tmp_path: Path) -> None:
    folder = tmp_path / "home"
    with home(folder, 3) as settings:
        code, said = camera("calibrate", settings, tmp_path / "calibrated.png")
    assert code == 0
    assert said["status"] == "valid"
    eye_m = np.array(said["position_m"])
    assert float(np.linalg.norm(eye_m - make_home(3).camera.eye_m)) < 0.15
    with home(folder, 3) as settings:
        code, said = camera("check", settings, tmp_path / "checked.png", "--for", "40")
    assert code == 0
    assert said["right"] is True
    for name in ("calibrated.png", "checked.png"):
        assert cv2.imread(str(tmp_path / name)).shape == (480, 640, 3)
