"""vad.yaml: the settings of the daemon."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from vad.config.camera import CameraSettings
from vad.config.devices import DeviceSettings
from vad.config.kinds import Id, Positive
from vad.config.mqtt import MqttSettings
from vad.config.radio import RadioSettings
from vad.config.robot import RobotSettings
from vad.config.web import WebSettings


class MapSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The floor plan.

    file: a map_server YAML beside its picture; left out: the robot's own map
    epoch: of the file; raise it when the map changes
    rooms: for maps that have none: a YAML file, `rooms: [{name: Hall, polygon_m: [[0, 0], [3, 0], [3, 2]]}]`
    """

    file: Annotated[str, Meta(examples=["floor.yaml"])] | None = None
    epoch: Annotated[int, Meta(ge=0)] = 1
    rooms: Annotated[str, Meta(examples=["rooms.yaml"])] | None = None


class BusSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """zenoh: what the hub publishes and answers.

    listen: tcp on the loopback interface and, for the network, tls (tls/0.0.0.0:7448) for who has a
        certificate of `vad pki`
    connect: other routers, e.g. tcp/127.0.0.1:7448
    pki: the folder of certificates; left out: pki in state_dir
    """

    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    connect: Annotated[tuple[str, ...], Meta(examples=[["tcp/127.0.0.1:7450"]])] = ()
    pki: Annotated[str, Meta(examples=["/var/lib/vad/pki"])] | None = None


class MetricsSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Metrics for Prometheus on the loopback interface.

    port: of http://127.0.0.1:<port>/metrics; left out: none
    """

    port: Annotated[int, Meta(ge=1, le=65535, examples=[9747])] | None = None


class CaptureSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When a device counts as mapped, who is measured, how long a capture may be, what is kept.

    mapped_radius_m: measuring stops when the 90 % region's radius is this small ...
    min_walks: ... after at least so many walks
    max_walks: after so many it counts as mapped if its room is sure, else as failed
    min_s: shortest walk that is used
    max_s: longest capture
    together: how many devices one walk may measure
    recheck_h: a mapped device is measured again after so long: was it moved? 0 = never
    airtime_percent: what provoked packets may take of the channel's time, averaged over an hour
    quota_mb: session folders together; the oldest go first
    keep_free_mb: what they leave free on their disk
    keep_frames: keep the walk's pictures, too (people are on them)
    """

    mapped_radius_m: Positive = 0.7
    min_walks: Annotated[int, Meta(ge=1)] = 2
    max_walks: Annotated[int, Meta(ge=1)] = 8
    min_s: Positive = 6.0
    max_s: Positive = 30.0
    together: Annotated[int, Meta(ge=1, le=8)] = 3
    recheck_h: Annotated[float, Meta(ge=0)] = 24.0
    airtime_percent: Annotated[float, Meta(ge=0, le=100)] = 2.0
    quota_mb: Annotated[int, Meta(ge=10)] = 2000
    keep_free_mb: Annotated[int, Meta(ge=0)] = 500
    keep_frames: bool = False


class VisionSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """People and the robot in the picture.

    model: pose network, MoveNet (Multi- or SinglePose) or YOLO-pose as ONNX; left out: the packaged one
    robot_detector: motion finds the robot by its driving, packaged by the network that comes along, a path
        by a YOLOv5, YOLOv8 or YOLOX as ONNX
    robot_class: its class there, by name or number, if it has several
    max_fps: pictures a second that are looked at; one walker at 15 takes 40 % of a core, an idle room 2 %
    threads: of the network
    """

    model: Annotated[str, Meta(examples=["yolo11n-pose.onnx"])] | None = None
    robot_detector: str = "motion"
    robot_class: Annotated[str, Meta(examples=["robot vacuum"])] | None = None
    max_fps: Positive = 15.0
    threads: Annotated[int, Meta(ge=1, le=16)] = 1


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """vad.yaml: the settings of the daemon.

    robot: the robot vacuum, which knows where it is
    hub: the name in every zenoh key: vad/home/...
    source: `simulated` marks every message of a simulated home
    state_dir: database and recorded sessions
    """

    robot: RobotSettings
    camera: CameraSettings
    radio: RadioSettings
    devices: DeviceSettings
    map: MapSettings = MapSettings()
    hub: Id = "home"
    source: Literal["live", "simulated"] = "live"
    state_dir: str = "/var/lib/vad"
    bus: BusSettings = BusSettings()
    metrics: MetricsSettings = MetricsSettings()
    mqtt: MqttSettings = MqttSettings()
    web: WebSettings = WebSettings()
    capture: CaptureSettings = CaptureSettings()
    vision: VisionSettings = VisionSettings()
