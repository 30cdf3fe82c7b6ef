"""Every kind of camera in the settings becomes its adapter; mistakes are refused with their path."""

from __future__ import annotations

from pathlib import Path

import pytest

from vad.camera.http_stream import HttpStreamCamera
from vad.camera.kinect2_source import Kinect2Camera
from vad.camera.rtsp import RtspCamera
from vad.camera.v4l2 import V4l2Camera
from vad.config import parse_settings
from vad.daemon.adapters import camera_source
from vad.errors import ConfigError

REST = "map: {file: floor.yaml}\nrobot: {type: neato, port: a}\nradio: {}\ndevices: {}\n"


@pytest.mark.parametrize(
    ("source", "kind"),
    [
        ("{type: v4l2, device: /dev/video0, format: YUYV}", V4l2Camera),
        ("{type: mjpeg, url: 'http://camera/stream'}", HttpStreamCamera),
        ("{type: rtsp, url: 'rtsp://u:p@camera/live', transport: udp}", RtspCamera),
        ("{type: kinect2, fraction: 4, serial: '0123'}", Kinect2Camera),
    ],
)
def test_every_kind_becomes_its_adapter(source: str, kind: type) -> None:
    settings = parse_settings(f"{REST}camera: {{source: {source}}}", where="vad.yaml")
    assert isinstance(camera_source(settings.camera, Path()), kind)


@pytest.mark.parametrize(
    ("source", "path"),
    [
        ("{type: v4l2, device: /dev/video0, format: H264}", "format"),
        ("{type: kinect2, fraction: 3}", "fraction"),
        ("{type: rtsp, url: 'rtsp://camera', transport: http}", "transport"),
        ("{type: rtsp}", "source"),
    ],
)
def test_mistakes_are_refused_with_their_path(source: str, path: str) -> None:
    with pytest.raises(ConfigError, match=path):
        parse_settings(f"{REST}camera: {{source: {source}}}", where="vad.yaml")
