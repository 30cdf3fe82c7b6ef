"""Settings on their way into the file."""

from __future__ import annotations

import os
from datetime import UTC, datetime
from pathlib import Path

import pytest

from vad.config import parse_settings
from vad.errors import ConfigError
from vad.setup.draft import Draft, check_writable, write_settings

NOW = datetime(2026, 3, 2, 7, 5, 9, tzinfo=UTC)
CHOSEN = {
    "robot": {"type": "neato", "port": "/dev/ttyACM0", "lidar": True},
    "camera": {"source": {"type": "v4l2", "device": "/dev/video0"}},
    "radio": {},
    "devices": {"hostapd": ["/run/hostapd/wlan0"]},
}


def test_a_new_file_goes_into_a_new_folder_and_an_old_one_stays_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "etc/vad.yaml"
    assert write_settings("first\n", path, NOW) is None
    path.chmod(0o600)
    backup = write_settings("second: ü\n", path, NOW)
    assert backup == tmp_path / "etc/vad.yaml.20260302-070509"
    assert backup.read_text() == "first\n"
    assert path.read_text(encoding="utf-8") == "second: ü\n"
    assert path.stat().st_mode & 0o777 == 0o600, "rights stay as they were"
    assert sorted(entry.name for entry in path.parent.iterdir()) == ["vad.yaml", backup.name]


def test_what_is_missing_stands_in_the_file() -> None:
    text = Draft(dict(CHOSEN), ["there is no robot yet"]).text()
    assert "# MISSING: there is no robot yet" in text.splitlines()
    assert parse_settings(text, where="new").camera.id == "main"


def test_what_could_not_be_used_is_not_written() -> None:
    with pytest.raises(ConfigError, match="map"):
        Draft({**CHOSEN, "robot": {"type": "roomba", "port": "/dev/ttyUSB0"}}).text()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_may_not_be_written_is_told_before(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(ConfigError, match="sudo"):
        check_writable(tmp_path / "vad/vad.yaml")


def test_a_file_in_the_way_is_told(tmp_path: Path) -> None:
    (tmp_path / "vad").write_text("a file")
    with pytest.raises(ConfigError, match="cannot be written"):
        write_settings("x", tmp_path / "vad/vad.yaml", NOW)
