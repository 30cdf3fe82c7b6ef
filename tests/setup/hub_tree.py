"""A hub's /sys, /dev and /run below a folder, as the finders see them."""

from __future__ import annotations

from pathlib import Path


def put(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text + "\n")


def link(path: Path, target: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.symlink_to(target)


def add_camera(root: Path, number: int, name: str, by_id: str = "") -> None:
    put(root / f"sys/class/video4linux/video{number}/name", name)
    put(root / f"dev/video{number}", "")
    if by_id:
        link(root / "dev/v4l/by-id" / by_id, f"../../video{number}")


def add_usb(root: Path, place: str, vendor: str, product: str, serial: str, speed: str) -> None:
    device = root / "sys/bus/usb/devices" / place
    for name, text in {"idVendor": vendor, "idProduct": product, "serial": serial, "speed": speed}.items():
        put(device / name, text)


def add_wireless(root: Path, name: str, vendor: str, device: str, driver: str) -> None:
    """An interface on a PCI card."""
    card = root / "sys/devices/pci0000:00" / f"0000:03:00.{len(name)}"
    put(card / "vendor", vendor)
    put(card / "device", device)
    (root / "sys/bus/pci/drivers" / driver).mkdir(parents=True, exist_ok=True)
    link(card / "driver", str(root / "sys/bus/pci/drivers" / driver))
    link(root / "sys/bus/pci/devices" / card.name, str(card))
    (card / "net" / name / "phy80211").mkdir(parents=True)
    link(card / "net" / name / "device", str(card))
    link(root / "sys/class/net" / name, str(card / "net" / name))
