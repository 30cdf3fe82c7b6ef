"""Typed settings: one YAML file, every key known, every error with its path."""

from __future__ import annotations

from vad.config.agent import AgentSettings
from vad.config.camera import (
    CameraSettings,
    CameraSourceSettings,
    FolderCameraSettings,
    Kinect2CameraSettings,
    MjpegCameraSettings,
    RtspCameraSettings,
    V4l2CameraSettings,
)
from vad.config.devices import DeviceSettings, StaticDevice
from vad.config.hub import (
    BusSettings,
    CaptureSettings,
    MapSettings,
    MetricsSettings,
    Settings,
    VisionSettings,
)
from vad.config.kinds import AbsolutePath, Id, Ipv4Text, MacText, Positive
from vad.config.mqtt import MqttSettings
from vad.config.radio import ConnectorCsi, FollowCsi, RadioSettings
from vad.config.reading import (
    agent_settings,
    load_settings,
    parse_settings,
    parse_yaml,
    pki_folder,
    read_text,
    resolve,
)
from vad.config.robot import (
    LineRobot,
    NeatoRobot,
    RobotSettings,
    RoombaRobot,
    Ros2Robot,
    ValetudoRobot,
    ZenohRobot,
    brings_map,
)
from vad.config.web import WebSettings

__all__ = [
    "AbsolutePath",
    "AgentSettings",
    "BusSettings",
    "CameraSettings",
    "CameraSourceSettings",
    "CaptureSettings",
    "ConnectorCsi",
    "DeviceSettings",
    "FolderCameraSettings",
    "FollowCsi",
    "Id",
    "Ipv4Text",
    "Kinect2CameraSettings",
    "LineRobot",
    "MacText",
    "MapSettings",
    "MetricsSettings",
    "MjpegCameraSettings",
    "MqttSettings",
    "NeatoRobot",
    "Positive",
    "RadioSettings",
    "RobotSettings",
    "RoombaRobot",
    "Ros2Robot",
    "RtspCameraSettings",
    "Settings",
    "StaticDevice",
    "V4l2CameraSettings",
    "ValetudoRobot",
    "VisionSettings",
    "WebSettings",
    "ZenohRobot",
    "agent_settings",
    "brings_map",
    "load_settings",
    "parse_settings",
    "parse_yaml",
    "pki_folder",
    "read_text",
    "resolve",
]
