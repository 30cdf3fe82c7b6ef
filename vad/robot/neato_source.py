"""Poses from a Neato Botvac D3-D7 over a serial line (formats.md, section 5)."""

from __future__ import annotations

import functools
import logging
import math

from vad.health import Health
from vad.robot.floor_plan import FloorPlan
from vad.robot.neato import NeatoPoller, NeatoReading, NeatoScan
from vad.robot.pose import RobotPose, RobotStatus, status_now
from vad.robot.scan_map import ScanMap
from vad.robot.serial_port import SerialLine
from vad.streams import DropOldestQueue

BAUD = 115_200
RATE_HZ = 5.0
SIGMA_M = 0.02
SIGMA_YAW_RAD = math.radians(1.0)
SCAN_EVERY_NS = 3_000_000_000
SCANS_A_PLAN = 5
SCAN_MOVED_M = 0.15
SCAN_TURNED_RAD = math.radians(8.0)
"""A robot that moved more than this while a scan was on the line leaves its place too uncertain."""
LDS_BEHIND_M = 0.10

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
        lidar: ask for laser scans, too, and draw the floor plan of them; one every scan_every_ns.
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
        lidar: bool = False,
        scan_every_ns: int = SCAN_EVERY_NS,
    ) -> None:
        self.health = Health(f"robot {port}")
        self._status: RobotStatus = "unknown"
        self.epoch = epoch
        self._sigma_m = sigma_m
        self._sigma_yaw_rad = sigma_yaw_rad
        self.plans: DropOldestQueue[FloorPlan] = DropOldestQueue(1)
        self._map = ScanMap()
        self._scan: NeatoScan | None = None
        self._before: NeatoReading | None = None
        self._line: SerialLine[NeatoReading | NeatoScan] = SerialLine(
            port,
            baud=baud,
            dialogue=functools.partial(NeatoPoller, rate_hz, scan_every_ns if lidar else None),
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

    def _take(self, out: DropOldestQueue[RobotPose], reading: NeatoReading | NeatoScan) -> None:
        if isinstance(reading, NeatoScan):
            self._scan = reading
            return
        self._draw(reading)
        position = reading.position
        if not position.localised:
            self._status = "not_localised"
            self.health.counters["not_localised"] += 1
            if self.health.trouble(_NOT_LOCALISED):
                _log.warning("%s: %s", self._line.port, _NOT_LOCALISED)
            return
        self._status = "localised"
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
                epoch=self.epoch,
                quality="slam",
            )
        )

    def _draw(self, after: NeatoReading) -> None:
        """Draw the scan that was taken between the last position and this one, if the robot hardly moved."""
        scan, self._scan = self._scan, None
        before, self._before = self._before, after
        if scan is None or before is None or not (before.position.localised and after.position.localised):
            return
        a, b = before.position, after.position
        turn_rad = math.remainder(b.yaw_rad - a.yaw_rad, math.tau)
        if math.hypot(b.x_m - a.x_m, b.y_m - a.y_m) > SCAN_MOVED_M or abs(turn_rad) > SCAN_TURNED_RAD:
            self.health.counters["scans_in_motion"] += 1
            return
        share = min(max((scan.t_ns - before.t_ns) / max(after.t_ns - before.t_ns, 1), 0.0), 1.0)
        yaw_rad = a.yaw_rad + share * turn_rad
        x_m = a.x_m + share * (b.x_m - a.x_m) - LDS_BEHIND_M * math.cos(yaw_rad)
        y_m = a.y_m + share * (b.y_m - a.y_m) - LDS_BEHIND_M * math.sin(yaw_rad)
        self._map.add(x_m, y_m, yaw_rad, scan.ranges_m)
        self.health.counters["scans"] += 1
        plan = self._map.floor_plan(self.epoch)
        if plan is not None and self._map.scans % SCANS_A_PLAN == 0:
            self.health.counters["maps"] += 1
            self.plans.put(plan)
