"""The one contract of every pose source."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

from vad.health import Health
from vad.streams import DropOldestQueue

Quality = Literal["slam", "odometry"]


@dataclass(frozen=True, slots=True)
class RobotPose:
    """The robot's centre of rotation on the floor, in the map frame.

    t_ns: timeline; x_m, y_m: map; yaw_rad: counter-clockwise from map x; sigma_*: 1 standard deviation;
    epoch: the map's epoch; quality: whether a map stands behind it or wheel counts only.
    """

    t_ns: int
    x_m: float
    y_m: float
    yaw_rad: float
    sigma_m: float
    sigma_yaw_rad: float
    epoch: int
    quality: Quality


class PoseSource(Protocol):
    """A robot: `run` emits poses until it is cancelled and reconnects by itself."""

    health: Health

    async def run(self, out: DropOldestQueue[RobotPose]) -> None:
        """Emit poses into `out` until cancelled; trouble goes into `health`, never out of here."""
        ...
