"""vad.yaml: the settings of the daemon."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from vad.config.camera import CameraSettings
from vad.config.devices import DeviceSettings
from vad.config.kinds import Id, Positive
from vad.config.radio import RadioSettings
from vad.config.robot import RobotSettings


class MapSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The floor plan. file: a map_server YAML beside its picture; left out: the robot's own map.

    epoch: of the file; raise it when the map changes. rooms: a YAML with `rooms: [{name, polygon_m}]`, for
    maps that have none.
    """

    file: str | None = None
    epoch: Annotated[int, Meta(ge=0)] = 1
    rooms: str | None = None


class BusSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """zenoh. listen: tcp on the loopback interface and, for the network, tls (e.g. tls/0.0.0.0:7448) for who
    has a certificate of `vad pki`; connect: other routers; pki: the folder of certificates, left out: `pki`
    in state_dir."""

    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    connect: tuple[str, ...] = ()
    pki: str | None = None


class MetricsSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Prometheus metrics at http://127.0.0.1:<port>/metrics; left out: none."""

    port: Annotated[int, Meta(ge=1, le=65535)] | None = None


class CaptureSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When a device counts as mapped, who is measured, how long a capture may be, what is kept.

    mapped_radius_m: 90 % region at which measuring stops; min_walks: at least as many walks. together: how
    many devices one walk may measure. recheck_h: a mapped device is measured again after so many hours: was
    it moved? 0 = never. airtime_percent: what provoked packets may take of the channel's time,
    averaged over an hour. quota_mb: session folders together, the oldest go first; keep_free_mb: what they
    leave free on their disk. keep_frames: the walk's pictures, too (people are on them).
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
    """People and the robot in the picture. model: a MoveNet or YOLO-pose ONNX file, else the packaged one.

    robot_detector: `motion` finds the robot by its driving, `packaged` by the network that comes along, a
    path by a YOLOv5, YOLOv8 or YOLOX ONNX file; robot_class: its class there, by name or number, if it has
    several.
    """

    model: str | None = None
    robot_detector: str = "motion"
    robot_class: str | None = None
    max_fps: Positive = 15.0
    threads: Annotated[int, Meta(ge=1, le=16)] = 1


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """vad.yaml.

    hub: the name in every zenoh key; source: `simulated` marks every message of a simulated home;
    state_dir: database and session folders.
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
    capture: CaptureSettings = CaptureSettings()
    vision: VisionSettings = VisionSettings()
