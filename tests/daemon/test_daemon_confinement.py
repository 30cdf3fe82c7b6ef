"""The drop-in from the settings: hosts, devices and the capability that they need, and no more."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from daemon_world import settings_for

from vad.config import agent_settings
from vad.daemon.confinement import DROP_IN, agent_drop_in, hub_drop_in, is_stale

HOME = "10.0.0.0/8 172.16.0.0/12 192.168.0.0/16 fc00::/7 link-local"


def lines(tmp_path: Path, **sections: Any) -> list[str]:
    return hub_drop_in(settings_for(tmp_path, **sections)).splitlines()


def allowed(tmp_path: Path, **sections: Any) -> str:
    (line,) = [x for x in lines(tmp_path, **sections) if x.startswith("IPAddressAllow=") and x[15:]]
    return line.removeprefix("IPAddressAllow=")


def devices(tmp_path: Path, **sections: Any) -> list[str]:
    found = [
        x.removeprefix("DeviceAllow=") for x in lines(tmp_path, **sections) if x.startswith("DeviceAllow")
    ]
    assert found[0] == "", "what the unit allows is taken back first"
    return found[1:]


def test_who_names_nobody_reaches_nobody(tmp_path: Path) -> None:
    assert "IPAddressDeny=any" in lines(tmp_path)
    assert allowed(tmp_path) == "localhost"


@pytest.mark.parametrize(
    ("sections", "hosts"),
    [
        ({"camera": {"source": {"type": "rtsp", "url": "rtsp://u:p@192.168.1.9:554/s"}}}, "192.168.1.9"),
        ({"robot": {"type": "neato", "port": "socket://192.168.1.40:3333"}}, "192.168.1.40"),
        ({"robot": {"type": "ros2", "endpoint": "tcp/192.168.1.20:7447"}}, "192.168.1.20"),
        ({"robot": {"type": "valetudo", "url": "http://[fd00::5]/"}}, "fd00::5"),
        ({"robot": {"type": "valetudo", "url": "http://robot.lan"}}, HOME),
        ({"bus": {"connect": ["tcp/203.0.113.7:7447"]}}, "203.0.113.7"),
        ({"bus": {"listen": ["tcp/127.0.0.1:7447", "tls/0.0.0.0:7448"]}}, HOME),
        ({"mqtt": {"host": "192.168.1.5"}}, "192.168.1.5"),
        ({"devices": {"static": [{"mac": "f4:f5:d8:00:00:01", "ip": "192.168.1.7"}]}}, HOME),
    ],
)
def test_what_is_named_is_reached(tmp_path: Path, sections: dict[str, Any], hosts: str) -> None:
    assert allowed(tmp_path, **sections) == f"localhost {hosts}"


def test_an_address_outside_the_home_comes_beside_it(tmp_path: Path) -> None:
    robot = {"type": "ros2", "endpoint": "tcp/robot.lan:7447"}
    assert allowed(tmp_path, robot=robot, bus={"connect": ["tcp/203.0.113.7:7447", "tcp/10.1.1.1:7447"]}) == (
        f"localhost {HOME} 203.0.113.7"
    )


@pytest.mark.parametrize(
    ("sections", "expected"),
    [
        ({}, []),
        ({"robot": {"type": "neato", "port": "/dev/ttyACM0"}}, ["char-ttyACM rw"]),
        ({"robot": {"type": "roomba", "port": "/dev/ttyUSB1"}}, ["char-ttyUSB rw"]),
        (
            {"robot": {"type": "neato", "port": "/dev/serial/by-id/usb-Neato"}},
            ["char-ttyACM rw", "char-ttyUSB rw"],
        ),
        ({"robot": {"type": "serial-json", "port": "/dev/ttyS0"}}, ["/dev/ttyS0 rw"]),
        ({"camera": {"source": {"type": "v4l2", "device": "/dev/video0"}}}, ["char-video4linux rw"]),
        ({"camera": {"source": {"type": "kinect2"}}}, ["char-usb_device rw"]),
    ],
)
def test_only_named_devices_open(tmp_path: Path, sections: dict[str, Any], expected: list[str]) -> None:
    assert devices(tmp_path, **sections) == expected


def test_the_capability_is_for_the_connector_alone(tmp_path: Path) -> None:
    follow = lines(tmp_path, radio={"source": {"type": "follow", "path": "x"}})
    assert {"AmbientCapabilities=", "CapabilityBoundingSet="} <= set(follow)
    assert not any("Capabilit" in line for line in lines(tmp_path, radio={"source": {"type": "connector"}}))


def test_an_agent_reaches_its_hub(tmp_path: Path) -> None:
    plain = {"hub": "tls/192.168.1.10:7448", "id": "attic"}
    text = agent_drop_in(agent_settings(plain, where="agent.yaml"))
    assert "IPAddressAllow=localhost 192.168.1.10\n" in text
    assert "Capabilit" not in text


def test_a_drop_in_of_other_settings_is_stale(tmp_path: Path) -> None:
    settings = settings_for(tmp_path)
    assert not is_stale(settings, tmp_path), "there is none: the unit's own limits hold"
    (tmp_path / DROP_IN).write_text(hub_drop_in(settings))
    assert not is_stale(settings, tmp_path)
    assert is_stale(settings_for(tmp_path, mqtt={"host": "192.168.1.5"}), tmp_path)
