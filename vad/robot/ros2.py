"""What a ROS 2 robot's messages say: payloads -> poses and floor plans, no I/O (formats.md, section 3)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from vad.clock import TICK_NS, ClockMap
from vad.errors import ProtocolError
from vad.robot import cdr
from vad.robot.cdr import PoseMessage, Transform
from vad.robot.floor_plan import OCCUPIED, UNKNOWN, FloorPlan
from vad.robot.pose import Quality, RobotPose, RobotStatus
from vad.robot.tf_tree import TfTree, composed

Kind = Literal["tf", "tf_static", "pose", "pose_covariance", "odometry", "map"]

ROS_TYPES: dict[Kind, str] = {
    "tf": "tf2_msgs/msg/TFMessage",
    "tf_static": "tf2_msgs/msg/TFMessage",
    "pose": "geometry_msgs/msg/PoseStamped",
    "pose_covariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "odometry": "nav_msgs/msg/Odometry",
    "map": "nav_msgs/msg/OccupancyGrid",
}
LATCHED: frozenset[Kind] = frozenset({"tf_static", "pose_covariance", "map"})
"""Published once and kept (transient local): who comes later asks for the last one."""

SIGMA_M = 0.05
SIGMA_YAW_RAD = math.radians(2.0)
NOT_LOCALISED_SIGMA_M = 1.0
"""AMCL starts at 0.5 m; a cloud wider than this is spread over the home."""
STALE_MAP_NS = 5_000_000_000
"""SLAM repeats map->odom 10 to 50 times a second; without it the pose is wheel counts alone."""
MAX_COORDINATE_M = 1000.0
_COUNTER_MASK = 0xFFFF_FFFF


@dataclass(frozen=True, slots=True)
class Frames:
    """Names of frames: `map` -> ... -> one of `base`, the first that is connected."""

    map: str = "map"
    base: tuple[str, ...] = ("base_footprint", "base_link")


class RobotClock:
    """Message stamps of the robot's own clock onto the timeline, through the least delay seen."""

    def __init__(self) -> None:
        self._map = ClockMap()

    def time_ns(self, stamp_ns: int, arrival_ns: int) -> int:
        """When the stamp was, on the timeline; the arrival where the message has no stamp."""
        if stamp_ns <= 0:
            return arrival_ns
        counter = np.array([stamp_ns // TICK_NS & _COUNTER_MASK], np.uint32)
        mapped = int(self._map.update(counter, np.array([arrival_ns], np.int64))[0])
        return min(mapped, arrival_ns)


class Ros2Reader:
    """Reads one robot's topics. `status` and `reason` tell why there is no pose.

    Poses come from what the owner subscribes to: TF, or one pose topic.
    """

    def __init__(self, frames: Frames, epoch: int) -> None:
        self.status: RobotStatus = "unknown"
        self.reason = ""
        self.epoch = epoch
        self._frames = frames
        self._tree = TfTree()
        self._clock = RobotClock()
        self._last_stamp_ns = -1

    def pose(self, kind: Kind, payload: bytes, arrival_ns: int) -> RobotPose | None:
        """The pose that a message of any kind but `map` gives; ProtocolError for damaged ones."""
        if kind in ("tf", "tf_static"):
            return self._from_tf(payload, arrival_ns, static=kind == "tf_static")
        if kind == "odometry":
            return self._from_message(cdr.odometry(payload), arrival_ns, "odometry")
        if kind == "pose_covariance":
            return self._from_message(cdr.pose_with_covariance_stamped(payload), arrival_ns, "slam")
        return self._from_message(cdr.pose_stamped(payload), arrival_ns, "slam")

    def floor_plan(self, payload: bytes) -> FloorPlan:
        """The floor plan in an OccupancyGrid; ProtocolError for what cannot be one."""
        grid = cdr.occupancy_grid(payload)
        if grid.frame.lstrip("/") != self._frames.map:
            raise ProtocolError(
                f"the grid is in the frame {grid.frame!r}, not {self._frames.map!r}",
                remedy="Set map_topic to the robot's map, or map_frame to its frame",
            )
        try:
            if grid.cells.size and (grid.cells.min() < UNKNOWN or grid.cells.max() > OCCUPIED):
                raise ValueError("a cell is outside -1..100")
            origin = (grid.origin.x, grid.origin.y, grid.origin.yaw_rad)
            return FloorPlan(self.epoch, float(grid.resolution_m), origin, grid.cells.copy())
        except ValueError as error:
            raise ProtocolError(f"this grid is no floor plan: {error}") from error

    def _from_tf(self, payload: bytes, arrival_ns: int, *, static: bool) -> RobotPose | None:
        messages = cdr.tf_message(payload)
        for message in messages:
            _check(message.transform)
            self._tree.put(message, arrival_ns, static=static)
        if static or not messages:
            return None
        for base in self._frames.base:
            chain = self._tree.chain(self._frames.map, base)
            if chain:
                break
        else:
            self._no_place(
                "not_localised", f"/tf does not lead from {self._frames.map} to the robot's base: is SLAM on?"
            )
            return None
        moving = [link for link in chain if not link.static]
        if not moving:
            return None
        # The lowest moving link is the wheels'; the ones above it are SLAM's corrections.
        wheels, corrections = moving[0], moving[1:]
        if any(arrival_ns - link.arrival_ns > STALE_MAP_NS for link in corrections):
            self._no_place("lost", f"{self._frames.map} has not been updated for 5 s: has SLAM stopped?")
            return None
        if wheels.stamp_ns == self._last_stamp_ns:
            return None
        self._last_stamp_ns = wheels.stamp_ns
        return self._localised(wheels.stamp_ns, arrival_ns, composed(chain), "slam", self._frames.map)

    def _from_message(self, message: PoseMessage, arrival_ns: int, quality: Quality) -> RobotPose | None:
        _check(message.pose)
        sigma_m, sigma_yaw_rad = _sigmas(message.covariance)
        if sigma_m > NOT_LOCALISED_SIGMA_M:
            self._no_place("not_localised", f"the robot knows its place to ±{sigma_m:.1f} m only")
            return None
        frame = message.frame.lstrip("/")
        return self._localised(
            message.stamp_ns, arrival_ns, message.pose, quality, frame, sigma_m, sigma_yaw_rad
        )

    def _localised(
        self,
        stamp_ns: int,
        arrival_ns: int,
        pose: Transform,
        quality: Quality,
        frame: str,
        sigma_m: float = SIGMA_M,
        sigma_yaw_rad: float = SIGMA_YAW_RAD,
    ) -> RobotPose:
        self.status, self.reason = "localised", ""
        return RobotPose(
            t_ns=self._clock.time_ns(stamp_ns, arrival_ns),
            x_m=pose.x,
            y_m=pose.y,
            yaw_rad=pose.yaw_rad,
            sigma_m=sigma_m,
            sigma_yaw_rad=sigma_yaw_rad,
            epoch=self.epoch,
            quality=quality,
            frame=frame,
        )

    def _no_place(self, status: RobotStatus, reason: str) -> None:
        self.status, self.reason = status, reason


def _check(pose: Transform) -> None:
    # Products, for a power that is too large is an exception and a product is infinite.
    norm2 = pose.qx * pose.qx + pose.qy * pose.qy + pose.qz * pose.qz + pose.qw * pose.qw
    if not (max(abs(pose.x), abs(pose.y)) <= MAX_COORDINATE_M and 0.9 < norm2 < 1.1):
        raise ProtocolError("a pose without finite numbers, outside any home, or without a unit quaternion")


def _sigmas(covariance: cdr.Covariance6 | None) -> tuple[float, float]:
    """Along the worst direction, and of the yaw; the usual ones where the robot leaves them zero."""
    if covariance is None:
        return SIGMA_M, SIGMA_YAW_RAD
    xx, xy, yy, yaw = covariance[0], covariance[1], covariance[7], covariance[35]
    if not all(map(math.isfinite, (xx, xy, yy, yaw))):
        raise ProtocolError("a covariance without finite numbers")
    worst_m2 = (xx + yy) / 2 + math.hypot((xx - yy) / 2, xy)
    return math.sqrt(worst_m2) if worst_m2 > 0 else SIGMA_M, math.sqrt(yaw) if yaw > 0 else SIGMA_YAW_RAD
