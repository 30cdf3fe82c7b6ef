"""Poses of home-made robots as JSON over zenoh (schema: `vad.robot.json_source`; formats.md, section 7)."""

from __future__ import annotations

import asyncio
import logging

import zenoh

from vad.errors import ProtocolError
from vad.handover import Intake
from vad.health import Health
from vad.robot.json_source import MAX_PAYLOAD_BYTES, NO_PLACE_REASONS, report_from_json
from vad.robot.pose import RobotPose, RobotStatus, status_now
from vad.robot.zenoh_link import put_counted, subscribed
from vad.streams import DropOldestQueue

SILENCE_S = 2.0
RETRY_S = 1.0
_INBOX = 64
_INTAKE = Intake(max_bytes=4 * MAX_PAYLOAD_BYTES, per_s=500.0, burst=250)
"""Ten times what a robot sends; what is a little too long is still read, for the reason why not."""

_log = logging.getLogger(__name__)


class ZenohPoseSource:
    """A PoseSource: subscribes to JSON poses on an open session, which stays the caller's.

    Args:
        session: open; reconnecting to the router is its own doing.
        key_expr: where the robot publishes, e.g. `robot/pose`.
        epoch: the epoch of the map the poses are in.
    """

    def __init__(self, session: zenoh.Session, key_expr: str, *, epoch: int) -> None:
        self.health = Health(f"robot {key_expr}")
        self._session = session
        self._key_expr = key_expr
        self._status: RobotStatus = "unknown"
        self.epoch = epoch

    @property
    def status(self) -> RobotStatus:
        """Whether the robot knows where it is."""
        return status_now(self._status, self.health)

    async def run(self, out: DropOldestQueue[RobotPose]) -> None:
        """Emit poses into `out` until cancelled; trouble goes into `health`, never out of here."""
        while True:
            try:
                await self._subscribed(out)
            except zenoh.ZError as error:
                self._trouble(f"cannot subscribe: {error}")
            await asyncio.sleep(RETRY_S)

    async def _subscribed(self, out: DropOldestQueue[RobotPose]) -> None:
        inbox: DropOldestQueue[tuple[bytes, int]] = DropOldestQueue(_INBOX)

        def arrived(payload: bytes, arrival_ns: int) -> None:
            put_counted(inbox, self.health.counters, (payload, arrival_ns))

        with subscribed(
            self._session, self._key_expr, arrived, intake=_INTAKE, counters=self.health.counters
        ):
            await self._receive(inbox, out)

    async def _receive(
        self, inbox: DropOldestQueue[tuple[bytes, int]], out: DropOldestQueue[RobotPose]
    ) -> None:
        loop = asyncio.get_running_loop()
        nothing = f"no pose for {SILENCE_S:g} s. Does the robot publish on {self._key_expr}?"
        silence, deadline_s = nothing, loop.time() + SILENCE_S
        while True:
            try:
                async with asyncio.timeout_at(deadline_s):
                    payload, now_ns = await inbox.get()
            except TimeoutError:
                self._trouble(silence)
                silence, deadline_s = nothing, loop.time() + SILENCE_S
                continue
            try:
                report = report_from_json(payload, now_ns, self.epoch)
            except ProtocolError as error:
                silence = f"no usable pose for {SILENCE_S:g} s. {error}"
                self._bad_input(error)
                continue
            silence, deadline_s = nothing, loop.time() + SILENCE_S
            if not isinstance(report, RobotPose):
                self._status = report
                self._trouble(NO_PLACE_REASONS[report])
                continue
            self._status = report.status
            self.health.counters["poses"] += 1
            self.health.ok()
            out.put(report)

    def _bad_input(self, error: ProtocolError) -> None:
        level = logging.DEBUG if self.health.counters["bad_input"] else logging.WARNING
        self.health.counters["bad_input"] += 1
        _log.log(level, "%s: %s", self._key_expr, error)

    def _trouble(self, reason: str) -> None:
        level = logging.WARNING if self.health.trouble(reason) else logging.DEBUG
        _log.log(level, "%s: %s", self._key_expr, reason)
