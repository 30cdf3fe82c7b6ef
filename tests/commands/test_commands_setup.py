"""`vad setup` from the first question to the file, as a script, as a conversation, on a terminal."""

from __future__ import annotations

import json
import os
import pty
import re
import select
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from vad.commands import doctor
from vad.commands.app import app
from vad.commands.doctor.robot import check_serial_port
from vad.config import NeatoRobot, RoombaRobot, ValetudoRobot, load_settings
from vad.robot.map_server import save_floor_plan
from vad.sim.home import floor_plan
from vad.sim.scenario import make_home

ROOT = Path(__file__).parents[2]
EMPTY_MISSING = 4
"""No camera, no robot, no CSI card, no access point."""


@pytest.fixture
def hub(tmp_path: Path) -> Path:
    """An empty hub's root."""
    root = tmp_path / "hub"
    root.mkdir()
    return root


def setup(hub: Path, config: Path, *options: str, answers: Sequence[str] = ()) -> Any:
    arguments = ["setup", "--root", str(hub), "--config", str(config), "--no-check", *options]
    return CliRunner().invoke(app, arguments, input="".join(f"{answer}\n" for answer in answers))


def add_port(hub: Path, name: str) -> None:
    folder = hub / "dev/serial/by-id"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).touch()


def test_a_hub_with_nothing_gets_usable_settings_that_say_what_is_missing(hub: Path, tmp_path: Path) -> None:
    config = tmp_path / "etc/vad.yaml"
    result = setup(hub, config, "--yes")
    assert result.exit_code == 0, result.output
    settings = load_settings(config)
    assert settings.radio.carrier_hz == 5.24e9
    text = config.read_text()
    assert text.count("# MISSING: ") == EMPTY_MISSING
    assert "no Intel 5300" in result.output
    assert f"Next: vad run --config {config}" in result.output
    assert "#quota_mb: 2000" in text, "every setting is there"


def test_what_is_there_is_not_replaced_without_being_told_to(hub: Path, tmp_path: Path) -> None:
    config = tmp_path / "vad.yaml"
    assert setup(hub, config, "--yes").exit_code == 0
    kept = config.read_text().replace("#quota_mb: 2000", "quota_mb: 777").replace("#hub: home", "hub: flat")
    config.write_text(kept)
    result = setup(hub, config, "--yes")
    assert result.exit_code == 1
    assert "--overwrite" in result.stderr
    assert config.read_text() == kept
    add_port(hub, "usb-Neato_Robotics_1-if00")
    result = setup(hub, config, "--yes", "--overwrite")
    assert result.exit_code == 0, result.output
    settings = load_settings(config)
    assert (settings.capture.quota_mb, settings.hub) == (777, "flat"), "what was set stays set"
    (backup,) = tmp_path.glob("vad.yaml.2*")
    assert backup.read_text() == kept


def test_a_neato_that_says_so_is_taken_without_a_question(hub: Path, tmp_path: Path) -> None:
    add_port(hub, "usb-Neato_Robotics_1-if00")
    assert setup(hub, tmp_path / "vad.yaml", "--yes").exit_code == 0
    robot = load_settings(tmp_path / "vad.yaml").robot
    assert robot == NeatoRobot(port="/dev/serial/by-id/usb-Neato_Robotics_1-if00", lidar=True)


def test_a_dry_run_writes_nothing_and_prints_the_file_alone(hub: Path, tmp_path: Path) -> None:
    result = setup(hub, tmp_path / "vad.yaml", "--yes", "--dry-run")
    assert result.exit_code == 0
    assert list(tmp_path.iterdir()) == [hub]
    again = tmp_path / "again.yaml"
    again.write_bytes(result.stdout_bytes)
    assert load_settings(again).hub == "home"
    assert "Looking around" in result.stderr


def test_json_tells_what_was_found_and_written(hub: Path, tmp_path: Path) -> None:
    add_port(hub, "usb-FTDI_7-if00")
    config = tmp_path / "vad.yaml"
    answer: dict[str, Any] = json.loads(setup(hub, config, "--json").stdout)
    assert [port["path"] for port in answer["found"]["ports"]] == ["/dev/serial/by-id/usb-FTDI_7-if00"]
    assert answer["written"] == str(config)
    assert answer["backup"] is None
    assert len(answer["missing"]) == EMPTY_MISSING
    assert answer["settings"]["camera"]["source"]["type"] == "v4l2"


