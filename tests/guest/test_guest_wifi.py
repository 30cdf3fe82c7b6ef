"""Stations of a real WPA2 network: nl80211 and hostapd in the guest, radios of mac80211_hwsim."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from guest_world import Guest

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3000)]

SOON_S = 2.0
"""A guest's Python is some ten times slower than a hub's."""


@pytest.fixture(scope="module")
def report(guest: Guest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What vad's join sources heard in the guest."""
    folder = tmp_path_factory.mktemp("wifi")
    for file in (Path(__file__).parent / "wifi").iterdir():
        if file.is_file():
            shutil.copy(file, folder)
    done = guest(folder, timeout_s=2400)
    logs = "".join(log.read_text()[-2000:] for log in sorted(folder.glob("*.log")))
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:] + logs
    found: dict[str, Any] = json.loads((folder / "report.json").read_text())
    assert "stuck" not in found, json.dumps(found, indent=1) + logs
    return found


def test_the_kernel_and_hostapd_tell_the_same_story(report: dict[str, Any]) -> None:
    for source in ("nl80211", "hostapd"):
        kinds = [event[1] for event in report[source]]
        assert kinds == ["joined", "left", "joined", "left"], source
        assert {tuple(event[2:]) for event in report[source]} == {("02:00:00:00:01:00", "wlan0")}


def test_the_kernel_tells_as_soon_as_hostapd(report: dict[str, Any]) -> None:
    joined = {
        source: [event[0] for event in report[source] if event[1] == "joined"]
        for source in report
        if source in ("nl80211", "hostapd")
    }
    delays_s = [kernel - point for kernel, point in zip(joined["nl80211"], joined["hostapd"], strict=True)]
    print(f"\nnl80211 after hostapd: {[f'{1e3 * delay:.0f} ms' for delay in delays_s]}")  # noqa: T201 - measured
    assert all(abs(delay) < SOON_S for delay in delays_s)


def test_who_knows_no_password_has_not_joined(report: dict[str, Any]) -> None:
    assert report["before hostapd"].startswith("wlan0 is no access point")
    assert report["after a wrong password"] == 0
    assert report["counters"].get("bad_input", 0) == 0
