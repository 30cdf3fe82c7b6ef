"""A lens from pictures of a board: drawn through a known lens and found again."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from vad.camera.board import MIN_PICTURES, Board, LensMeasurement
from vad.camera.lens_file import LensFile, camera_lens, read_lens, write_lens
from vad.commands.app import app
from vad.config import parse_settings
from vad.errors import ConfigError
from vad.geometry import Intrinsics, Rigid, rotation_from_vector, undistort

pytestmark = pytest.mark.timeout(600)
"""Much work for the processor: a busy machine takes many times as long as an idle one."""

Image = NDArray[np.uint8]
LENS = Intrinsics(640, 480, 455.0, 452.0, 326.0, 233.0, -0.21, 0.05)
SQUARE_PX = 60


def shown(board: Board, camera_from_board: Rigid, lens: Intrinsics = LENS) -> Image:
    """The board as the lens sees it; its frame has the first square's corner as origin, in squares."""
    u, v = np.meshgrid(np.arange(lens.width_px), np.arange(lens.height_px))
    px = undistort(np.column_stack([u.ravel(), v.ravel()]).astype(np.float64), lens)
    rays = np.column_stack([(px - (lens.cx_px, lens.cy_px)) / (lens.fx_px, lens.fy_px), np.ones(len(px))])
    on_board = np.linalg.inv(
        np.column_stack([camera_from_board.rotation[:, :2], camera_from_board.translation])
    )
    meet = rays @ on_board.T
    at = meet[:, :2] / meet[:, 2:] * SQUARE_PX + SQUARE_PX / 2 - 0.5
    grid = np.nan_to_num(at, nan=-1.0).astype(np.float32).reshape(lens.height_px, lens.width_px, 2)
    drawn = cv2.GaussianBlur(board.picture(SQUARE_PX), (0, 0), 1.0)
    raw = cv2.remap(
        drawn, grid[..., 0].copy(), grid[..., 1].copy(), cv2.INTER_LINEAR, None, cv2.BORDER_CONSTANT, 128
    )
    noise = np.random.default_rng(0).normal(0.0, 2.0, raw.shape)
    return np.asarray(cv2.cvtColor(np.clip(raw + noise, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR))


@cache
def pictures(kind: str, count: int = 14, whole: bool = False) -> tuple[Image, ...]:
    board = Board("charuco" if kind == "charuco" else "chess")
    rng = np.random.default_rng(4)
    drawn = []
    for k in range(count):
        turn = rotation_from_vector(rng.uniform((-0.5, -0.5, -0.2), (0.5, 0.5, 0.2)))
        reach = 0.35 if whole else 0.75
        where = np.array([-1.0 + 2.0 * (k % 3) / 2, -1.0 + 2.0 * (k // 3 % 3) / 2]) * reach
        away = rng.uniform(10.0, 12.0) if whole else rng.uniform(7.5, 9.5)
        middle = np.array([where[0] * 0.7 * away, where[1] * 0.53 * away, away])
        corner = middle - turn @ np.array([board.columns / 2, board.rows / 2, 0.0])
        drawn.append(shown(board, Rigid(turn, corner)))
    return tuple(drawn)


@pytest.mark.parametrize(
    ("kind", "whole"), [("charuco", False), pytest.param("chess", True, marks=pytest.mark.slow)]
)
def test_the_lens_is_found_again(kind: str, whole: bool) -> None:
    measurement = LensMeasurement(Board("charuco" if kind == "charuco" else "chess"))
    for picture in pictures(kind, 18 if whole else 14, whole):
        measurement.add(picture)
    assert measurement.missing() == ""
    measured = measurement.solve()
    found = measured.lens
    assert abs(found.fx_px / LENS.fx_px - 1.0) < 0.01
    assert abs(found.fy_px / LENS.fy_px - 1.0) < 0.01
    assert abs(found.cx_px - LENS.cx_px) < 4.0
    assert abs(found.cy_px - LENS.cy_px) < 4.0
    # What matters is where a pixel looks: the two models agree all over the picture.
    u, v = np.meshgrid(np.arange(20.0, 630.0, 60.0), np.arange(20.0, 470.0, 60.0))
    px = np.column_stack([u.ravel(), v.ravel()])
    away = undistort(px, found) - (found.cx_px, found.cy_px)
    true = undistort(px, LENS) - (LENS.cx_px, LENS.cy_px)
    angle = np.degrees(np.abs(np.arctan(away / found.fx_px) - np.arctan(true / LENS.fx_px)))
    assert float(np.median(angle)) < 0.6
    assert measured.error_px < 0.5
    assert 0.0 < measured.focal_sigma_px < 5.0


def test_what_is_missing_is_said() -> None:
    measurement = LensMeasurement(Board())
    assert "0 of" in measurement.missing()
    with pytest.raises(ValueError, match="no picture"):
        measurement.solve()
    first = pictures("charuco")[4]
    assert measurement.add(first)
    assert not measurement.add(first), "the same picture again teaches nothing"
    assert measurement.seen == 2
    assert not measurement.add(np.full_like(first, 128))
    assert f"1 of {MIN_PICTURES}" in measurement.missing()
    with pytest.raises(ValueError, match="move and tilt"):
        measurement.solve()
    with pytest.raises(ValueError, match="640x480"):
        measurement.add(first[:240])


@pytest.mark.slow
def test_a_bent_board_is_refused() -> None:
    measurement = LensMeasurement(Board())
    for k, picture in enumerate(pictures("charuco")):
        wavy = np.arange(640)[None] + 6.0 * np.sin(np.arange(480)[:, None] / 25.0 + k)
        rows = np.repeat(np.arange(480, dtype=np.float32)[:, None], 640, axis=1)
        measurement.add(np.asarray(cv2.remap(picture, wavy.astype(np.float32), rows, cv2.INTER_LINEAR)))
    with pytest.raises(ValueError, match=r"flat|pictures|seen"):
        measurement.solve()


def test_lens_of_pictures_of_another_size() -> None:
    half = LENS.scaled(320, 240)
    assert half.fx_px == LENS.fx_px / 2
    assert half.cx_px == (LENS.cx_px + 0.5) / 2 - 0.5
    assert half.scaled(640, 480) == LENS
    with pytest.raises(ValueError, match="shape"):
        LENS.scaled(1280, 720)


def test_lens_file_survives_and_refuses(tmp_path: Path) -> None:
    path = tmp_path / "lens.yaml"
    write_lens(
        path,
        LensFile(
            width_px=640, height_px=480, fx_px=455.0, fy_px=452.0, cx_px=326.0, cy_px=233.0, k1=-0.21, k2=0.05
        ),
    )
    assert read_lens(path) == LENS
    settings = parse_settings(
        "robot: {type: neato, port: x}\nmap: {file: f.yaml}\nradio: {}\ndevices: {}\n"
        "camera: {source: {type: v4l2, device: d}, intrinsics: lens.yaml}",
        where="here",
    )
    assert camera_lens(settings.camera, tmp_path) == LENS
    with pytest.raises(ConfigError, match="either"):
        parse_settings(
            "robot: {type: neato, port: x}\nmap: {file: f.yaml}\nradio: {}\ndevices: {}\n"
            "camera: {source: {type: v4l2, device: d}, intrinsics: lens.yaml, focal_px: 500}",
            where="here",
        )
    for text in ("fx_px: 1", ": :", "[]", "schema: vad.lens/2"):
        path.write_text(text)
        with pytest.raises(ConfigError, match=r"lens\.yaml"):
            read_lens(path)
    with pytest.raises(ConfigError, match="cannot be read"):
        read_lens(tmp_path / "none.yaml")


def test_command_measures_a_folder_and_says_what_is_missing(tmp_path: Path) -> None:
    run = CliRunner()
    folder, output = tmp_path / "pictures", tmp_path / "lens.yaml"
    folder.mkdir()
    done = run.invoke(app, ["camera", "intrinsics", str(folder), "-o", str(output)])
    assert done.exit_code == 2
    for k, picture in enumerate(pictures("charuco")):
        cv2.imwrite(str(folder / f"{k:02d}.png"), picture)
        if k == 5:
            done = run.invoke(app, ["camera", "intrinsics", str(folder), "-o", str(output)])
            assert done.exit_code == 1
            assert not output.exists()
    done = run.invoke(app, ["camera", "intrinsics", str(folder), "-o", str(output)])
    assert done.exit_code == 0, done.output
    assert "focal length" in done.output
    assert abs(read_lens(output).fx_px / LENS.fx_px - 1.0) < 0.01
    done = run.invoke(app, ["camera", "intrinsics", str(folder), "--squares", "2x99"])
    assert done.exit_code == 2
    printed = tmp_path / "board.png"
    assert run.invoke(app, ["camera", "board", str(printed)]).exit_code == 0
    seen = Board().corners(np.asarray(cv2.imread(str(printed)), dtype=np.uint8))
    assert seen is not None
    assert len(seen[0]) == 35
    assert run.invoke(app, ["camera", "board", str(tmp_path / "board.bmp")]).exit_code == 2
