"""In the guest: the service as systemd knows it, the daemon as its clients see it, the parts of the home."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from vad.bus.messages import CameraMessage, CaptureMessage, DeviceMessage, DeviceWish, Part, StatusMessage
from vad.client import VadClient
from vad.errors import VadError

HERE = Path(__file__).parent
POLL_S = 0.3


class StuckError(Exception):
    """Something never came."""


def say(words: str) -> None:
    """One line with the guest's seconds since boot."""
    sys.stdout.write(f"{time.monotonic():7.1f} s  {words}\n")
    sys.stdout.flush()


def sh(*command: str, check: bool = True) -> str:
    """Run a command; what it printed."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if check and done.returncode:
        raise StuckError(
            f"{' '.join(command)}: exit status {done.returncode}: {done.stdout}{done.stderr}"[-2000:]
        )
    return done.stdout.strip()


def until(condition: Callable[[], object], what: str, timeout_s: float) -> float:
    """Wait for a condition; how many seconds it took."""
    begun_s = time.monotonic()
    while not condition():
        if time.monotonic() - begun_s > timeout_s:
            raise StuckError(f"never came in {timeout_s:.0f} s: {what}")
        time.sleep(POLL_S)
    return round(time.monotonic() - begun_s, 1)


class Service:
    """vad.service."""

    def show(self, *names: str) -> dict[str, str]:
        """Properties of the unit."""
        lines = sh("systemctl", "show", "vad", *(f"-p{name}" for name in names)).splitlines()
        return dict(line.split("=", 1) for line in lines)

    @property
    def pid(self) -> int:
        """Of the daemon; 0 while there is none."""
        return int(self.show("MainPID")["MainPID"])

    @property
    def restarts(self) -> int:
        """How often systemd has started it again by itself."""
        return int(self.show("NRestarts")["NRestarts"])

    @property
    def active(self) -> bool:
        """Whether it has said that it is ready."""
        return self.show("ActiveState")["ActiveState"] == "active"

    def started_in_s(self) -> float:
        """From the start of the process to READY=1."""
        shown = self.show("ExecMainStartTimestampMonotonic", "ActiveEnterTimestampMonotonic")
        begun, ready = (
            int(v) for v in (shown["ExecMainStartTimestampMonotonic"], shown["ActiveEnterTimestampMonotonic"])
        )
        return round((ready - begun) / 1e6, 1)

    def journal(self, since_s: float = 0.0) -> list[str]:
        """What it wrote, and systemd about it, since so many seconds after boot."""
        out = sh("journalctl", "-b", "-u", "vad", "-o", "json", "--output-fields=MESSAGE", "--no-pager")
        rows = [json.loads(line) for line in out.splitlines()]
        return [str(row["MESSAGE"]) for row in rows if int(row["__MONOTONIC_TIMESTAMP"]) >= since_s * 1e6]


class Hub:
    """The daemon as a client on zenoh sees it. None and empty where it does not answer just now."""

    def __init__(self) -> None:
        self._client: VadClient | None = None
        self._said = ""

    def _ask(self, question: Callable[[VadClient], Any]) -> Any:
        try:
            if self._client is None:
                client = VadClient(timeout_s=20.0)
                client.open()
                self._client = client
            return question(self._client)
        except VadError as error:
            if str(error) != self._said:
                say(f"no answer: {error}")
            self._said = str(error)
            return None

    def status(self) -> StatusMessage | None:
        """The status."""
        found: StatusMessage | None = self._ask(VadClient.status)
        return found

    def part(self, name: str) -> Part | None:
        """One part of the status, by the beginning of its name."""
        status = self.status()
        return next((p for p in status.parts if p.part.startswith(name)), None) if status else None

    def is_in(self, name: str, *states: str) -> bool:
        """Whether the part is in one of these states."""
        part = self.part(name)
        return part is not None and part.state in states

    def camera(self) -> CameraMessage | None:
        """The one camera."""
        found: list[CameraMessage] | None = self._ask(VadClient.cameras)
        return found[0] if found else None

    def device(self, mac: str) -> DeviceMessage | None:
        """A device."""
        found: list[DeviceMessage] | None = self._ask(lambda client: client.devices(mac=[mac]))
        return found[0] if found else None

    def captures(self) -> list[CaptureMessage]:
        """The walks of this run of the daemon."""
        return self._ask(VadClient.captures) or []

    def wish(self, wish: DeviceWish) -> str | None:
        """What the daemon says to a wish; None where it cannot be kept now."""
        reply = self._ask(lambda client: client.wish(wish))
        return None if reply is None else str(reply.text)


class Home:
    """The processes of world.py."""

    def __init__(self) -> None:
        self._parts = {kind: self._start(kind) for kind in ("camera", "robot", "radio")}
        self.segments: dict[str, Any] = json.loads((HERE / "story.json").read_text())["segments"]
        for kind in self._parts:
            self._answer(kind)

    def _start(self, kind: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-B", str(HERE / "world.py"), kind, str(HERE)]
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def _answer(self, kind: str) -> None:
        out = self._parts[kind].stdout
        assert out is not None
        if not out.readline():
            raise StuckError(f"the emulated {kind} has ended")

    def _tell(self, kind: str, said: dict[str, Any]) -> None:
        into = self._parts[kind].stdin
        assert into is not None
        into.write(json.dumps(said) + "\n")
        into.flush()
        self._answer(kind)

    def do(self, kind: str, word: str) -> None:
        """plug, unplug; mute, speak."""
        self._tell(kind, {"do": word})

    def play(self, name: str, then: str, *, backwards: bool = False) -> float:
        """Begin a segment in all parts at one moment; how many seconds it will have lasted when it ends."""
        start_ns = time.monotonic_ns() + 1_000_000_000
        for kind in self._parts:
            self._tell(kind, {"play": name, "then": then, "t_ns": start_ns, "backwards": backwards})
        return (start_ns - time.monotonic_ns()) / 1e9 + float(self.segments[name]["seconds"])

    def end(self) -> None:
        """Stop all parts."""
        for process in self._parts.values():
            process.terminate()
            process.wait()


HOSTAPD = """interface=wlan0
driver=nl80211
ctrl_interface=/run/hostapd
ctrl_interface_group=netdev
ssid=home
hw_mode=g
channel=1
"""
STATION = 'network={\n ssid="home"\n key_mgmt=NONE\n scan_freq=2412\n}\n'


class Network:
    """A real access point and a real station on two radios of mac80211_hwsim; open, as CSI needs it."""

    def __init__(self, mac: str) -> None:
        self._logs = HERE / "hostapd.log"
        sh("modprobe", "mac80211_hwsim", "radios=2")
        sh("udevadm", "settle")
        sh("ip", "netns", "add", "station")
        phy = Path("/sys/class/net/wlan1/phy80211/name").read_text().strip()
        sh("iw", "phy", phy, "set", "netns", "name", "station")
        sh("ip", "-n", "station", "link", "set", "wlan1", "address", mac)
        Path("/tmp/hostapd.conf").write_text(HOSTAPD)
        Path("/tmp/station.conf").write_text(STATION)
        self._point: subprocess.Popen[bytes] | None = None
        self._station: subprocess.Popen[bytes] | None = None

    def start_point(self) -> None:
        """Start hostapd."""
        with self._logs.open("ab") as log:
            self._point = subprocess.Popen(["hostapd", "-t", "/tmp/hostapd.conf"], stdout=log, stderr=log)

    def kill_point(self) -> None:
        """kill -9 hostapd."""
        assert self._point is not None
        self._point.kill()
        self._point.wait()

    def join(self) -> None:
        """The station joins, and comes back by itself from then on."""
        command = [
            "ip",
            "netns",
            "exec",
            "station",
            "wpa_supplicant",
            "-t",
            "-i",
            "wlan1",
            "-c",
            "/tmp/station.conf",
        ]
        with self._logs.open("ab") as log:
            self._station = subprocess.Popen([*command, "-D", "nl80211"], stdout=log, stderr=log)

    def end(self) -> None:
        """Switch off both."""
        for process in (self._station, self._point):
            if process is not None:
                process.terminate()
                process.wait()
