"""`vad check-config`, `vad run`: what cannot be used is one line that says where, and exit code 2."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner
from waiting import free_port

from vad.commands.app import app
from vad.robot.map_server import save_floor_plan
from vad.sim.home import floor_plan
from vad.sim.scenario import make_home

ROOT = Path(__file__).parents[2]


@pytest.fixture
def settings(tmp_path: Path) -> dict[str, Any]:
    """Usable settings, beside a floor plan in `tmp_path`; nothing they name needs to be there to start."""
    save_floor_plan(floor_plan(make_home(1)), tmp_path / "floor.yaml")
    return {
        "state_dir": "state",
        "map": {"file": "floor.yaml"},
        "robot": {"type": "neato", "port": "neato.tty"},
        "camera": {"source": {"type": "mjpeg", "url": "http://127.0.0.1:9/stream"}},
        "radio": {"source": {"type": "follow", "path": "csi.fifo"}},
        "devices": {"hostapd": ["hostapd.sock"]},
        "bus": {"listen": [f"tcp/127.0.0.1:{free_port()}"]},
    }


def write(settings: dict[str, Any], folder: Path) -> Path:
    path = folder / "vad.yaml"
    path.write_text(yaml.safe_dump(settings))
    return path


def check(path: Path, code: int) -> str:
    """What `vad check-config` says, as one line."""
    result = CliRunner().invoke(app, ["check-config", "--config", str(path)])
    assert result.exit_code == code, (result.output, result.exception)
    (line,) = (result.stderr if code else result.stdout).splitlines()
    return line


def run(path: Path, code: int = 2) -> str:
    """What `vad run` says before it gives up, as one line."""
    done = subprocess.run(
        [sys.executable, "-m", "vad", "run", "--config", path], cwd=ROOT, capture_output=True, timeout=50
    )
    said = done.stderr.decode()
    assert done.returncode == code, said
    assert done.stdout == b""
    (line,) = said.splitlines()
    return line


def no_plan(_: dict[str, Any], folder: Path) -> None:
    (folder / "floor.yaml").unlink()


def no_picture(_: dict[str, Any], folder: Path) -> None:
    (folder / "floor.pgm").unlink()


def not_a_picture(_: dict[str, Any], folder: Path) -> None:
    (folder / "floor.pgm").write_text("hello")


def no_model(settings: dict[str, Any], _: Path) -> None:
    settings["vision"] = {"model": "movenet.onnx"}


def rtsp_camera(settings: dict[str, Any], _: Path) -> None:
    settings["camera"]["source"]["url"] = "rtsp://camera/stream"


def no_recording(settings: dict[str, Any], _: Path) -> None:
    settings["camera"]["source"] = {"type": "folder", "path": "frames"}


def open_to_the_network(settings: dict[str, Any], _: Path) -> None:
    settings["bus"]["listen"] = ["tcp/0.0.0.0:7447"]


def unknown_key(settings: dict[str, Any], _: Path) -> None:
    settings["robot"]["prot"] = "/dev/ttyACM0"


def wrong_value(settings: dict[str, Any], _: Path) -> None:
    settings["radio"]["carrier_hz"] = "five"


Change = Callable[[dict[str, Any], Path], None]
UNUSABLE: list[tuple[Change, str]] = [
    (no_plan, "floor.yaml: cannot read this file: No such file"),
    (no_picture, "floor.pgm: cannot read this file: No such file"),
    (not_a_picture, "floor.pgm: this is not a PGM picture"),
    (no_model, "movenet.onnx|vision.model"),
    (rtsp_camera, "camera: only http:// streams"),
    (no_recording, "frames: there is no such folder or video"),
    (open_to_the_network, "tcp/0.0.0.0:7447: plain TCP"),
    (unknown_key, "vad.yaml: $.robot: .*unknown field `prot`"),
    (wrong_value, "vad.yaml: $.radio.carrier_hz: "),
]
NAMES = [change.__name__ for change, _ in UNUSABLE]


def test_usable_settings(settings: dict[str, Any], tmp_path: Path) -> None:
    assert check(write(settings, tmp_path), 0) == (
        f"{tmp_path / 'vad.yaml'}: the settings are usable (hub 'home', source live)"
    )


def test_the_example_settings_are_usable() -> None:
    assert "usable" in check(ROOT / "config" / "vad.yaml", 0)


@pytest.mark.parametrize(("change", "said"), UNUSABLE, ids=NAMES)
def test_check_config_says_which_setting_and_why(
    settings: dict[str, Any], tmp_path: Path, change: Change, said: str
) -> None:
    change(settings, tmp_path)
    assert_matches(check(write(settings, tmp_path), 2), said)


@pytest.mark.parametrize(("change", "said"), UNUSABLE, ids=NAMES)
def test_run_gives_up_with_one_line(
    settings: dict[str, Any], tmp_path: Path, change: Change, said: str
) -> None:
    change(settings, tmp_path)
    assert_matches(run(write(settings, tmp_path)), said)


def assert_matches(line: str, said: str) -> None:
    assert re.search(said.replace("$", r"\$"), line), line


@pytest.mark.parametrize("text", ["a: [", "- 1", "", "\xff"])
def test_a_file_that_is_no_settings_file(tmp_path: Path, text: str) -> None:
    path = tmp_path / "vad.yaml"
    path.write_bytes(text.encode("latin-1"))
    assert str(path) in check(path, 2)


def test_no_file_at_all(tmp_path: Path) -> None:
    for said in (check(tmp_path / "none.yaml", 2), run(tmp_path / "none.yaml")):
        assert f"{tmp_path / 'none.yaml'}: cannot be read (No such file or directory)" in said


@pytest.fixture
def taken_port() -> Iterator[int]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        yield listener.getsockname()[1]


def test_a_port_in_use(settings: dict[str, Any], tmp_path: Path, taken_port: int) -> None:
    settings["bus"]["listen"] = [f"tcp/127.0.0.1:{taken_port}"]
    said = run(write(settings, tmp_path), 1)  # another time it may be free: systemd tries again
    assert f"tcp/127.0.0.1:{taken_port}: the port is taken. Another vad" in said


def test_a_state_folder_that_cannot_be(settings: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "state").write_text("a file")
    assert "state/vad.sqlite: the store cannot be used" in run(write(settings, tmp_path), 1)


def test_a_model_that_is_none(settings: dict[str, Any], tmp_path: Path) -> None:
    settings["vision"] = {"model": "floor.pgm"}
    assert "floor.pgm: the pose network cannot be loaded" in run(write(settings, tmp_path))
