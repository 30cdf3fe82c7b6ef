"""Poses and map of a ROS 2 robot over zenoh: rmw_zenoh or zenoh-bridge-ros2dds (formats.md, section 3)."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import Counter
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import zenoh

from vad.errors import ProtocolError
from vad.handover import Intake
from vad.health import Health
from vad.robot.floor_plan import FloorPlan
from vad.robot.pose import RobotPose, RobotStatus, status_now
from vad.robot.ros2 import LATCHED, ROS_TYPES, Frames, Kind, Ros2Reader
from vad.robot.ros2_keys import Style, key_expression, topic_name
from vad.robot.zenoh_link import opened, put_counted, subscribed
from vad.streams import DropOldestQueue

SILENCE_S = 2.0
RETRY_FIRST_S = 0.2
RETRY_FACTOR = 2.0
RETRY_MAX_S = 2.0
_INBOX = 256
_POSES = Intake(max_bytes=256 * 1024, per_s=2000.0, burst=1000, waiting=_INBOX)
_MAPS = Intake(max_bytes=32 * 1024 * 1024, per_s=10.0, burst=10, waiting=4)

PoseKind = Literal["tf", "pose", "pose_covariance", "odometry"]

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Ros2Topics:
    """What to listen to. pose_kind tf: `tf` and `tf_static`, else `pose_topic` has that kind of message.

    A topic that begins with a slash ignores the namespace. styles: the kinds of keys to subscribe to.
    """

    namespace: str = ""
    domain: int = 0
    styles: tuple[Style, ...] = ("rmw_zenoh", "bridge")
    pose_kind: PoseKind = "tf"
    pose_topic: str = ""
    map_topic: str = "map"
    frames: Frames = field(default_factory=Frames)

    def wanted(self) -> list[tuple[str, Kind]]:
        """Full topic names with what they carry; ConfigError for what is no topic."""
        topics: list[tuple[str, Kind]] = [(self.map_topic, "map")]
        if self.pose_kind == "tf":
            topics += [("tf", "tf"), ("tf_static", "tf_static")]
        else:
            topics += [(self.pose_topic, self.pose_kind)]
        return [(topic_name(topic, self.namespace), kind) for topic, kind in topics]


class Ros2Source:
    """A PoseSource and MapSource.

    Args:
        link: the robot's zenoh router, e.g. `tcp/192.168.1.20:7447`, or an open session, which stays the
            caller's.
        topics: what to listen to. epoch: of the robot's map.
    """

    def __init__(self, link: zenoh.Session | str, topics: Ros2Topics, *, epoch: int) -> None:
        where = link if isinstance(link, str) else "zenoh"
        self.health = Health(f"robot {where}")
        self.plans: DropOldestQueue[FloorPlan] = DropOldestQueue(1)
        self._link = link
        self._topics = topics
        self._wanted = topics.wanted()
        self._reader = Ros2Reader(topics.frames, epoch)

    @property
    def epoch(self) -> int:
        """The epoch stamped on poses and plans."""
        return self._reader.epoch

    @epoch.setter
    def epoch(self, epoch: int) -> None:
        self._reader.epoch = epoch

    @property
    def status(self) -> RobotStatus:
        """Whether the robot knows where it is."""
        return status_now(self._reader.status, self.health)

    async def run(self, out: DropOldestQueue[RobotPose]) -> None:
        """Emit poses into `out` until cancelled; trouble goes into `health`, never out of here."""
        retry_s = RETRY_FIRST_S
        while True:
            try:
                async with opened(self._link) as session:
                    retry_s = RETRY_FIRST_S
                    await self._listen(session, out)
            except zenoh.ZError as error:
                self._trouble(f"no zenoh router answers: {error}. Is the robot on, and rmw_zenohd running?")
            await asyncio.sleep(retry_s)
            retry_s = min(retry_s * RETRY_FACTOR, RETRY_MAX_S)

    async def _listen(self, session: zenoh.Session, out: DropOldestQueue[RobotPose]) -> None:
        inbox: DropOldestQueue[tuple[Kind, bytes, int]] = DropOldestQueue(_INBOX)
        with contextlib.ExitStack() as stack:
            for topic, kind in self._wanted:
                for style in self._topics.styles:
                    key = key_expression(topic, ROS_TYPES[kind], style=style, domain=self._topics.domain)
                    arrived = partial(_into, inbox, self.health.counters, kind)
                    stack.enter_context(
                        subscribed(
                            session,
                            key,
                            arrived,
                            intake=_MAPS if kind == "map" else _POSES,
                            counters=self.health.counters,
                            latched=kind in LATCHED,
                        )
                    )
            await self._read(inbox, out)

    async def _read(
        self, inbox: DropOldestQueue[tuple[Kind, bytes, int]], out: DropOldestQueue[RobotPose]
    ) -> None:
        loop = asyncio.get_running_loop()
        # AMCL says nothing while the robot stands.
        limit_s = None if self._topics.pose_kind == "pose_covariance" else SILENCE_S
        heard_s = loop.time()
        while True:
            deadline_s = None if limit_s is None else heard_s + limit_s
            try:
                async with asyncio.timeout_at(deadline_s):
                    kind, payload, arrival_ns = await inbox.get()
            except TimeoutError:
                self._silent()
                heard_s = loop.time()
                continue
            if self._take(kind, payload, arrival_ns, out):
                heard_s = loop.time()

    def _take(self, kind: Kind, payload: bytes, arrival_ns: int, out: DropOldestQueue[RobotPose]) -> bool:
        """Read one message; whether it brought a pose."""
        reader = self._reader
        try:
            if kind == "map":
                self.plans.put(reader.floor_plan(payload))
                self.health.counters["maps"] += 1
                return False
            pose = reader.pose(kind, payload, arrival_ns)
        except ProtocolError as error:
            level = logging.DEBUG if self.health.counters["bad_input"] else logging.WARNING
            self.health.counters["bad_input"] += 1
            _log.log(level, "%s: %s", kind, error)
            return False
        if pose is None:
            return False
        self.health.counters["poses"] += 1
        late_ms = (arrival_ns - pose.t_ns) / 1e6
        self.health.ok(f"{pose.quality} in frame {pose.frame}, {late_ms:.0f} ms later than the fastest")
        out.put(pose)
        return True

    def _silent(self) -> None:
        reader = self._reader
        if reader.status in ("not_localised", "lost") and reader.reason:
            self._trouble(reader.reason)
            return
        topics = ", ".join(f"/{topic}" for topic, kind in self._wanted if kind != "map")
        self._trouble(
            f"no pose for {SILENCE_S:g} s. Does the robot publish {topics} in domain {self._topics.domain}?"
        )

    def _trouble(self, reason: str) -> None:
        level = logging.WARNING if self.health.trouble(reason) else logging.DEBUG
        _log.log(level, "%s: %s", self.health.part, reason)


def _into(
    inbox: DropOldestQueue[tuple[Kind, bytes, int]],
    counters: Counter[str],
    kind: Kind,
    payload: bytes,
    arrival_ns: int,
) -> None:
    put_counted(inbox, counters, (kind, payload, arrival_ns))
