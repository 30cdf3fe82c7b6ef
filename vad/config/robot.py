"""Settings of the robot: one class for each kind."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from vad.config.kinds import Positive


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


RobotSettings = NeatoRobot | ZenohRobot | Ros2Robot | ValetudoRobot | RoombaRobot | LineRobot


def brings_map(robot: RobotSettings) -> bool:
    """Whether this robot sends its own floor plan."""
    return isinstance(robot, Ros2Robot | ValetudoRobot) or (isinstance(robot, NeatoRobot) and robot.lidar)
