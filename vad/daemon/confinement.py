"""What the settings need of the machine, as a drop-in for systemd: hosts, devices, capability.

The unit as shipped lets the daemon reach the home's own network and every kind of device it knows. The
drop-in that `vad install` writes beside it narrows that to what the settings name.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

from vad.bus.session import tls_endpoints
from vad.config import (
    AgentSettings,
    ConnectorCsi,
    Kinect2CameraSettings,
    LineRobot,
    MjpegCameraSettings,
    NeatoRobot,
    RoombaRobot,
    Ros2Robot,
    RtspCameraSettings,
    Settings,
    V4l2CameraSettings,
    ValetudoRobot,
)

HOME = ("10.0.0.0/8", "172.16.0.0/12", "192.168.0.0/16", "fc00::/7", "link-local")
"""The home's own network, whichever it is."""
DROP_IN = "10-settings.conf"
HEAD = (
    "# Written by `vad install` from the settings: what they do not name is out of reach.\n"
    "# After a change of hosts, ports or devices there: sudo vad install\n"
)

_URL = re.compile(r"^[a-z][a-z0-9+.-]*://", re.IGNORECASE)


def hub_drop_in(settings: Settings) -> str:
    """The drop-in of vad.service."""
    lines = ["[Service]", *_network(_hub_hosts(settings), home=_talks_to_devices(settings))]
    lines += ["DeviceAllow=", *(f"DeviceAllow={device} rw" for device in _devices(settings))]
    if not isinstance(settings.radio.source, ConnectorCsi):
        lines += ["# No connector: no capability.", "AmbientCapabilities=", "CapabilityBoundingSet="]
    return HEAD + "\n".join(lines) + "\n"


def agent_drop_in(settings: AgentSettings) -> str:
    """The drop-in of vad-agent.service."""
    lines = ["[Service]", *_network([_host(settings.hub)], home=False)]
    if not isinstance(settings.source, ConnectorCsi):
        lines += ["# No connector: no capability.", "AmbientCapabilities=", "CapabilityBoundingSet="]
    return HEAD + "\n".join(lines) + "\n"


def is_stale(settings: Settings, folder: Path) -> bool:
    """Whether the drop-in in `folder` (vad.service.d) is of other settings; False where there is none."""
    try:
        return (folder / DROP_IN).read_text(encoding="utf-8") != hub_drop_in(settings)
    except OSError:
        return False


def _network(hosts: list[str], *, home: bool) -> Iterator[str]:
    """IPAddressAllow for these hosts. A name may move about in the home: it opens the home's network."""
    allowed = set()
    for host in hosts:
        try:
            allowed.add(str(ipaddress.ip_address(host)))
        except ValueError:
            home = home or host != "localhost"
    yield "IPAddressDeny=any"
    yield "IPAddressAllow="
    own = HOME if home else ()
    inside = [ipaddress.ip_network(net) for net in own if "/" in net]
    extra = sorted(
        host
        for host in allowed
        if not ipaddress.ip_address(host).is_loopback
        and not any(ipaddress.ip_address(host) in net for net in inside)
    )
    yield f"IPAddressAllow={' '.join(('localhost', *own, *extra))}"


def _hub_hosts(settings: Settings) -> list[str]:
    """Every host the settings name."""
    robot, source = settings.robot, settings.camera.source
    named = [*settings.bus.connect]
    if isinstance(robot, NeatoRobot | RoombaRobot | LineRobot) and _URL.match(robot.port):
        named.append(robot.port)
    if isinstance(robot, Ros2Robot) and robot.endpoint:
        named.append(robot.endpoint)
    if isinstance(robot, ValetudoRobot) and robot.url:
        named.append(robot.url)
    if isinstance(source, MjpegCameraSettings | RtspCameraSettings):
        named.append(source.url)
    if settings.mqtt.host:
        named.append(f"mqtt://{settings.mqtt.host}")
    return [host for text in named if (host := _host(text))]


def _talks_to_devices(settings: Settings) -> bool:
    """Whether the home's network as a whole is needed: for who connects from there, and echoes to devices."""
    echoes = settings.radio.traffic_packets_per_s > 0 and (
        bool(settings.devices.leases) or any(device.ip for device in settings.devices.static)
    )
    elsewhere = settings.web.port is not None and settings.web.address not in ("127.0.0.1", "::1")
    return echoes or elsewhere or bool(tls_endpoints(settings.bus.listen))


def _devices(settings: Settings) -> list[str]:
    robot, source = settings.robot, settings.camera.source
    devices = []
    if isinstance(source, V4l2CameraSettings):
        devices.append("char-video4linux")
    if isinstance(source, Kinect2CameraSettings):
        devices.append("char-usb_device")
    if isinstance(robot, NeatoRobot | RoombaRobot | LineRobot) and not _URL.match(robot.port):
        kinds = ["char-ttyACM", "char-ttyUSB"]
        # A by-id name does not tell which; another port (ttyS0, ttyAMA0) is named as it is.
        told = [kind for kind in kinds if kind.removeprefix("char-") in robot.port]
        by_id = robot.port.startswith(("/dev/serial/", "/dev/neato"))
        named = [robot.port] if robot.port.startswith("/dev/") else []
        devices += told or (kinds if by_id else named)
    return devices


def _host(text: str) -> str:
    """The host of a URL, or of a zenoh endpoint such as tcp/192.168.1.20:7447; empty where there is none."""
    if not _URL.match(text):
        protocol, slash, rest = text.partition("/")
        text = f"{protocol}://{rest}" if slash else text
    try:
        return urlsplit(text).hostname or ""
    except ValueError:
        return ""
