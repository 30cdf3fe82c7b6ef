"""Settings -> the adapters they name."""

from __future__ import annotations

from pathlib import Path

import zenoh

from vad.camera.folder import FolderCamera, Recording
from vad.camera.frame import CameraSource
from vad.camera.http_stream import HttpStreamCamera
from vad.camera.v4l2 import V4l2Camera, V4l2Settings
from vad.config import (
    CameraSettings,
    ConnectorCsi,
    DeviceSettings,
    FolderCameraSettings,
    MjpegCameraSettings,
    NeatoRobot,
    RadioSettings,
    Settings,
)
from vad.csi.connector import Connector
from vad.csi.follow import FollowLog
from vad.csi.packets import CsiSource
from vad.devices.hostapd_source import HostapdSource
from vad.devices.static_list import StaticList
from vad.devices.station import JoinSource
from vad.robot.neato_source import NeatoSource
from vad.robot.pose import PoseSource
from vad.robot.zenoh_source import ZenohPoseSource


def robot_source(settings: Settings, session: zenoh.Session) -> PoseSource:
    """The robot; `session` is the open zenoh session."""
    robot = settings.robot
    if isinstance(robot, NeatoRobot):
        return NeatoSource(robot.port, rate_hz=robot.rate_hz, epoch=settings.map.epoch)
    return ZenohPoseSource(session, robot.key, epoch=settings.map.epoch)


def camera_source(settings: CameraSettings, base: Path) -> CameraSource:
    """The camera; relative paths are taken from `base`."""
    source = settings.source
    if isinstance(source, MjpegCameraSettings):
        return HttpStreamCamera(source.url)
    if isinstance(source, FolderCameraSettings):
        return FolderCamera(Recording(base / source.path))
    return V4l2Camera(
        V4l2Settings(source.device, width_px=source.width_px, height_px=source.height_px, fps=source.fps)
    )


def csi_source(settings: RadioSettings, base: Path) -> CsiSource:
    """The CSI radio; relative paths are taken from `base`."""
    source = settings.source
    if isinstance(source, ConnectorCsi):
        return Connector(source.group, allow_user_space=source.allow_user_space)
    return FollowLog(base / source.path)


def join_sources(settings: DeviceSettings, base: Path) -> list[JoinSource]:
    """Everything that tells of stations."""
    sources: list[JoinSource] = [
        HostapdSource(base / path, interface=Path(path).name) for path in settings.hostapd
    ]
    if settings.static:
        sources.append(StaticList([device.mac for device in settings.static]))
    return sources
