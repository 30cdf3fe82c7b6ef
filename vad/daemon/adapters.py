"""Settings -> the adapters they name."""

from __future__ import annotations

import os
from pathlib import Path

import zenoh

from vad.agent.info import decode_info
from vad.bus.gate import Gate, GateSettings
from vad.bus.keys import HubKeys
from vad.bus.node import Bus
from vad.bus.session import local_endpoints, tls_endpoints
from vad.camera.folder import FolderCamera, Recording
from vad.camera.frame import CameraSource
from vad.camera.http_stream import HttpStreamCamera
from vad.camera.kinect2_source import Kinect2Camera
from vad.camera.rtsp import RtspCamera
from vad.camera.v4l2 import V4l2Camera, V4l2Settings
from vad.config import (
    CameraSettings,
    FolderCameraSettings,
    Kinect2CameraSettings,
    LineRobot,
    MjpegCameraSettings,
    NeatoRobot,
    RadioSettings,
    RoombaRobot,
    Ros2Robot,
    RtspCameraSettings,
    Settings,
    ValetudoRobot,
    VisionSettings,
    pki_folder,
)
from vad.csi.open_source import open_source
from vad.csi.packets import CsiSource
from vad.devices.agents import AgentSaid, AgentSource
from vad.devices.hostapd_source import HostapdSource
from vad.devices.lease_source import LeaseSource
from vad.devices.nl80211_source import Nl80211Source
from vad.devices.static_list import StaticList
from vad.devices.station import JoinSource
from vad.homeassistant.link import HomeAssistant
from vad.mac import mac_from_text
from vad.pki.folder import PkiFolder
from vad.robot.json_line_source import JsonLineSource
from vad.robot.neato_source import NeatoSource
from vad.robot.pose import PoseSource
from vad.robot.roomba_source import RoombaSource
from vad.robot.ros2 import Frames
from vad.robot.ros2_keys import Style
from vad.robot.ros2_source import Ros2Source, Ros2Topics
from vad.robot.valetudo_source import ValetudoSource
from vad.robot.zenoh_source import ZenohPoseSource
from vad.vision.robot import CandidateFinder, RobotFinder
from vad.vision.robot_detector import RobotDetector


def network_gate(settings: Settings, config_file: Path) -> Gate | None:
    """The way in from the network, where the settings listen there."""
    listen = tls_endpoints(settings.bus.listen)
    if not listen:
        return None
    daemon = local_endpoints(settings.bus.listen)[0]
    return Gate(GateSettings(settings.hub, listen, daemon), PkiFolder(pki_folder(settings, config_file)))


def home_assistant(settings: Settings, base: Path, state_dir: Path, bus: Bus) -> HomeAssistant | None:
    """Home Assistant's MQTT broker, where the settings name one; relative paths are taken from `base`."""
    if settings.mqtt.host is None:
        return None
    cache = state_dir / "matplotlib"
    return HomeAssistant(settings.mqtt, bus, base=base, cache=cache, camera=settings.camera.id)


def robot_source(settings: Settings, session: zenoh.Session) -> PoseSource:
    """The robot; `session` is the open zenoh session."""
    robot, epoch = settings.robot, settings.map.epoch
    if isinstance(robot, NeatoRobot):
        return NeatoSource(robot.port, rate_hz=robot.rate_hz, lidar=robot.lidar, epoch=epoch)
    if isinstance(robot, Ros2Robot):
        return Ros2Source(robot.endpoint or session, _topics(robot), epoch=epoch)
    if isinstance(robot, ValetudoRobot):
        if robot.url is not None:
            return ValetudoSource(robot.url, epoch=epoch)
        return ValetudoSource(session, robot.key or "", epoch=epoch)
    if isinstance(robot, RoombaRobot):
        return RoombaSource(robot.port, baud=robot.baud, epoch=epoch)
    if isinstance(robot, LineRobot):
        return JsonLineSource(robot.port, baud=robot.baud, epoch=epoch)
    return ZenohPoseSource(session, robot.key, epoch=epoch)


def _topics(robot: Ros2Robot) -> Ros2Topics:
    styles: tuple[Style, ...] = ("rmw_zenoh", "bridge") if robot.style == "both" else (robot.style,)
    return Ros2Topics(
        namespace=robot.namespace,
        domain=robot.domain,
        styles=styles,
        pose_kind=robot.pose,
        pose_topic=robot.pose_topic,
        map_topic=robot.map_topic,
        frames=Frames(robot.map_frame, robot.base_frames),
    )


def robot_finder(settings: VisionSettings, base: Path) -> CandidateFinder:
    """What finds the robot in the picture; relative paths are taken from `base`. Loading takes a moment."""
    if settings.robot_detector == "motion":
        return RobotFinder()
    path = None if settings.robot_detector == "packaged" else base / settings.robot_detector
    return RobotDetector(path, class_name=settings.robot_class, threads=settings.threads)


def camera_source(settings: CameraSettings, base: Path) -> CameraSource:
    """The camera; relative paths are taken from `base`."""
    source = settings.source
    if isinstance(source, MjpegCameraSettings):
        return HttpStreamCamera(source.url)
    if isinstance(source, FolderCameraSettings):
        return FolderCamera(Recording(base / source.path))
    if isinstance(source, RtspCameraSettings):
        return RtspCamera(source.url, transport=source.transport)
    if isinstance(source, Kinect2CameraSettings):
        return Kinect2Camera(serial=source.serial, fraction=source.fraction, fps=source.fps)
    return V4l2Camera(
        V4l2Settings(source.device, source.width_px, source.height_px, source.fps, fourcc=source.format)
    )


def csi_source(settings: RadioSettings, base: Path) -> CsiSource:
    """The CSI radio; relative paths are taken from `base`."""
    transmitter = None if settings.transmitter is None else mac_from_text(settings.transmitter)
    return open_source(settings.source, base, transmitter)


def join_sources(settings: Settings, base: Path, session: zenoh.Session) -> list[JoinSource]:
    """Everything that tells of stations; relative paths are taken from `base`.

    Leases let devices join only where no access point tells who is in.
    """
    devices, own_dir = settings.devices, _shared_dir()
    sources: list[JoinSource] = [
        HostapdSource(base / path, interface=Path(path).name, own_dir=own_dir) for path in devices.hostapd
    ]
    if devices.nl80211:
        sources.append(Nl80211Source(devices.nl80211))
    no_access_point = not sources
    sources += [LeaseSource(base / path, joins=no_access_point) for path in devices.leases]
    if devices.static:
        sources.append(StaticList([device.mac for device in devices.static]))
    if devices.agents:
        sources.append(AgentSource(session, HubKeys(settings.hub).agent_alive(), _agent_said))
    return sources


def _agent_said(payload: bytes) -> AgentSaid:
    info = decode_info(payload)
    return AgentSaid(info.mac, info.name)


def _shared_dir() -> Path | None:
    """Where hostapd finds our socket: systemd gives services a /tmp of their own."""
    folder = os.environ.get("RUNTIME_DIRECTORY")
    return None if folder is None else Path(folder.partition(":")[0])
