"""A network without a radio: real hostapd (driver=wired, 802.1X), real dnsmasq, a real supplicant, over veth.

Each cable has its end for the hub in one network namespace and its end for the station in another one. Needs
root and the Debian packages in PACKAGES.
"""

from __future__ import annotations

import os
import secrets
import shutil
import signal
import subprocess
from pathlib import Path
from typing import Self

from waiting import wait_until

PACKAGES = "hostapd wpasupplicant dnsmasq-base iproute2 busybox-static"
_TOOLS = ("hostapd", "wpa_supplicant", "wpa_cli", "dnsmasq", "ip", "busybox")
_PATH = "/usr/sbin:/sbin:/usr/bin:/bin"

_HOSTAPD = """interface={wire}
driver=wired
ctrl_interface={folder}/hostapd
ieee8021x=1
eap_server=1
eap_user_file={folder}/users
eap_reauth_period=0
use_pae_group_addr=1
"""
_SUPPLICANT = """ctrl_interface={folder}/supplicant
ap_scan=0
network={{
 key_mgmt=IEEE8021X
 eap=MD5
 identity="phone"
 password="secret"
 eapol_flags=0
}}
"""
_ON_LEASE = '#!/bin/sh\n[ "$1" = bound ] && ip addr replace $ip/24 dev $interface\nexit 0\n'


def why_not() -> str:
    """Why there can be no such network here; empty where there can."""
    if os.geteuid() != 0:
        return "making network namespaces needs root"
    missing = [tool for tool in _TOOLS if shutil.which(tool, path=_PATH) is None]
    if missing:
        return f"no {', '.join(missing)}: apt-get install {PACKAGES}"
    if _run("busybox", "udhcpc", "--help").returncode == 127:
        return "this busybox has no udhcpc: apt-get install busybox-static"
    probe = f"vad-probe-{secrets.token_hex(4)}"
    if _run("ip", "netns", "add", probe).returncode != 0:
        return "network namespaces cannot be made here"
    _run("ip", "netns", "del", probe)
    return ""


def _run(*command: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PATH": _PATH}
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment)


def _do(*command: str) -> str:
    done = _run(*command)
    assert done.returncode == 0, f"{' '.join(command)}: {done.stdout}{done.stderr}"
    return done.stdout


