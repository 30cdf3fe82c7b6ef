"""Settings on their way: what was chosen, and what is still missing on this hub."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from vad.camera.v4l2_formats import best_format
from vad.config import Settings, V4l2CameraSettings, parse_settings
from vad.config.documents import HOW_TO_READ
from vad.config.reference import settings_file
from vad.errors import ConfigError
from vad.setup.surroundings import Surroundings
from vad.setup.usb import Camera, Kinect
from vad.setup.wifi import AccessPoint

ZENOH_PORT = 7447
NO_PORT = "/dev/serial/by-id/FILL-IN"
NO_CAMERA = "/dev/video0"
_WRITE_REMEDY = "Run it with sudo, or write elsewhere with --config vad.yaml"
GROUP = "vad"
"""The daemon's group, where there is one: settings may hold the robot's password."""


@dataclass(slots=True)
class Draft:
    """Plain values as in YAML, and sentences about what is missing."""

    chosen: dict[str, Any]
    missing: list[str] = field(default_factory=list)

    def text(self) -> str:
        """The file; ConfigError where it could not be used."""
        head = [
            "vad, the Visual Assistant daemon: written by `vad setup`, with every setting of what was chosen."
        ]
        head.append("Other robots, cameras and CSI sources: vad config reference")
        head.append(HOW_TO_READ)
        head += [f"MISSING: {sentence}" for sentence in self.missing]
        text = settings_file(Settings, self.chosen, head="\n".join(head), alternatives=False)
        parse_settings(text, where="the new settings")
        return text


def camera_choice(camera: Camera) -> dict[str, Any]:
    """The settings of a V4L2 camera; what it is asked for is what it offers."""
    source: dict[str, Any] = {"type": "v4l2", "device": camera.device}
    best = best_format(camera.formats)
    if best is not None:
        fast = [fps for fps in best.fps if fps >= V4l2CameraSettings(device="").fps * 0.9]
        fps = min(fast) if fast else max(best.fps, default=V4l2CameraSettings(device="").fps)
        wanted: dict[str, Any] = {
            "width_px": best.width_px,
            "height_px": best.height_px,
            "fps": round(fps, 3),
        }
        wanted["format"] = best.fourcc
        defaults = V4l2CameraSettings(device="")
        source |= {key: value for key, value in wanted.items() if value != getattr(defaults, key)}
    return source


def kinect_choice(kinect: Kinect, several: bool) -> dict[str, Any]:
    """The settings of a Kinect; which one only matters where there are several."""
    return {"type": "kinect2", **({"serial": kinect.serial} if several and kinect.serial else {})}


def radio_choice(access_point: AccessPoint) -> dict[str, Any]:
    """What an access point says of its channel, where it is not the default."""
    chosen: dict[str, Any] = {}
    if access_point.frequency_mhz:
        chosen["carrier_hz"] = access_point.frequency_mhz * 1e6
    if access_point.bandwidth_mhz != 20:
        chosen["bandwidth_mhz"] = access_point.bandwidth_mhz
    return chosen


def channel_hz(channel: int) -> float:
    """The centre of a 20 MHz Wi-Fi channel; ConfigError where there is no such channel."""
    if 1 <= channel <= 13:
        return 2.407e9 + channel * 5e6
    if 36 <= channel <= 177:
        return 5e9 + channel * 5e6
    raise ConfigError(f"there is no Wi-Fi channel {channel}", remedy="1 to 13, or 36 to 177")


def csi_card_missing(found: Surroundings) -> list[str]:
    """What is missing of the card that hears CSI."""
    if not found.csi_card.present:
        return [
            "there is no Intel 5300 in this machine: nothing can be measured here. Put one in, or use "
            "another machine that has one (vad agent --help)"
        ]
    if not found.csi_card.csi_driver:
        return [
            "the Intel 5300 is there, its driver is not the CSI Tool's (no connector_log): see "
            "https://dhalperi.github.io/linux-80211n-csitool"
        ]
    return []


def robot_url(typed: str) -> str:
    """What somebody types for a Valetudo robot, as a URL."""
    typed = typed.strip().rstrip("/")
    return typed if "://" in typed else f"http://{typed}"


def router_endpoint(typed: str) -> str:
    """What somebody types for a zenoh router, as an endpoint; ConfigError where it has no host."""
    typed = typed.strip()
    kind, slash, rest = typed.rpartition("/")
    host = urlsplit(f"//{rest}").hostname
    if not host:
        raise ConfigError(
            f"{typed!r} is no address", remedy="Give it as 192.168.1.20 or tcp/192.168.1.20:7447"
        )
    has_port = rest.rpartition("]")[2].count(":") == 1
    return f"{kind or 'tcp'}{slash or '/'}{rest}" + ("" if has_port else f":{ZENOH_PORT}")


def check_writable(path: Path) -> None:
    """ConfigError where the file could not be written: better said before the questions than after."""
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ConfigError("may not be written", where=str(path), remedy=_WRITE_REMEDY)


def write_settings(text: str, path: Path, now: datetime) -> Path | None:
    """Write the file in one go; the backup's path where there was one before.

    Raises:
        ConfigError: it cannot be written.
    """
    backup = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            backup = path.with_name(f"{path.name}.{now:%Y%m%d-%H%M%S}")
            shutil.copy2(path, backup)
        fresh = path.with_name(f".{path.name}.new")
        descriptor = os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(text)
            os.fsync(file.fileno())
        _give(fresh, path)
        fresh.replace(path)
    except OSError as error:
        what = f"cannot be written ({error.strerror})"
        raise ConfigError(what, where=str(path), remedy=_WRITE_REMEDY) from error
    return backup


def _give(fresh: Path, path: Path) -> None:
    """Rights as before; of a new file, the daemon may read it and, with that, nobody else."""
    if path.exists():
        before = path.stat()
        fresh.chmod(before.st_mode & 0o777)
        if os.geteuid() == 0:
            os.chown(fresh, before.st_uid, before.st_gid)
        return
    try:
        shutil.chown(fresh, group=GROUP)
        fresh.chmod(0o640)
    except (LookupError, PermissionError):
        fresh.chmod(0o644)
