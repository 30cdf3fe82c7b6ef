"""Wheel odometry of a Roomba or Create 2 over a serial line (formats.md, section 5). Dead reckoning only."""

from __future__ import annotations

import functools
import logging

from vad.health import Health
from vad.robot.pose import RobotPose, RobotStatus, status_now
from vad.robot.roomba import RoombaReading, StreamDialogue, WheelOdometry
from vad.robot.serial_port import SerialLine
from vad.streams import DropOldestQueue

BAUD = 115_200
EVERY_NS = 60_000_000
"""One frame in four is handed on: 16 poses a second are plenty at 0.5 m/s."""
FRAME = "odom"

_SILENCE_HINT = f"Is the baud rate right ({BAUD}; 500-series and older may use 57600 or 19200)?"
_LIFTED = "the robot was lifted: its wheels hang"
_LOST = "the robot was lifted or restarted, wheel counts do not tell where it is now: bring it to its dock"
_DRIFTS = "wheel counts only: the place drifts with the way driven"

_log = logging.getLogger(__name__)


class RoombaSource:
    """A PoseSource of quality odometry. Its frame begins where the robot stood when the daemon started.

    Args:
        port: device path, pty, `socket://host:port` or `rfc2217://host:port`. epoch: of the map.
    """

    def __init__(self, port: str, *, baud: int = BAUD, epoch: int) -> None:
        self.health = Health(f"robot {port}")
        self._status: RobotStatus = "unknown"
        self.epoch = epoch
        self._odometry = WheelOdometry()
        self._emitted_ns: int | None = None
        self._line: SerialLine[RoombaReading] = SerialLine(
            port,
            baud=baud,
            dialogue=StreamDialogue,
            health=self.health,
            silence_hint=_SILENCE_HINT,
        )

    @property
    def status(self) -> RobotStatus:
        """Whether the robot knows where it is."""
        return status_now(self._status, self.health)

    async def run(self, out: DropOldestQueue[RobotPose]) -> None:
        """Emit poses into `out` until cancelled; trouble goes into `health`, never out of here."""
        await self._line.run(functools.partial(self._take, out))

    def _take(self, out: DropOldestQueue[RobotPose], reading: RoombaReading) -> None:
        odometry = self._odometry
        odometry.update(reading)
        if odometry.lost:
            self._status = "lifted" if odometry.lifted else "lost"
            reason = _LIFTED if odometry.lifted else _LOST
            if self.health.trouble(reason):
                _log.warning("%s: %s", self._line.port, reason)
            return
        place = odometry.place
        self.health.ok(_DRIFTS)
        if self._emitted_ns is not None and reading.t_ns - self._emitted_ns < EVERY_NS:
            return
        self._emitted_ns = reading.t_ns
        self.health.counters["poses"] += 1
        pose = RobotPose(
            t_ns=reading.t_ns,
            x_m=place.x_m,
            y_m=place.y_m,
            yaw_rad=place.yaw_rad,
            sigma_m=place.sigma_m,
            sigma_yaw_rad=place.sigma_yaw_rad,
            epoch=self.epoch,
            quality="odometry",
            frame=FRAME,
            status="docked" if reading.docked else "localised",
        )
        self._status = pose.status
        out.put(pose)
