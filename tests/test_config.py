"""Settings: defaults are there, mistakes are refused with their path."""

from __future__ import annotations

from pathlib import Path

import pytest

from vad.config import NeatoRobot, load_settings, parse_settings, resolve
from vad.errors import ConfigError

GOOD = """
map: {file: floor.yaml}
robot: {type: neato, port: /dev/ttyACM0}
camera: {source: {type: v4l2, device: /dev/video0}}
radio: {}
devices: {hostapd: [/run/hostapd/wlan0]}
"""


def test_defaults_are_filled_in() -> None:
    settings = parse_settings(GOOD, where="vad.yaml")
    assert settings.robot == NeatoRobot(port="/dev/ttyACM0")
    assert settings.source == "live"
    assert settings.bus.listen == ("tcp/127.0.0.1:7447",)
    assert settings.camera.id == "main"


@pytest.mark.parametrize(
    ("change", "where", "what"),
    [
        ("robot: {type: neato, port: a, prot: b}", r"\$\.robot", "unknown field `prot`"),
        ("robot: {type: roomba-9, port: a}", r"\$\.robot", "Invalid value 'roomba-9'"),
        ("devices: {ignore: [aa:bb]}", r"\$\.devices\.ignore", "matching regex"),
        ("radio: {carrier_hz: -1}", r"\$\.radio\.carrier_hz", "> 0"),
        ("capture: {min_walks: 0}", r"\$\.capture\.min_walks", ">= 1"),
        ("hub: 'a/b'", r"\$\.hub", "matching regex"),
    ],
)
def test_a_mistake_is_refused_with_its_path(change: str, where: str, what: str) -> None:
    key = change.split(":")[0]
    text = "\n".join(line for line in GOOD.splitlines() if not line.startswith(f"{key}:")) + "\n" + change
    with pytest.raises(ConfigError, match=what) as caught:
        parse_settings(text, where="vad.yaml")
    assert caught.match(where)


def test_a_missing_part_is_named() -> None:
    with pytest.raises(ConfigError, match="required field `robot`"):
        parse_settings("map: {file: f}", where="vad.yaml")


@pytest.mark.parametrize("text", ["", "- a", "a: [", "just words"])
def test_what_is_no_settings_file_is_refused(text: str) -> None:
    with pytest.raises(ConfigError):
        parse_settings(text, where="vad.yaml")


def test_a_missing_file_says_how_to_name_one(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--config"):
        load_settings(tmp_path / "none.yaml")


def test_relative_paths_are_taken_from_the_file(tmp_path: Path) -> None:
    assert resolve("floor.yaml", tmp_path / "vad.yaml") == tmp_path / "floor.yaml"
    assert resolve("/etc/x", tmp_path / "vad.yaml") == Path("/etc/x")