def test_a_conversation(hub: Path, tmp_path: Path) -> None:
    """Every answer counts, a wrong one is asked again, and defaults are only offered."""
    save_floor_plan(floor_plan(make_home(1)), tmp_path / "floor.yaml")
    config = tmp_path / "vad.yaml"
    answers = [
        "9",  # a number that is not offered
        "1",  # an IP camera
        "ftp://camera",  # no camera's address
        "rtsp://192.168.1.31/stream2",
        "n",  # no picture
        "4",  # a Roomba
        "socket://192.168.1.41:3333",
        "999",  # no channel
        "36",
        "1",  # the floor plan that lies beside the file
        "y",  # write
    ]
    result = setup(hub, config, answers=answers)
    assert result.exit_code == 0, result.output
    settings = load_settings(config)
    assert settings.robot == RoombaRobot(port="socket://192.168.1.41:3333")
    assert settings.map.file == "floor.yaml"
    assert settings.radio.carrier_hz == 5.18e9
    assert settings.camera.source.__struct_config__.tag == "rtsp"
    assert "there is no Wi-Fi channel 999" in result.stderr


def test_a_robot_that_does_not_answer_is_taken_only_on_wish(hub: Path, tmp_path: Path) -> None:
    config = tmp_path / "vad.yaml"
    refused = ["2", "2", "127.0.0.1:9", "n", "127.0.0.1:9", "y", "", "y"]
    result = setup(hub, config, answers=refused)
    assert result.exit_code == 0, result.output
    assert result.output.count("cannot be reached") == 2
    assert load_settings(config).robot == ValetudoRobot(url="http://127.0.0.1:9")


@pytest.mark.parametrize("answers", [[], ["2", "5"], ["2", "5", "", "n"]])
def test_who_goes_away_leaves_everything_as_it_was(hub: Path, tmp_path: Path, answers: list[str]) -> None:
    result = setup(hub, tmp_path / "vad.yaml", answers=answers)
    assert result.exit_code == 1
    assert result.stderr.splitlines()[-1] == "nothing was written"
    assert list(tmp_path.iterdir()) == [hub]


def test_settings_that_cannot_be_used_are_kept_beside_the_new_ones(hub: Path, tmp_path: Path) -> None:
    config = tmp_path / "vad.yaml"
    config.write_text("robot: {type: none}\n")
    result = setup(hub, config, answers=["2", "5", "", "y"])
    assert result.exit_code == 0, result.output
    assert "not built upon" in result.stderr
    assert next(tmp_path.glob("vad.yaml.2*")).read_text() == "robot: {type: none}\n"


def test_the_check_at_the_end_decides_what_comes_next(
    hub: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The doctor's own checks run on the new file; without a robot they find something."""
    monkeypatch.setattr(doctor, "CHECKS", {"robot": (check_serial_port,)})
    config = tmp_path / "vad.yaml"
    arguments = ["setup", "--root", str(hub), "--config", str(config), "--yes"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 1
    assert "/dev/serial/by-id/FILL-IN does not exist" in result.stdout
    assert f"vad doctor --config {config}" in result.stdout.splitlines()[-1]


def talk(
    arguments: list[str], answers: list[tuple[str, str]], environment: dict[str, str]
) -> tuple[int, bytes]:
    """Run a program on a terminal of its own; each answer is typed when its question stands there."""
    master, slave = pty.openpty()
    program = subprocess.Popen(arguments, stdin=slave, stdout=slave, stderr=slave, env=environment, cwd=ROOT)
    os.close(slave)
    shown, seen, until_s = b"", 0, time.monotonic() + 40
    try:
        while time.monotonic() < until_s:
            if not select.select([master], [], [], 0.2)[0]:
                if program.poll() is not None:
                    break
                continue
            try:
                data = os.read(master, 4096)
            except OSError:  # the other end is closed
                break
            if not data:
                break
            shown += data
            if answers and answers[0][0].encode() in shown[seen:]:
                seen = len(shown)
                os.write(master, answers.pop(0)[1].encode() + b"\n")
        return program.wait(15), shown
    finally:
        if program.poll() is None:
            program.kill()
            program.wait()
        os.close(master)


@pytest.mark.parametrize(
    "locale",
    [
        {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "TERM": "dumb"},
        {"LC_ALL": "C.UTF-8", "TERM": "xterm-256color"},
        {"PYTHONIOENCODING": "latin-1", "TERM": "vt100", "NO_COLOR": "1"},
    ],
    ids=["ASCII without colour", "UTF-8", "Latin-1"],
)
def test_a_conversation_on_a_terminal(hub: Path, tmp_path: Path, locale: dict[str, str]) -> None:
    config = tmp_path / "vad.yaml"
    arguments = ["-m", "vad", "setup", "--root", str(hub), "--config", str(config), "--no-check"]
    keep = {key: os.environ[key] for key in ("PATH", "HOME") if key in os.environ}
    answers = [
        ("Number", "2"),
        ("Number", "5"),
        ("channel", "44"),
        ("Write", "y"),
    ]
    code, shown = talk([sys.executable, *arguments], answers, keep | locale)
    assert code == 0, shown.decode(errors="replace")
    assert not answers, "every question was asked"
    assert load_settings(config).radio.carrier_hz == 5.22e9
    if locale["TERM"] == "dumb":
        assert b"\x1b" not in shown
    if "NO_COLOR" in locale:
        assert not re.search(rb"\x1b\[[0-9;]*[349][0-7]", shown)
