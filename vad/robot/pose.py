"""The one contract of every pose source."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

from vad.health import Health
from vad.robot.floor_plan import FloorPlan
from vad.streams import DropOldestQueue

Quality = Literal["slam", "odometry"]
RobotStatus = Literal["unknown", "localised", "docked", "not_localised", "lifted", "lost"]
"""unknown: nothing heard yet. not_localised: the robot has no place on its map. lifted: its wheels hang.
lost: it had a place, and what came since cannot be trusted (silence, put down elsewhere)."""


def status_now(said: RobotStatus, health: Health) -> RobotStatus:
    """What the robot said last; lost where it had a place and its line is in trouble since."""
    if health.state in ("degraded", "failed") and said in ("localised", "docked"):
        return "lost"
    return said


@dataclass(frozen=True, slots=True)
class RobotPose:
    """The robot's centre of rotation on the floor, in the map frame.

    t_ns: timeline; x_m, y_m: map; yaw_rad: counter-clockwise from map x; sigma_*: 1 standard deviation;
    epoch: the map's epoch; quality: whether a map stands behind it or wheel counts only; frame: the robot's
    own name of the frame; status: localised or docked, for without a place there is no pose (the source's
    `status` tells why).
    """

    t_ns: int
    x_m: float
    y_m: float
    yaw_rad: float
    sigma_m: float
    sigma_yaw_rad: float
    epoch: int
    quality: Quality
    frame: str = "map"
    status: Literal["localised", "docked"] = "localised"


class PoseSource(Protocol):
    """A robot: `run` emits poses until it is cancelled and reconnects by itself.

    epoch is stamped on every pose; the owner may change it when the robot's map does.
    """

    health: Health
    epoch: int

    @property
    def status(self) -> RobotStatus:
        """Whether the robot knows where it is."""
        ...

    async def run(self, out: DropOldestQueue[RobotPose]) -> None:
        """Emit poses into `out` until cancelled; trouble goes into `health`, never out of here."""
        ...


@runtime_checkable
class MapSource(Protocol):
    """A pose source that also brings the robot's map, in the frame of its poses.

    plans: the newest map, whenever the robot sends one; its epoch is the source's, not yet judged.
    """

    plans: DropOldestQueue[FloorPlan]
