"""vad as a stranger has it: the Debian package in a Debian guest, run by systemd, with a year's faults.

Real: the package and its dependencies, apt, systemd and its watchdog, the kernel's uvcvideo, cdc-acm,
mac80211 and NETLINK_CONNECTOR, hostapd, wpa_supplicant, the whole daemon, zenoh, file system and clock.
Emulated: what would be plugged in (USB devices over the kernel's USB/IP, radios of mac80211_hwsim, the 5300's
driver as a sender on its connector group). Made on the host beforehand: pictures, packets and, as an emulated
processor takes 11 s for one, what the packaged pose network finds in each picture (hub/story.py); that it
finds the same in the guest is seen on one of them.
"""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from guest_world import Guest

from vad.mapping.camera_stage import MAX_POSITION_SIGMA_M

HERE = Path(__file__).parent
READY_S = 120.0
"""What hub/hub.py's slow.conf allows; a hub takes a twentieth of what an emulated processor on a busy machine
takes."""
FAULTS = ("camera unplugged", "robot silent", "hostapd restarted")
STEPS = ("clock an hour ahead", "clock an hour back")


def told_by(guest: Guest, folder: Path, package: Path, mode: str, timeout_s: int) -> dict[str, Any]:
    """Run hub/hub.py in the guest; what it reports."""
    for file in (*(HERE / "hub").glob("*.*"), HERE / "cameras" / "usbip.py", HERE / "cameras" / "uvc.py"):
        shutil.copy(file, folder)
    shutil.copy(package, folder)
    (folder / "mode").write_text(mode)
    story = [
        sys.executable,
        str(HERE / "hub" / "story.py"),
        str(folder),
        *(["--plan"] if mode == "short" else []),
    ]
    subprocess.run(story, check=True)
    done = guest(folder, timeout_s=timeout_s)
    sys.stdout.write("\n" + done.stdout)  # the evidence; shown with -s, and where something fails
    found = folder / "report.json"
    assert found.exists(), done.stdout[-3000:] + done.stderr[-3000:]
    report: dict[str, Any] = json.loads(found.read_text())
    return report


def came(report: dict[str, Any], name: str) -> dict[str, Any]:
    """A row that came to its end."""
    assert name in report, f"the guest ended before: {list(report)}"
    row: dict[str, Any] = report[name]
    assert "stuck" not in row, json.dumps(row, indent=1)
    return row


def installed_and_started(report: dict[str, Any]) -> None:
    """The package is in, the unit is up, as its own user, and answers."""
    installed, started = came(report, "installed"), came(report, "started")
    assert installed["package"] == "vad install ok installed"
    assert installed["before settings"]["ActiveState"] == "inactive"  # nothing to run yet, and no failure
    assert "usable" in installed["check-config"]
    assert (started["ActiveState"], started["SubState"]) == ("active", "running")
    assert (started["Type"], started["User"]) == ("notify", "vad")
    assert started["WatchdogUSec"] == "30s"
    assert started["as user"] != "0"
    assert 0.0 < started["ready_s"] < READY_S


def stopped_and_purged(report: dict[str, Any]) -> None:
    """The unit ends as asked, the package leaves nothing."""
    stopped, purged = came(report, "stopped"), came(report, "purged")
    assert (stopped["ActiveState"], stopped["Result"], stopped["ExecMainStatus"]) == (
        "inactive",
        "success",
        "0",
    )
    assert stopped["stop_s"] < READY_S
    assert stopped["tracebacks"] == []
    assert purged["left"] == []
    assert purged["unit"] == "not-found"


@pytest.mark.timeout(2400)
@pytest.mark.slow
def test_package_installs_starts_answers_stops_and_purges(
    guest: Guest, package: Path, tmp_path: Path
) -> None:
    report = told_by(guest, tmp_path, package, "short", 1800)
    installed_and_started(report)
    # Nothing is plugged in: each part says so, and the daemon answers all the same.
    parts = came(report, "started")["parts"]
    assert parts["camera"].startswith("degraded: ")
    assert "there is no such camera" in parts["camera"]
    stopped_and_purged(report)


@pytest.fixture(scope="module")
def report(guest: Guest, package: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What happened in the guest, row by row."""
    return told_by(guest, tmp_path_factory.mktemp("hub"), package, "whole", 3600)


@pytest.mark.slow
@pytest.mark.timeout(4200)
class TestHub:
    def test_installed_and_started(self, report: dict[str, Any]) -> None:
        installed_and_started(report)

    def test_camera_finds_its_place_from_the_robots_drive(self, report: dict[str, Any]) -> None:
        row = came(report, "camera calibrated")
        # A short drive, few pictures: twice the spread from which on the daemon calls it valid.
        assert row["off_m"] < 2.0 * MAX_POSITION_SIGMA_M

    def test_packaged_network_sees_what_it_saw_on_the_host(self, report: dict[str, Any]) -> None:
        row = came(report, "pose network")
        (person,) = row["found"]
        np.testing.assert_allclose(person, row["on the host"], atol=1.0)

    def test_station_that_joins_hostapd_is_in_the_table(self, report: dict[str, Any]) -> None:
        row = came(report, "joined")
        assert row["state"] in ("discovered", "waiting")
        assert row["in_network"]

    def test_device_is_on_the_map_where_it_is(self, report: dict[str, Any]) -> None:
        (device,) = came(report, "mapped")["devices"]
        assert device["state"] == "mapped"
        assert device["source"] == "simulated"
        assert device["error_m"] < 0.8
        assert device["error_m"] < 1.5 * device["radius90_m"]

    @pytest.mark.parametrize("name", FAULTS)
    def test_fault_is_said_and_survived(self, report: dict[str, Any], name: str) -> None:
        row = came(report, name)
        assert row["same process"]
        assert row["noticed"].startswith(("degraded: ", "failed: "))
        survived(row, "meanwhile", "after")
        assert row["back"].startswith("ok")

    def test_killed_daemon_is_started_again_and_knows_everything(self, report: dict[str, Any]) -> None:
        row = came(report, "killed")
        survived(row, "after")
        assert any("code=killed, status=9/KILL" in line for line in row["systemd says"])

    def test_hung_daemon_is_ended_by_the_watchdog(self, report: dict[str, Any]) -> None:
        row = came(report, "watchdog")
        survived(row, "after")
        assert any("Watchdog timeout" in line for line in row["systemd says"])

    def test_full_disk_loses_nothing(self, report: dict[str, Any]) -> None:
        row = came(report, "disk full")
        assert row["same process"]
        assert row["free"] < 65536
        assert "disk" in row["noticed"]
        assert row["name"] == "lamp"
        survived(row, "meanwhile", "after")

    @pytest.mark.parametrize("name", STEPS)
    def test_clock_step_changes_nothing(self, report: dict[str, Any], name: str) -> None:
        row = came(report, name)
        assert row["same process"]
        assert 0.0 < row["uptime_grew_s"] < 600.0
        assert {part: state for part, state in row["parts"].items() if state != "ok"} == {}
        survived(row, "after")

    def test_stopped_and_purged(self, report: dict[str, Any]) -> None:
        stopped_and_purged(report)


def survived(row: dict[str, Any], *when: str) -> None:
    """What was known before is known then: the device's place, the camera's."""
    before = row["before"]
    assert before["place"] is not None
    assert math.isfinite(before["place"][0])
    for moment in when:
        assert row[moment] == before, moment
