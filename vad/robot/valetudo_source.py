"""Poses and map of a robot with Valetudo, over server-sent events or a zenoh key (formats.md, section 4)."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import functools
import logging
import math
import time
from collections import Counter
from collections.abc import AsyncGenerator
from urllib.parse import SplitResult, unquote, urlsplit

import zenoh

from vad.errors import ConfigError, ProtocolError, SourceError
from vad.handover import Intake
from vad.health import Health
from vad.robot.floor_plan import FloorPlan
from vad.robot.pose import RobotPose, RobotStatus, status_now
from vad.robot.sse import MAX_HEAD_BYTES, ChunkedDecoder, SseParser, parse_head
from vad.robot.valetudo import ValetudoMap, map_from_payload
from vad.robot.zenoh_link import put_counted, subscribed
from vad.streams import DropOldestQueue

PATH = "/api/v2/robot/state/map/sse"
EVENT = "MapUpdated"
SIGMA_M = 0.05
SIGMA_YAW_RAD = math.radians(3.0)
CONNECT_S = 5.0
KEEP_ALIVE_S = 15.0
"""Three of Valetudo's keep-alives: after this long the connection is dead."""
ZENOH_SILENCE_S = 130.0
"""Two of the updates of a robot that rests."""
RETRY_FIRST_S = 0.5
RETRY_FACTOR = 2.0
RETRY_MAX_S = 5.0
_READ_BYTES = 65_536
_INTAKE = Intake(max_bytes=8 * 1024 * 1024, per_s=20.0, burst=20, waiting=4)
"""Of deflated maps, which are 10 to 100 KiB, every 2 s."""

Payload = tuple[bytes, int]

_NO_PLACE = "the robot is not on its map yet: let it clean once so that it finds itself"

_log = logging.getLogger(__name__)


class ValetudoSource:
    """A PoseSource and MapSource.

    Poses come every 2 s while the robot moves (faster from some), every 60 s while it rests; their time is
    the arrival.

    Args:
        link: the robot's URL, e.g. `http://192.168.1.30` (user:password@ where it asks for one), or an open
            zenoh session, which stays the caller's.
        key: with a session, where the maps are put, e.g. `valetudo/robot/MapData/map-data`.
        epoch: of the robot's map.
    """

    def __init__(self, link: zenoh.Session | str, key: str = "", *, epoch: int) -> None:
        self._host = ""
        if isinstance(link, str):
            self._url = urlsplit(link)
            if self._url.scheme not in ("http", "https") or not self._url.hostname:
                raise ConfigError(
                    "this is no address of a robot", where=link, remedy="Use http://192.168.1.30"
                )
            self._host = self._url.hostname
        self.health = Health(f"robot {self._host or key}")
        self._status: RobotStatus = "unknown"
        self.epoch = epoch
        self.plans: DropOldestQueue[FloorPlan] = DropOldestQueue(1)
        self._session = None if isinstance(link, str) else link
        self._key = key

    @property
    def status(self) -> RobotStatus:
        """Whether the robot knows where it is."""
        return status_now(self._status, self.health)

    async def run(self, out: DropOldestQueue[RobotPose]) -> None:
        """Emit poses into `out` until cancelled; trouble goes into `health`, never out of here."""
        retry_s = RETRY_FIRST_S
        while True:
            feed = (
                _from_zenoh(self._session, self._key, self.health.counters)
                if self._session
                else _from_sse(self._url)
            )
            try:
                async with contextlib.aclosing(feed) as payloads:
                    async for payload, arrival_ns in payloads:
                        retry_s = RETRY_FIRST_S
                        await self._take(payload, arrival_ns, out)
            except (OSError, zenoh.ZError, ProtocolError, SourceError) as error:
                self._trouble(_reason(error, self._host or self._key))
            await asyncio.sleep(retry_s)
            retry_s = min(retry_s * RETRY_FACTOR, RETRY_MAX_S)

    async def _take(self, payload: bytes, arrival_ns: int, out: DropOldestQueue[RobotPose]) -> None:
        try:
            # 1 to 8 ms for a map, more on a small hub: too long for the event loop
            found = await asyncio.to_thread(map_from_payload, payload, self.epoch)
        except ProtocolError as error:
            level = logging.DEBUG if self.health.counters["bad_input"] else logging.WARNING
            self.health.counters["bad_input"] += 1
            _log.log(level, "%s: %s", self.health.part, error)
            return
        self.health.counters["maps"] += 1
        self.plans.put(found.plan)
        pose = self._pose(found, arrival_ns)
        if pose is None:
            self._status = "not_localised"
            self._trouble(_NO_PLACE)
            return
        self._status = pose.status
        self.health.counters["poses"] += 1
        self.health.ok(f"{len(found.plan.rooms)} rooms, {pose.status}")
        out.put(pose)

    def _pose(self, found: ValetudoMap, arrival_ns: int) -> RobotPose | None:
        pose = found.pose
        if pose is None:
            return None
        return RobotPose(
            t_ns=arrival_ns,
            x_m=pose.x_m,
            y_m=pose.y_m,
            yaw_rad=0.0 if pose.yaw_rad is None else pose.yaw_rad,
            sigma_m=SIGMA_M,
            sigma_yaw_rad=math.pi if pose.yaw_rad is None else SIGMA_YAW_RAD,
            epoch=self.epoch,
            quality="slam",
            status="docked" if found.docked else "localised",
        )

    def _trouble(self, reason: str) -> None:
        level = logging.WARNING if self.health.trouble(reason) else logging.DEBUG
        _log.log(level, "%s: %s", self.health.part, reason)


