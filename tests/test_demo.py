"""The whole chain, as the README promises it: from nothing to a device on the map, asked for over zenoh."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_demo_places_the_device(tmp_path: Path) -> None:
    home = tmp_path / "home"
    done = subprocess.run(
        [sys.executable, "-m", "vad", "demo", "--seed", "3", "--dir", str(home)],
        capture_output=True,
        check=False,
    )
    said = done.stdout.decode()
    logs = "".join(path.read_text() for path in home.glob("*.log"))
    assert done.returncode == 0, said + done.stderr.decode() + logs
    assert "is mapped" in said
    assert "simulated" in said
    assert "Traceback" not in logs
    for file in home.glob("state/sessions/*/session.json"):
        assert '"recording"' not in file.read_text()
