"""Cameras, Kinects and serial ports in a hub's /sys and /dev."""

from __future__ import annotations

import errno
from pathlib import Path

from hub_tree import add_camera, add_usb, link, put

from vad.camera.v4l2_formats import QUERYCAP
from vad.setup.draft import camera_choice, kinect_choice
from vad.setup.usb import Kinect, find_cameras, find_kinects, find_ports


def webcam(_fd: int, request: int, data: bytearray) -> int:
    """One format, one size, 10 pictures a second."""
    index = int.from_bytes(data[0:4], "little")
    if request == QUERYCAP:
        data[16:27] = b"HD Webcam\0\0"
        data[84:92] = b"\1\0\0\x80\1\0\0\0"
        return 0
    if index:
        raise OSError(errno.EINVAL, "no more")
    match request & 0xFF:
        case 2:
            data[44:48] = b"YUYV"
        case 74:
            data[8:20] = b"\1\0\0\0\x20\3\0\0\x58\2\0\0"
        case 75:
            data[16:28] = b"\1\0\0\0\1\0\0\0\x0a\0\0\0"
    return 0


def test_cameras_come_in_their_order_with_lasting_names(tmp_path: Path) -> None:
    add_camera(tmp_path, 10, "Late")
    add_camera(tmp_path, 2, "USB Camera", "usb-Acme_HD-video-index0")
    found = find_cameras(tmp_path, webcam)
    assert [camera.device for camera in found] == ["/dev/v4l/by-id/usb-Acme_HD-video-index0", "/dev/video10"]
    assert found[0].name == "HD Webcam"
    assert camera_choice(found[0]) == {
        "type": "v4l2",
        "device": "/dev/v4l/by-id/usb-Acme_HD-video-index0",
        "width_px": 800,
        "height_px": 600,
        "fps": 10.0,
        "format": "YUYV",
    }


def test_a_camera_that_cannot_be_opened_is_shown_with_the_reason(tmp_path: Path) -> None:
    add_camera(tmp_path, 0, "Gone")
    (tmp_path / "dev/video0").unlink()
    (camera,) = find_cameras(tmp_path, webcam)
    assert (camera.name, camera.formats) == ("Gone", ())
    assert "No such file" in camera.trouble


def test_a_kinect_is_told_by_its_ids_and_its_port(tmp_path: Path) -> None:
    add_usb(tmp_path, "2-1", "045e", "02c4", "012345678901", "5000")
    add_usb(tmp_path, "1-1", "045e", "02d8", "", "480")
    add_usb(tmp_path, "1-2", "045e", "0800", "keyboard", "12")
    assert find_kinects(tmp_path) == [Kinect("", slow=True), Kinect("012345678901")]
    assert kinect_choice(Kinect("012345678901"), several=True)["serial"] == "012345678901"
    assert kinect_choice(Kinect("012345678901"), several=False) == {"type": "kinect2"}


def test_serial_ports_have_their_lasting_names_once(tmp_path: Path) -> None:
    put(tmp_path / "dev/ttyACM0", "")
    put(tmp_path / "dev/ttyUSB3", "")
    link(tmp_path / "dev/serial/by-id/usb-Neato_Robotics_USB_1-if00", "../../ttyACM0")
    found = find_ports(tmp_path)
    assert [port.path for port in found] == [
        "/dev/serial/by-id/usb-Neato_Robotics_USB_1-if00",
        "/dev/ttyUSB3",
    ]
    assert [port.says_neato for port in found] == [True, False]


def test_nothing_is_found_where_nothing_is(tmp_path: Path) -> None:
    assert find_cameras(tmp_path) == []
    assert find_kinects(tmp_path) == []
    assert find_ports(tmp_path) == []
