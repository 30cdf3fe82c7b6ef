"""Poses of a home-made robot over a serial line (format: `vad.robot.json_line`)."""

from __future__ import annotations

import functools
import logging

from vad.health import Health
from vad.robot.json_line import JsonLineDialogue
from vad.robot.json_source import NO_PLACE_REASONS, NoPlace
from vad.robot.pose import RobotPose, RobotStatus, status_now
from vad.robot.serial_port import SerialLine
from vad.streams import DropOldestQueue

BAUD = 115_200

_log = logging.getLogger(__name__)


class JsonLineSource:
    """A PoseSource that reads lines of JSON with a checksum.

    Args:
        port: device path, pty, `socket://host:port` or `rfc2217://host:port`. epoch: of the robot's map.
    """

    def __init__(self, port: str, *, baud: int = BAUD, epoch: int) -> None:
        self.health = Health(f"robot {port}")
        self._status: RobotStatus = "unknown"
        self.epoch = epoch
        self._line: SerialLine[RobotPose | NoPlace] = SerialLine(
            port,
            baud=baud,
            dialogue=lambda: JsonLineDialogue(self.epoch),
            health=self.health,
            silence_hint=f"Is the baud rate right ({baud}), and does each line end in * and its CRC-16?",
        )

    @property
    def status(self) -> RobotStatus:
        """Whether the robot knows where it is."""
        return status_now(self._status, self.health)

    async def run(self, out: DropOldestQueue[RobotPose]) -> None:
        """Emit poses into `out` until cancelled; trouble goes into `health`, never out of here."""
        await self._line.run(functools.partial(self._take, out))

    def _take(self, out: DropOldestQueue[RobotPose], report: RobotPose | NoPlace) -> None:
        if not isinstance(report, RobotPose):
            self._status = report
            if self.health.trouble(NO_PLACE_REASONS[report]):
                _log.warning("%s: %s", self._line.port, NO_PLACE_REASONS[report])
            return
        self._status = report.status
        self.health.counters["poses"] += 1
        self.health.ok()
        out.put(report)
