"""The hub's Wi-Fi: access points, cards, lease files, from /sys, /run and hostapd below a root folder."""

from __future__ import annotations

import contextlib
import secrets
import socket
import stat
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from vad.devices import nl80211
from vad.devices.nl80211_source import open_netlink
from vad.errors import ProtocolError
from vad.setup.usb import text_of

INTEL, CSI_CARDS = "0x8086", ("0x4235", "0x4236")
_LEASES = (
    "var/lib/misc/dnsmasq.leases",
    "var/lib/dnsmasq/dnsmasq.leases",
    "tmp/dhcp.leases",
    "var/lib/NetworkManager/dnsmasq-*.leases",
)
_ANSWER_S = 1.0
_DATAGRAM_BYTES = 65_536


@dataclass(frozen=True, slots=True)
class AccessPoint:
    """An interface of hostapd. socket: its control socket; frequency_mhz: of its channel, 0 where not told;
    trouble: why it could not be asked."""

    socket: str
    ssid: str = ""
    frequency_mhz: int = 0
    bandwidth_mhz: int = 20
    stations: int = 0
    trouble: str = ""


@dataclass(frozen=True, slots=True)
class Wireless:
    """A wireless interface. csi_card: an Intel 5300."""

    name: str
    driver: str
    csi_card: bool
    access_point: bool = False


@dataclass(frozen=True, slots=True)
class CsiCard:
    """Whether there is an Intel 5300, and whether the driver of the CSI Tool runs it."""

    present: bool
    csi_driver: bool


NO_CARD = CsiCard(False, False)


def find_access_points(root: Path) -> list[AccessPoint]:
    """All of hostapd's control sockets, each asked for its channel."""
    found = []
    for path in sorted((root / "run/hostapd").glob("*")):
        with contextlib.suppress(OSError):
            if stat.S_ISSOCK(path.stat().st_mode):
                found.append(_asked(path, f"/run/hostapd/{path.name}"))
    return found


def _asked(path: Path, shown: str) -> AccessPoint:
    try:
        reply = _ask(path, b"STATUS")
    except OSError as error:
        why = "does not answer" if isinstance(error, TimeoutError) else error.strerror or str(error)
        return AccessPoint(shown, trouble=why)
    said = dict(line.split("=", 1) for line in reply.splitlines() if "=" in line)
    frequency, stations = said.get("freq", ""), said.get("num_sta[0]", "")
    return AccessPoint(
        shown,
        ssid=said.get("ssid[0]", ""),
        frequency_mhz=int(frequency) if frequency.isdecimal() else 0,
        bandwidth_mhz=40 if said.get("secondary_channel", "0") not in ("0", "") else 20,
        stations=int(stations) if stations.isdecimal() else 0,
    )


def _ask(path: Path, command: bytes) -> str:
    """hostapd's answer to one command."""
    own = Path(tempfile.gettempdir()) / f"vad-setup-{secrets.token_hex(6)}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.settimeout(_ANSWER_S)
        sock.bind(str(own))
        try:
            sock.connect(str(path))
            sock.send(command)
            return sock.recv(_DATAGRAM_BYTES).decode("utf-8", "replace")
        finally:
            own.unlink(missing_ok=True)


def find_wireless(root: Path, opened: Callable[[], socket.socket] = open_netlink) -> list[Wireless]:
    """All wireless interfaces, with what the kernel says of which are access points."""
    names = sorted(path.parent.name for path in (root / "sys/class/net").glob("*/phy80211"))
    serving = _access_points(opened) if names else set()
    found = []
    for name in names:
        device = root / "sys/class/net" / name / "device"
        card = text_of(device / "vendor") == INTEL and text_of(device / "device") in CSI_CARDS
        driver = (device / "driver").resolve().name if (device / "driver").exists() else ""
        found.append(Wireless(name, driver, card, name in serving))
    return found


def _access_points(opened: Callable[[], socket.socket]) -> set[str]:
    """Names of the interfaces in access point mode; none where the kernel has no Wi-Fi."""
    try:
        with opened() as sock:
            sock.settimeout(_ANSWER_S)
            family = None
            sock.send(nl80211.family_request(1))
            for message in nl80211.parse_datagram(sock.recv(_DATAGRAM_BYTES), None):
                family = message.id if isinstance(message, nl80211.Family) else family
            if family is None:
                return set()
            sock.send(nl80211.interfaces_request(family, 2))
            names: set[str] = set()
            while True:
                for message in nl80211.parse_datagram(sock.recv(_DATAGRAM_BYTES), family):
                    if isinstance(message, nl80211.Finished):
                        return names
                    if isinstance(message, nl80211.Interface) and message.access_point:
                        names.add(message.name)
    except (OSError, ProtocolError):
        return set()


def find_csi_card(root: Path) -> CsiCard:
    """Whether an Intel 5300 is plugged in, and whether its driver hands out CSI."""
    present = any(
        text_of(device / "vendor") == INTEL and text_of(device / "device") in CSI_CARDS
        for device in (root / "sys/bus/pci/devices").glob("*")
    )
    return CsiCard(present, (root / "sys/module/iwlwifi/parameters/connector_log").exists())


def find_leases(root: Path) -> list[str]:
    """dnsmasq's lease files."""
    found = (path for pattern in _LEASES for path in sorted(root.glob(pattern)))
    return [f"/{path.relative_to(root)}" for path in found if path.is_file()]
