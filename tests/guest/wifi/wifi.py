"""In the guest: what vad hears of a station through the kernel's nl80211 and through hostapd, on a real WPA2
network between two simulated radios. Writes report.json."""

from __future__ import annotations

import asyncio
import json
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from vad.devices.hostapd_source import HostapdSource
from vad.devices.nl80211_source import Nl80211Source
from vad.devices.station import StationEvent
from vad.streams import DropOldestQueue

HOSTAPD = """interface=wlan0
driver=nl80211
ctrl_interface=/run/hostapd
ssid=home
hw_mode=g
channel=1
wpa=2
wpa_key_mgmt=WPA-PSK
rsn_pairwise=CCMP
wpa_passphrase=12345678
"""
STATION = """network={{
 ssid="home"
 psk="{password}"
 scan_freq=2412
}}
"""


class Watch:
    """Events of one source, with the seconds at which they came."""

    def __init__(self, source: HostapdSource | Nl80211Source) -> None:
        self.source = source
        self.events: list[tuple[float, str, str, str]] = []
        self._stations: DropOldestQueue[StationEvent] = DropOldestQueue(64)

    async def run(self) -> None:
        """Until cancelled."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self.source.run(self._stations))
            group.create_task(self._take())

    async def _take(self) -> None:
        while True:
            event = await self._stations.get()
            self.events.append((event.t_ns / 1e9, event.kind, event.mac, event.interface))

    def count(self, kind: str) -> int:
        """How many events of this kind there were."""
        return sum(event[1] == kind for event in self.events)


async def until(condition: Callable[[], bool], what: str, timeout_s: float = 90.0) -> None:
    """Wait for a condition."""
    end_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > end_s:
            raise TimeoutError(what)
        await asyncio.sleep(0.02)


def hostapd() -> subprocess.Popen[bytes]:
    """Start the access point."""
    Path("/tmp/hostapd.conf").write_text(HOSTAPD)
    with Path("/shared/hostapd.log").open("ab") as log:
        return subprocess.Popen(["hostapd", "-t", "/tmp/hostapd.conf"], stdout=log, stderr=log)


def station(password: str) -> subprocess.Popen[bytes]:
    """Start a station."""
    Path("/tmp/station.conf").write_text(STATION.format(password=password))
    command = ["wpa_supplicant", "-t", "-i", "wlan1", "-c", "/tmp/station.conf", "-D", "nl80211"]
    with Path("/shared/station.log").open("ab") as log:
        return subprocess.Popen(["ip", "netns", "exec", "station", *command], stdout=log, stderr=log)


async def story(kernel: Watch, access_point: Watch, report: dict[str, Any]) -> None:
    """Wrong password, right password, access point killed and started again, farewell."""
    health = kernel.source.health
    await until(lambda: "no access point" in health.detail, "wlan0 is there")
    report["before hostapd"] = health.detail
    point = hostapd()
    await until(lambda: health.state == "ok", "nl80211 sees the access point")
    await until(lambda: access_point.source.health.state == "ok", "hostapd's socket")
    wrong = station("wrong password")
    log = Path("/shared/hostapd.log")
    await until(
        lambda: "POSSIBLE-PSK-MISMATCH" in log.read_text() or "deauthenticated" in log.read_text(), "no"
    )
    wrong.terminate()
    wrong.wait()
    report["after a wrong password"] = kernel.count("joined")
    right = station("12345678")
    await until(lambda: kernel.count("joined") and access_point.count("joined") > 0, "joined")
    point.kill()
    point.wait()
    report["killed"] = True
    # A station that is back before the new socket is asked has never been away: it waits for that.
    right.terminate()
    right.wait()
    point = hostapd()
    await until(lambda: min(kernel.count("left"), access_point.count("left")) > 0, "hostapd's death noticed")
    right = station("12345678")
    await until(lambda: kernel.count("joined") >= 2 and access_point.count("joined") >= 2, "joined again")
    right.terminate()
    right.wait()
    await until(lambda: kernel.count("left") >= 2 and access_point.count("left") >= 2, "left")
    point.terminate()
    point.wait()


async def main() -> dict[str, Any]:
    """Tell the story and report it."""
    kernel = Watch(Nl80211Source(["wlan0"]))
    access_point = Watch(HostapdSource(Path("/run/hostapd/wlan0"), interface="wlan0"))
    report: dict[str, Any] = {}
    tasks = [asyncio.create_task(kernel.run()), asyncio.create_task(access_point.run())]
    try:
        await story(kernel, access_point, report)
    except TimeoutError as error:
        report["stuck"] = str(error)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    report |= {"nl80211": kernel.events, "hostapd": access_point.events}
    report["counters"] = dict(kernel.source.health.counters)
    return report


Path("/shared/report.json").write_text(json.dumps(asyncio.run(main()), indent=1))