async def _from_zenoh(
    session: zenoh.Session, key: str, counters: Counter[str]
) -> AsyncGenerator[Payload, None]:
    inbox: DropOldestQueue[Payload] = DropOldestQueue(4)
    arrived = functools.partial(_into, inbox, counters)
    with subscribed(session, key, arrived, intake=_INTAKE, counters=counters, latched=True):
        while True:
            try:
                async with asyncio.timeout(ZENOH_SILENCE_S):
                    payload = await inbox.get()
            except TimeoutError:
                raise SourceError(
                    f"no map for {ZENOH_SILENCE_S:.0f} s",
                    where=key,
                    remedy="Is this the key that Valetudo's MapData/map-data is relayed to?",
                ) from None
            yield payload


async def _from_sse(url: SplitResult) -> AsyncGenerator[Payload, None]:
    """The maps of one connection; ends when the server ends it."""
    secure = url.scheme == "https"
    port = url.port or (443 if secure else 80)
    async with asyncio.timeout(CONNECT_S):
        reader, writer = await asyncio.open_connection(
            url.hostname, port, ssl=secure or None, limit=MAX_HEAD_BYTES
        )
    try:
        writer.write(_request(url))
        chunked = await _open_stream(reader)
        decoder, parser = ChunkedDecoder(), SseParser()
        while not decoder.ended:
            async with asyncio.timeout(KEEP_ALIVE_S):
                data = await reader.read(_READ_BYTES)
            if not data:
                raise SourceError("the robot closed the connection")
            arrival_ns = time.monotonic_ns()
            for event in parser.feed(decoder.feed(data) if chunked else data):
                if event.name == EVENT:
                    yield event.data, arrival_ns
    finally:
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()


async def _open_stream(reader: asyncio.StreamReader) -> bool:
    """Read the response's head; whether its body is chunked."""
    try:
        async with asyncio.timeout(CONNECT_S):
            raw = await reader.readuntil(b"\r\n\r\n")
    except (asyncio.IncompleteReadError, asyncio.LimitOverrunError) as error:
        raise ProtocolError("this is no HTTP response") from error
    head = parse_head(raw[:-4])
    if head.status == 401:
        raise SourceError("the robot asks for a password", remedy="Use http://user:password@robot")
    if head.status != 200 or "text/event-stream" not in head.fields.get("content-type", ""):
        raise SourceError(
            f"HTTP {head.status} instead of map events", remedy="Is this Valetudo 2021.04 or newer?"
        )
    return head.fields.get("transfer-encoding", "").lower() == "chunked"


def _request(url: SplitResult) -> bytes:
    host = url.netloc.rpartition("@")[2]
    lines = [f"GET {url.path.rstrip('/')}{PATH} HTTP/1.1", f"Host: {host}", "Accept: text/event-stream"]
    if url.username is not None:
        both = f"{unquote(url.username)}:{unquote(url.password or '')}"
        lines.append(f"Authorization: Basic {base64.b64encode(both.encode()).decode()}")
    return "\r\n".join([*lines, "", ""]).encode()


def _into(inbox: DropOldestQueue[Payload], counters: Counter[str], payload: bytes, arrival_ns: int) -> None:
    put_counted(inbox, counters, (payload, arrival_ns))


def _reason(error: Exception, where: str) -> str:
    if isinstance(error, TimeoutError):
        return f"{where} is silent. Is the robot on, and is this its address?"
    if isinstance(error, OSError):
        return f"{where} cannot be reached: {error.strerror or error}. Is this the robot's address?"
    return str(error)
