"""Poses from a Neato Botvac D3-D7 over a serial line (formats.md, section 5)."""

from __future__ import annotations

import functools
import logging
import math

from vad.health import Health
from vad.robot.neato import NeatoPoller, NeatoReading
from vad.robot.pose import RobotPose
from vad.robot.serial_port import SerialLine
from vad.streams import DropOldestQueue

BAUD = 115_200
RATE_HZ = 5.0
SIGMA_M = 0.02
SIGMA_YAW_RAD = math.radians(1.0)

_NOT_LOCALISED = (
    "the robot is not localised (it reports 0, 0, 0). Start a cleaning so that it leaves its dock"
)
_SILENCE_HINT = f"Is the baud rate right ({BAUD}), and does the firmware know GetRobotPos?"

_log = logging.getLogger(__name__)


class NeatoSource:
    """A PoseSource: polls `GetRobotPos Smooth`. Poses are in the robot's own map, which is the map frame.

    Args:
        port: device path, pty, `socket://host:port` or `rfc2217://host:port`.
        epoch: the epoch of the map the robot uses; its frame is dock-anchored and can turn between runs.
        sigma_m, sigma_yaw_rad: standard deviation claimed for every pose.
    """

    def __init__(
        self,
        port: str,
        *,
        baud: int = BAUD,
        rate_hz: float = RATE_HZ,
        epoch: int,
        sigma_m: float = SIGMA_M,
        sigma_yaw_rad: float = SIGMA_YAW_RAD,
    ) -> None:
        self.health = Health(f"robot {port}")
        self._epoch = epoch
        self._sigma_m = sigma_m
        self._sigma_yaw_rad = sigma_yaw_rad
        self._line: SerialLine[NeatoReading] = SerialLine(
            port,
            baud=baud,
            dialogue=functools.partial(NeatoPoller, rate_hz),
            health=self.health,
            silence_hint=_SILENCE_HINT,
        )

    async def run(self, out: DropOldestQueue[RobotPose]) -> None:
        """Emit poses into `out` until cancelled; trouble goes into `health`, never out of here."""
        await self._line.run(functools.partial(self._take, out))

    def _take(self, out: DropOldestQueue[RobotPose], reading: NeatoReading) -> None:
        position = reading.position
        if not position.localised:
            self.health.counters["not_localised"] += 1
            if self.health.trouble(_NOT_LOCALISED):
                _log.warning("%s: %s", self._line.port, _NOT_LOCALISED)
            return
        self.health.counters["poses"] += 1
        self.health.ok(f"answers in {reading.round_trip_ns / 1e6:.0f} ms")
        out.put(
            RobotPose(
                t_ns=reading.t_ns,
                x_m=position.x_m,
                y_m=position.y_m,
                yaw_rad=position.yaw_rad,
                sigma_m=self._sigma_m,
                sigma_yaw_rad=self._sigma_yaw_rad,
                epoch=self._epoch,
                quality="slam",
            )
        )
