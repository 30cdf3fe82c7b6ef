"""Settings of the robot: one class for each kind."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from vad.config.kinds import Positive, SerialPort


class NeatoRobot(msgspec.Struct, tag="neato", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Neato Botvac D3-D7 over serial.

    port: device (best below /dev/serial/by-id), socket://host:port or rfc2217://host:port
    rate_hz: how often its pose is asked for
    lidar: ask for laser scans, too, and draw the floor plan from them
    """

    port: SerialPort
    rate_hz: Positive = 5.0
    lidar: bool = False


class Ros2Robot(msgspec.Struct, tag="ros2", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A ROS 2 robot with SLAM over zenoh (rmw_zenoh or zenoh-bridge-ros2dds).

    endpoint: its zenoh router; left out: what is connected to the hub's own
    namespace: of relative topics; a topic that begins with a slash ignores it
    domain: its ROS_DOMAIN_ID
    style: the kind of its zenoh keys
    pose: what tells where it is: tf (map -> odom -> base), or what pose_topic carries: pose (PoseStamped),
        pose_covariance (PoseWithCovarianceStamped, as of AMCL) or odometry
    pose_topic: where pose is not tf
    map_topic: its occupancy grid
    map_frame: name of the map's frame in tf
    base_frames: names of the robot's own frame in tf; the first that comes counts
    """

    endpoint: Annotated[str, Meta(examples=["tcp/192.168.1.20:7447"])] | None = None
    namespace: Annotated[str, Meta(examples=["turtlebot1"])] = ""
    domain: Annotated[int, Meta(ge=0, le=232)] = 0
    style: Literal["rmw_zenoh", "bridge", "both"] = "both"
    pose: Literal["tf", "pose", "pose_covariance", "odometry"] = "tf"
    pose_topic: Annotated[str, Meta(examples=["amcl_pose"])] = ""
    map_topic: str = "map"
    map_frame: str = "map"
    base_frames: tuple[str, ...] = ("base_footprint", "base_link")


class ValetudoRobot(msgspec.Struct, tag="valetudo", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A robot with Valetudo (Roborock, Dreame, Xiaomi, Viomi ...); give either url or key.

    url: its address (user:password@ before the host where it wants one)
    key: the zenoh key that its MapData/map-data is relayed to
    """

    url: Annotated[str, Meta(examples=["http://192.168.1.30"])] | None = None
    key: Annotated[str, Meta(examples=["valetudo/robot/MapData/map-data"])] | None = None


class RoombaRobot(msgspec.Struct, tag="roomba", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Roomba or Create 2 over serial: wheel counts only, from where it stands when the daemon starts.

    port: device, socket://host:port or rfc2217://host:port
    baud: bits per second
    """

    port: SerialPort
    baud: Annotated[int, Meta(gt=0)] = 115_200


class LineRobot(msgspec.Struct, tag="serial-json", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A home-made robot that writes lines of JSON with a checksum (vad/robot/json_line.py).

    port: device, socket://host:port or rfc2217://host:port
    baud: bits per second
    """

    port: SerialPort
    baud: Annotated[int, Meta(gt=0)] = 115_200


class ZenohRobot(msgspec.Struct, tag="zenoh-json", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A home-made robot that puts JSON poses on a zenoh key (vad/robot/zenoh_source.py).

    key: its key
    """

    key: Annotated[str, Meta(examples=["robot/pose"])]


RobotSettings = NeatoRobot | ValetudoRobot | Ros2Robot | RoombaRobot | LineRobot | ZenohRobot


def brings_map(robot: RobotSettings) -> bool:
    """Whether this robot sends its own floor plan."""
    return isinstance(robot, Ros2Robot | ValetudoRobot) or (isinstance(robot, NeatoRobot) and robot.lidar)
