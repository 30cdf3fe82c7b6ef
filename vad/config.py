"""Typed settings: one YAML file, every key known, every error with its path."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import yaml
from msgspec import Meta

from vad.errors import ConfigError

T = TypeVar("T")

Positive = Annotated[float, Meta(gt=0)]
Id = Annotated[str, Meta(pattern="^[A-Za-z0-9_-]{1,64}$")]
MacText = Annotated[str, Meta(pattern="^[0-9A-Fa-f]{2}(:[0-9A-Fa-f]{2}){5}$")]

AbsolutePath = Annotated[str, Meta(pattern="^/")]
Ipv4Text = Annotated[str, Meta(pattern=r"^((25[0-5]|2[0-4]\d|1?\d?\d)(\.(?!$)|$)){4}$")]


class NeatoRobot(msgspec.Struct, tag="neato", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Neato Botvac D3-D7 over serial. port: device path, pty, socket:// or rfc2217:// URL.

    lidar: ask for laser scans, too, and draw the floor plan from them.
    """

    port: str
    rate_hz: Positive = 5.0
    lidar: bool = False


class Ros2Robot(msgspec.Struct, tag="ros2", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A ROS 2 robot over zenoh (rmw_zenoh or zenoh-bridge-ros2dds).

    endpoint: its zenoh router, e.g. tcp/192.168.1.20:7447; left out: what is connected to the hub's own.
    style: the kind of keys, both if left out. pose: `tf` (map -> odom -> base), else pose_topic carries
    `pose` (PoseStamped), `pose_covariance` (AMCL) or `odometry`. A topic that begins with a slash ignores
    the namespace.
    """

    endpoint: str | None = None
    namespace: str = ""
    domain: Annotated[int, Meta(ge=0, le=232)] = 0
    style: Literal["rmw_zenoh", "bridge", "both"] = "both"
    pose: Literal["tf", "pose", "pose_covariance", "odometry"] = "tf"
    pose_topic: str = ""
    map_topic: str = "map"
    map_frame: str = "map"
    base_frames: tuple[str, ...] = ("base_footprint", "base_link")


class ValetudoRobot(msgspec.Struct, tag="valetudo", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A robot with Valetudo. url: its address, e.g. http://192.168.1.30 (user:password@ where it wants one);
    or key: the zenoh key that its MapData/map-data is relayed to."""

    url: str | None = None
    key: str | None = None


class RoombaRobot(msgspec.Struct, tag="roomba", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Roomba or Create 2 over serial: wheel counts only, from where it stands when the daemon starts."""

    port: str
    baud: Annotated[int, Meta(gt=0)] = 115_200


class LineRobot(msgspec.Struct, tag="serial-json", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A home-made robot that writes lines of JSON with a checksum (vad/robot/json_line.py)."""

    port: str
    baud: Annotated[int, Meta(gt=0)] = 115_200


class ZenohRobot(msgspec.Struct, tag="zenoh-json", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A home-made robot that puts JSON poses on a zenoh key."""

    key: str


class V4l2CameraSettings(msgspec.Struct, tag="v4l2", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A USB or built-in camera. device: /dev/video0 or a /dev/v4l/by-id path; format: of the pixels, where
    the camera has both."""

    device: str
    width_px: int = 640
    height_px: int = 480
    fps: Positive = 15.0
    format: Literal["MJPG", "YUYV"] = "MJPG"


class Kinect2CameraSettings(
    msgspec.Struct, tag="kinect2", frozen=True, forbid_unknown_fields=True, kw_only=True
):
    """The colour camera of a Kinect v2 on USB 3. serial: which, where there are several; fraction: pictures
    of 1920x1080 divided by 1, 2 or 4; fps: pictures decoded, of the 30 that come."""

    serial: str | None = None
    fraction: Literal[1, 2, 4] = 2
    fps: Positive = 15.0


class RtspCameraSettings(msgspec.Struct, tag="rtsp", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """An IP camera. url: rtsp://[user:password@]host[:port]/path, best of its small stream."""

    url: str
    transport: Literal["tcp", "udp"] = "tcp"


class MjpegCameraSettings(msgspec.Struct, tag="mjpeg", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A camera that serves MJPEG over HTTP (ustreamer, mjpg-streamer, ESP32-CAM, go2rtc)."""

    url: str


class FolderCameraSettings(
    msgspec.Struct, tag="folder", frozen=True, forbid_unknown_fields=True, kw_only=True
):
    """Recorded pictures (a folder with times.csv) or a video file, played at their own times."""

    path: str


CameraSourceSettings = (
    V4l2CameraSettings
    | MjpegCameraSettings
    | RtspCameraSettings
    | Kinect2CameraSettings
    | FolderCameraSettings
)


class CameraSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The camera. id: its name on the bus. intrinsics: a file that `vad camera intrinsics` wrote; or
    focal_px, if that alone is known; with neither the lens is estimated from the robot's drive."""

    source: CameraSourceSettings
    id: Id = "main"
    intrinsics: str | None = None
    focal_px: Positive | None = None


class ConnectorCsi(msgspec.Struct, tag="connector", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Intel 5300 over netlink. group: 26 on every kernel since 2.6.3x; allow_user_space: take packets that do
    not come from the kernel (emulators only)."""

    group: Annotated[int, Meta(ge=1, le=1000)] = 26
    allow_user_space: bool = False


class FollowCsi(msgspec.Struct, tag="follow", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A CSI log that another program writes: a FIFO or a growing file in log_to_file's format."""

    path: str


class RadioSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The hub's CSI radio. antenna_offset_m: where its antennas are from the camera, along the map's axes.

    transmitter: whose all packets are, where the card is no access point (client mode: the AP's address);
    traffic_packets_per_s: echo requests to the device under measurement, if its IP is known; 0 = none.
    """

    source: ConnectorCsi | FollowCsi = ConnectorCsi()
    transmitter: MacText | None = None
    traffic_packets_per_s: Annotated[float, Meta(ge=0, le=2000)] = 400.0
    carrier_hz: Positive = 5.24e9
    bandwidth_mhz: Literal[20, 40] = 20
    antenna_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


class StaticDevice(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A device that is known without a join event. ip: where echo requests make it send."""

    mac: MacText
    name: str | None = None
    ip: Ipv4Text | None = None


class DeviceSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Who may appear on the map.

    hostapd: control sockets, e.g. /run/hostapd/wlan0. nl80211: access point interfaces that the kernel tells
    of, for those without a control socket. leases: dnsmasq's lease files, for names and addresses; where
    neither of the others is given, a lease lets its device join. agents: remote CSI nodes join, too. makers:
    a list of makers (absolute path of IEEE's oui.txt, nmap's or Wireshark's); left out: the system's.
    """

    hostapd: tuple[str, ...] = ()
    nl80211: tuple[str, ...] = ()
    leases: tuple[str, ...] = ()
    agents: bool = True
    makers: AbsolutePath | None = None
    static: tuple[StaticDevice, ...] = ()
    ignore: tuple[MacText, ...] = ()


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


RobotSettings = NeatoRobot | ZenohRobot | Ros2Robot | ValetudoRobot | RoombaRobot | LineRobot


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


class AgentSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """agent.yaml: a remote node with a CSI card, whose own place is wanted.

    hub: the hub's endpoint, e.g. tls/192.168.1.10:7448; hub_name: its name in every key; credentials: the
    folder that `vad pki issue agent ID` made there. id: this agent's; mac, interface: the card (the only
    wireless one if both are left out). transmitter: the access point's address: frames known to be of others
    are left out. batch_ms: packets of so long travel together; buffer_mb: what waits at most while the
    network is gone.
    """

    hub: str
    id: Id
    hub_name: Id = "home"
    credentials: str | None = None
    name: Annotated[str, Meta(max_length=64)] | None = None
    mac: MacText | None = None
    interface: str | None = None
    source: ConnectorCsi | FollowCsi = ConnectorCsi()
    transmitter: MacText | None = None
    carrier_hz: Positive = 5.24e9
    bandwidth_mhz: Literal[20, 40] = 20
    batch_ms: Annotated[float, Meta(ge=20, le=100)] = 50.0
    buffer_mb: Annotated[float, Meta(ge=1, le=4096)] = 32.0


def agent_settings(plain: dict[str, Any], *, where: str) -> AgentSettings:
    """Plain values as AgentSettings; ConfigError names `where` and the key's path."""
    return _typed(plain, AgentSettings, where)


def parse_settings(text: str, *, where: str) -> Settings:
    """YAML text as Settings; ConfigError names `where` and the key's path."""
    settings = _typed(parse_yaml(text, where=where), Settings, where)
    _check_robot(settings, where)
    return settings


def parse_yaml(text: str, *, where: str) -> dict[str, Any]:
    """YAML text as plain values; ConfigError where it is none."""
    try:
        raw: Any = yaml.safe_load(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f" in line {mark.line + 1}" if mark else ""
        raise ConfigError(f"not YAML{line}", where=where, remedy="Check the indentation") from error
    if not isinstance(raw, dict):
        raise ConfigError("the file holds no settings", where=where, remedy="See config/vad.yaml")
    return raw


def _typed(raw: dict[str, Any], kind: type[T], where: str) -> T:
    try:
        return msgspec.convert(raw, type=kind, strict=False)  # YAML 1.1 reads 5.24e9 as text
    except msgspec.ValidationError as error:
        what, _, path = str(error).partition(" - at ")
        raise ConfigError(what, where=f"{where}: {path.strip('`') or '$'}") from error


def brings_map(robot: RobotSettings) -> bool:
    """Whether this robot sends its own floor plan."""
    return isinstance(robot, Ros2Robot | ValetudoRobot) or (isinstance(robot, NeatoRobot) and robot.lidar)


def _check_robot(settings: Settings, where: str) -> None:
    robot = settings.robot
    if settings.camera.intrinsics is not None and settings.camera.focal_px is not None:
        raise ConfigError("give either intrinsics or focal_px", where=f"{where}: $.camera")
    if settings.map.file is None and not brings_map(robot):
        raise ConfigError(
            "there is no floor plan: this robot brings none",
            where=f"{where}: $.map.file",
            remedy="Name a map_server YAML; `vad map import` makes one from other maps",
        )
    if isinstance(robot, ValetudoRobot) and (robot.url is None) == (robot.key is None):
        raise ConfigError("give either url or key", where=f"{where}: $.robot")
    if isinstance(robot, Ros2Robot) and (robot.pose == "tf") != (not robot.pose_topic):
        raise ConfigError(
            "pose_topic goes with pose: pose, pose_covariance or odometry",
            where=f"{where}: $.robot.pose_topic",
        )


def load_settings(path: Path) -> Settings:
    """Read and check a settings file; relative paths inside it are taken from its folder."""
    return parse_settings(read_text(path), where=str(path))


def read_text(path: Path) -> str:
    """The text of a settings file; ConfigError where it cannot be read."""
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(
            f"cannot be read ({error.strerror})", where=str(path), remedy="Give the file with --config"
        ) from error
    except UnicodeDecodeError as error:
        raise ConfigError("not UTF-8 text", where=str(path)) from error


def pki_folder(settings: Settings, config_file: Path) -> Path:
    """The folder of certificates (vad.pki.folder)."""
    if settings.bus.pki is not None:
        return resolve(settings.bus.pki, config_file)
    return resolve(settings.state_dir, config_file) / "pki"


def resolve(path: str, config_file: Path) -> Path:
    """A path from the settings, relative ones from the settings file's folder."""
    return (config_file.parent / path).resolve()
