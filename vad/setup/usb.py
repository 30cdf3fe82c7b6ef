"""Cameras and serial ports that are plugged in, from /sys and /dev below a root folder."""

from __future__ import annotations

import fcntl
from dataclasses import dataclass, field
from pathlib import Path

from vad.camera.kinect2 import PRODUCTS, VENDOR
from vad.camera.v4l2_formats import Format, Ioctl, describe
from vad.errors import SourceError

USB3_MBIT_PER_S = 5000


@dataclass(frozen=True, slots=True)
class Camera:
    """A V4L2 camera. device: the path for the settings, by id where it has one; trouble: why it is no use."""

    device: str
    name: str
    formats: tuple[Format, ...] = ()
    trouble: str = ""


@dataclass(frozen=True, slots=True)
class Kinect:
    """A Kinect v2 on USB. serial: empty where it does not tell; slow: not on a USB 3 port."""

    serial: str
    slow: bool = False


@dataclass(frozen=True, slots=True)
class Port:
    """A serial port. path: for the settings; open_path: the same below the root folder."""

    path: str
    open_path: Path = field(compare=False)

    @property
    def says_neato(self) -> bool:
        """Whether the USB adapter calls itself a Neato."""
        return "neato" in self.path.lower()


def find_cameras(root: Path, ioctl: Ioctl = fcntl.ioctl) -> list[Camera]:
    """All V4L2 capture devices, in the order of their numbers."""
    names = {link.resolve().name: link for link in sorted((root / "dev/v4l/by-id").glob("*"), reverse=True)}
    cameras = []
    nodes = sorted(
        (root / "sys/class/video4linux").glob("video*"), key=lambda node: (len(node.name), node.name)
    )
    for node in nodes:
        link = names.get(node.name)
        device = f"/dev/v4l/by-id/{link.name}" if link else f"/dev/{node.name}"
        name = text_of(node / "name") or node.name
        try:
            description = describe(root / "dev" / node.name, ioctl)
        except SourceError as error:
            cameras.append(Camera(device, name, trouble=f"{error.what}. {error.remedy}".rstrip(". ")))
            continue
        if description is not None:
            cameras.append(Camera(device, description.card or name, description.formats))
    return cameras


def find_kinects(root: Path) -> list[Kinect]:
    """All Kinect v2 sensors."""
    found = []
    for device in sorted((root / "sys/bus/usb/devices").glob("*")):
        ids = text_of(device / "idVendor"), text_of(device / "idProduct")
        if ids[0] == f"{VENDOR:04x}" and ids[1] in {f"{product:04x}" for product in PRODUCTS}:
            speed = text_of(device / "speed")
            slow = speed.isdecimal() and int(speed) < USB3_MBIT_PER_S
            found.append(Kinect(text_of(device / "serial"), slow))
    return found


def find_ports(root: Path) -> list[Port]:
    """All serial ports of USB, by id where they have one."""
    ports, named = [], set()
    for link in sorted((root / "dev/serial/by-id").glob("*")):
        named.add(link.resolve().name)
        ports.append(Port(f"/dev/serial/by-id/{link.name}", link))
    for pattern in ("ttyACM*", "ttyUSB*"):
        for path in sorted((root / "dev").glob(pattern)):
            if path.name not in named:
                ports.append(Port(f"/dev/{path.name}", path))
    return ports


def text_of(path: Path) -> str:
    """What a file of /sys says; empty where there is none."""
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