class RealNetwork:
    """`wires` cables with a station each; everything of it is gone when it is left."""

    def __init__(self, folder: Path, wires: int = 2) -> None:
        self.folder = folder
        self.leases = folder / "leases"
        name = secrets.token_hex(4)  # of its own: what a killed run left does not stand in the way
        self._hub, self._home = f"vadhub{name}", f"vadsta{name}"
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._wires = range(wires)

    def __enter__(self) -> Self:
        (self.folder / "users").write_text('"phone" MD5 "secret"\n')
        (self.folder / "on_lease").write_text(_ON_LEASE)
        (self.folder / "on_lease").chmod(0o755)
        try:
            for name in (self._hub, self._home):
                _do("ip", "netns", "add", name)
            _do("ip", "-n", self._hub, "link", "set", "lo", "up")
            for wire in self._wires:
                ends = ("link", "add", f"v{wire}", "netns", self._hub, "type", "veth")
                _do("ip", *ends, "peer", "name", f"s{wire}", "netns", self._home)
                _do("ip", "-n", self._hub, "addr", "add", f"192.168.{80 + wire}.1/24", "dev", f"v{wire}")
                for namespace, end in ((self._hub, f"v{wire}"), (self._home, f"s{wire}")):
                    _do("ip", "-n", namespace, "link", "set", end, "up")
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for name in list(self._processes):
            self.stop(name)
        for name in (self._hub, self._home):
            _run("ip", "netns", "del", name)

    def socket(self, wire: int) -> Path:
        """hostapd's control socket."""
        return self.folder / "hostapd" / f"v{wire}"

    def start_hostapd(self, wire: int) -> None:
        """Start hostapd on one cable and wait until it listens."""
        config = self.folder / f"hostapd{wire}.conf"
        config.write_text(_HOSTAPD.format(wire=f"v{wire}", folder=self.folder))
        self.socket(wire).unlink(missing_ok=True)
        self._start(f"hostapd{wire}", self._hub, "hostapd", "-t", str(config))
        wait_until(self.socket(wire).exists, "hostapd's control socket")

    def start_dnsmasq(self) -> None:
        """Start dnsmasq for all cables."""
        ranges = [f"--dhcp-range=192.168.{80 + wire}.10,192.168.{80 + wire}.90,1h" for wire in self._wires]
        # hostapd's wired driver listens to the DHCP port, too
        ranges += ["--bind-interfaces", *(f"--interface=v{wire}" for wire in self._wires)]
        options = ("--user=root", "--conf-file=/dev/null", "--port=0", "--no-ping", "--dhcp-authoritative")
        files = (f"--dhcp-leasefile={self.leases}", f"--pid-file={self.folder}/dnsmasq.pid")
        self._start("dnsmasq", self._hub, "dnsmasq", "-k", *options, *files, *ranges)
        wait_until(self.leases.exists, "dnsmasq's lease file")

    def join(self, wire: int, mac: str) -> None:
        """A station with this address plugs in; it has joined some time after this returns."""
        self.leave(wire)
        _do("ip", "-n", self._home, "link", "set", f"s{wire}", "down")
        _do("ip", "-n", self._home, "link", "set", f"s{wire}", "address", mac, "up")
        # A hello that is lost while the cable comes up is said again after half a minute.
        wait_until(lambda: self._carries(wire), "the cable carries")
        config = self.folder / f"supplicant{wire}.conf"
        config.write_text(_SUPPLICANT.format(folder=self.folder))
        command = ("wpa_supplicant", "-t", "-i", f"s{wire}", "-D", "wired", "-c", str(config))
        self._start(f"station{wire}", self._home, *command)

    def _carries(self, wire: int) -> bool:
        ends = ((self._hub, f"v{wire}"), (self._home, f"s{wire}"))
        return all("state UP" in _do("ip", "-n", space, "link", "show", "dev", end) for space, end in ends)

    def leave(self, wire: int) -> None:
        """The station says goodbye and goes."""
        if f"station{wire}" in self._processes:
            self.logoff(wire)
            self.stop(f"station{wire}")

    def logoff(self, wire: int) -> None:
        """The station says goodbye."""
        _do("wpa_cli", "-p", f"{self.folder}/supplicant", "-i", f"s{wire}", "logoff")

    def logon(self, wire: int) -> None:
        """The station says hello again."""
        _do("wpa_cli", "-p", f"{self.folder}/supplicant", "-i", f"s{wire}", "logon")

    def ask_for_address(self, wire: int, host_name: str) -> None:
        """The station asks for an address, and has it when this returns."""
        script = str(self.folder / "on_lease")
        udhcpc = ("busybox", "udhcpc", "-i", f"s{wire}", "-n", "-q", "-t", "60", "-T", "1", "-s", script)
        _do("ip", "netns", "exec", self._home, *udhcpc, "-x", f"hostname:{host_name}")

    def answers(self, wire: int, ip: str) -> bool:
        """Whether the hub reaches this address by an ICMP echo."""
        command = ("ping", "-c", "1", "-W", "20", "-I", f"v{wire}", ip)
        return _run("ip", "netns", "exec", self._hub, "busybox", *command).returncode == 0

    def stop(self, name: str, number: signal.Signals = signal.SIGTERM) -> None:
        """End a process: `hostapd0`, `station1`, `dnsmasq` ..."""
        process = self._processes.pop(name)
        process.send_signal(number)
        try:
            process.wait(40.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def said(self) -> str:
        """What all programs have logged."""
        logs = sorted(self.folder.glob("*.log"))
        return "\n".join(f"== {log.name}\n{log.read_text()[-2000:]}" for log in logs)

    def _start(self, name: str, namespace: str, *command: str) -> None:
        with (self.folder / f"{name}.log").open("ab") as log:
            self._processes[name] = subprocess.Popen(
                ["ip", "netns", "exec", namespace, *command],
                stdout=log,
                stderr=log,
                stdin=subprocess.DEVNULL,
                env=os.environ | {"PATH": _PATH},
            )
