"""hostapd's sockets, the kernel's interfaces, the CSI card, lease files."""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hub_tree import add_wireless, put

from vad.setup import wifi
from vad.setup.draft import radio_choice
from vad.setup.wifi import (
    AccessPoint,
    CsiCard,
    Wireless,
    find_access_points,
    find_csi_card,
    find_leases,
    find_wireless,
)

STATUS = (
    "state=ENABLED\nphy=phy0\nfreq=5240\nnum_sta_non_erp[0]=0\nchannel=48\nsecondary_channel={second}\n"
    "ieee80211n=1\nbss[0]=wlan0\nssid[0]=home\nnum_sta[0]=7\n"
)


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Who answers here may be on a busy machine."""
    monkeypatch.setattr(wifi, "_ANSWER_S", 40.0)


@contextmanager
def hostapd(path: Path, status: str) -> Iterator[None]:
    """Answers one command after the other, as hostapd does."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.bind(str(path))

        def serve() -> None:
            while True:
                data, client = sock.recvfrom(4096)
                if data == b"END":
                    return
                sock.sendto(status.encode() if data == b"STATUS" else b"UNKNOWN COMMAND\n", client)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield
        finally:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ending:
                ending.connect(str(path))
                ending.send(b"END")
            thread.join()


def test_an_access_point_tells_its_channel(tmp_path: Path) -> None:
    with hostapd(tmp_path / "run/hostapd/wlan0", STATUS.format(second=1)):
        put(tmp_path / "run/hostapd/notes", "no socket")
        (found,) = find_access_points(tmp_path)
    assert found == AccessPoint("/run/hostapd/wlan0", "home", 5240, 40, 7)
    assert radio_choice(found) == {"carrier_hz": 5.24e9, "bandwidth_mhz": 40}


def test_without_a_second_channel_it_is_20_mhz(tmp_path: Path) -> None:
    with hostapd(tmp_path / "run/hostapd/wlan1", STATUS.format(second=0)):
        (found,) = find_access_points(tmp_path)
    assert radio_choice(found) == {"carrier_hz": 5.24e9}


def test_a_socket_that_nobody_serves_is_told(tmp_path: Path) -> None:
    path = tmp_path / "run/hostapd/wlan0"
    path.parent.mkdir(parents=True)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.bind(str(path))
    (found,) = find_access_points(tmp_path)
    assert found.trouble == "Connection refused"
    assert radio_choice(found) == {}


def attribute(kind: int, value: bytes) -> bytes:
    return struct.pack("=HH", 4 + len(value), kind) + value + bytes(-len(value) % 4)


def message(kind: int, command: int, body: bytes, seq: int) -> bytes:
    body = struct.pack("=BBH", command, 1, 0) + body
    return struct.pack("=IHHII", 16 + len(body), kind, 0, seq, 0) + body


@contextmanager
def kernel(interfaces: dict[str, int]) -> Iterator[socket.socket]:
    """Generic netlink over a socket pair; interfaces: name and type (3 is an access point)."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)

    def serve() -> None:
        with theirs:
            theirs.recv(4096)
            theirs.send(message(16, 1, attribute(1, struct.pack("=H", 30)) + attribute(2, b"nl80211\0"), 1))
            if not theirs.recv(4096):
                return
            for index, (name, kind) in enumerate(interfaces.items()):
                body = attribute(3, struct.pack("=I", index)) + attribute(4, name.encode() + b"\0")
                theirs.send(message(30, 7, body + attribute(5, struct.pack("=I", kind)), 2))
            theirs.send(struct.pack("=IHHIIi", 20, 3, 2, 2, 0, 0))

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield ours
    finally:
        thread.join()


def test_wireless_interfaces_with_card_driver_and_mode(tmp_path: Path) -> None:
    add_wireless(tmp_path, "wlan0", "0x8086", "0x4236", "iwlwifi")
    add_wireless(tmp_path, "wlp1s0", "0x168c", "0x003e", "ath10k_pci")
    with kernel({"wlan0": 3, "wlp1s0": 2}) as sock:
        found = find_wireless(tmp_path, lambda: sock)
    assert found == [
        Wireless("wlan0", "iwlwifi", csi_card=True, access_point=True),
        Wireless("wlp1s0", "ath10k_pci", csi_card=False, access_point=False),
    ]


def test_a_kernel_without_wifi_has_no_access_points(tmp_path: Path) -> None:
    assert find_wireless(tmp_path) == []
    add_wireless(tmp_path, "wlan0", "0x8086", "0x4235", "iwlwifi")

    def refused() -> socket.socket:
        raise OSError("no netlink")

    assert find_wireless(tmp_path, refused) == [Wireless("wlan0", "iwlwifi", csi_card=True)]


def test_the_csi_card_and_its_driver(tmp_path: Path) -> None:
    assert find_csi_card(tmp_path) == CsiCard(present=False, csi_driver=False)
    add_wireless(tmp_path, "wlan0", "0x8086", "0x4236", "iwlwifi")
    assert find_csi_card(tmp_path) == CsiCard(present=True, csi_driver=False)
    put(tmp_path / "sys/module/iwlwifi/parameters/connector_log", "1")
    assert find_csi_card(tmp_path) == CsiCard(present=True, csi_driver=True)


def test_lease_files(tmp_path: Path) -> None:
    put(tmp_path / "tmp/dhcp.leases", "")
    put(tmp_path / "var/lib/NetworkManager/dnsmasq-wlan0.leases", "")
    assert find_leases(tmp_path) == ["/tmp/dhcp.leases", "/var/lib/NetworkManager/dnsmasq-wlan0.leases"]
