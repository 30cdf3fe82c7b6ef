"""The units of systemd/: sound, confined, and in step with what the daemon needs."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

UNITS = Path(__file__).resolve().parents[1] / "systemd"
MOST_EXPOSED = {"vad.service": 2.0, "vad-agent.service": 1.5}
ANALYZE = shutil.which("systemd-analyze")
needs_analyze = pytest.mark.skipif(ANALYZE is None, reason="no systemd-analyze: apt-get install systemd")


def analyze(*arguments: str) -> str:
    done = subprocess.run(
        ["systemd-analyze", *arguments], capture_output=True, text=True, check=False, timeout=50
    )
    return done.stdout + done.stderr


@needs_analyze
@pytest.mark.parametrize("unit", MOST_EXPOSED)
def test_a_unit_is_no_more_exposed_than_it_may_be(unit: str) -> None:
    told = analyze("security", "--offline=true", "--no-pager", str(UNITS / unit))
    (exposure,) = re.findall(r"Overall exposure level for .*: ([0-9.]+)", told)
    assert 0.0 < float(exposure) <= MOST_EXPOSED[unit], told


@needs_analyze
def test_systemd_finds_nothing_to_say_about_the_units(tmp_path: Path) -> None:
    """As installed: the program they start is there, and so are the units they name."""
    folder = tmp_path / "usr" / "lib" / "systemd" / "system"
    folder.mkdir(parents=True)
    program = tmp_path / "usr" / "bin" / "vad"
    program.parent.mkdir()
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    for unit in MOST_EXPOSED:
        (folder / unit).write_text((UNITS / unit).read_text())
    for tool in ("kill", "sh"):
        (tmp_path / "usr" / "bin" / tool).symlink_to(f"/usr/bin/{tool}")
    for standard in ("network.target", "network-online.target", "multi-user.target", "basic.target",
                     "shutdown.target", "sysinit.target"):  # fmt: skip
        (folder / standard).write_text(f"[Unit]\nDescription={standard}\n")
    assert analyze("verify", f"--root={tmp_path}", *(str(folder / unit) for unit in MOST_EXPOSED)) == ""


@pytest.mark.parametrize("unit", MOST_EXPOSED)
def test_a_unit_runs_as_nobody_in_particular_and_is_watched(unit: str) -> None:
    text = (UNITS / unit).read_text()
    settings = re.findall(r"^(\w+)=(.*)$", text, re.MULTILINE)
    given = dict(settings)
    assert given["Type"] == "notify"
    assert int(given["WatchdogSec"]) >= 10
    assert given.get("User") == "vad" or given.get("DynamicUser") == "yes"
    assert given["CapabilityBoundingSet"] == given["AmbientCapabilities"] == "CAP_NET_ADMIN"
    # The connector's capability counts in the host's user namespace and network only.
    assert not {"PrivateUsers", "PrivateNetwork"} & given.keys()
    # Wrong settings are wrong the next time, too; everything else is tried again for ever.
    assert given["RestartPreventExitStatus"] == "2"
    assert given["Restart"] == "on-failure"
    assert given["StartLimitIntervalSec"] == "0"


def test_the_package_holds_no_settings_that_an_upgrade_would_ask_about() -> None:
    """/etc/vad/vad.yaml is `vad setup`'s: no conffile, no copy, and the purge knows of it."""
    deb = UNITS.parent / "tools" / "deb"
    assert not (deb / "conffiles").exists()
    assert "rm -rf /etc/vad " in (deb / "postrm").read_text()
