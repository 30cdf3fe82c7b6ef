"""Poses of home-made robots as JSON: bytes -> values, no I/O.

Schema, one object per message:

| key | type | what |
|---|---|---|
| x_m, y_m | number | centre of rotation in the map frame, metres |
| yaw_rad | number | counter-clockwise from map x, -2 pi .. 2 pi |
| sigma_m | number > 0, optional | standard deviation of x and y; 0.05 if absent |
| sigma_yaw_rad | number > 0, optional | standard deviation of the yaw; 0.05 if absent |
| t_ns | integer, optional | CLOCK_MONOTONIC of the hub; only for a robot program that runs on the hub |
| status | text, optional | `localised` if absent, `docked`; `not_localised`, `lifted`, `lost`: no place |

Other keys are ignored. Without t_ns the time of arrival counts. A robot says where it is 2 to 50 times a
second, at rest too; after 2 s without a pose it counts as silent.
"""

from __future__ import annotations

import math
from typing import Literal

import msgspec

from vad.errors import ProtocolError
from vad.limits import UNREADABLE, check_depth
from vad.robot.pose import RobotPose

NoPlace = Literal["not_localised", "lifted", "lost"]
NO_PLACE_REASONS: dict[NoPlace, str] = {
    "not_localised": "the robot says that it has no place on its map yet",
    "lifted": "the robot says that it was lifted: set it down",
    "lost": "the robot says that it is lost: bring it to its dock",
}

SIGMA_M = 0.05
SIGMA_YAW_RAD = 0.05
MAX_COORDINATE_M = 1000.0
MAX_AGE_NS = 5_000_000_000
MAX_AHEAD_NS = 50_000_000
MAX_PAYLOAD_BYTES = 4096

_SCHEMA = 'Send e.g. {"x_m": 1.2, "y_m": -0.4, "yaw_rad": 1.57}'


class _Message(msgspec.Struct):
    x_m: float
    y_m: float
    yaw_rad: float
    sigma_m: float = SIGMA_M
    sigma_yaw_rad: float = SIGMA_YAW_RAD
    t_ns: int | None = None
    status: Literal["localised", "docked"] = "localised"


class _Status(msgspec.Struct):
    status: Literal["localised", "docked", "not_localised", "lifted", "lost"] = "localised"


_decoder = msgspec.json.Decoder(_Message)
_status_decoder = msgspec.json.Decoder(_Status)


def report_from_json(payload: bytes, now_ns: int, epoch: int) -> RobotPose | NoPlace:
    """A pose as `pose_from_json` reads it, or why the robot has none; ProtocolError for anything else."""
    if len(payload) <= MAX_PAYLOAD_BYTES:
        check_depth(payload)
        try:
            status = _status_decoder.decode(payload).status
        except UNREADABLE as error:
            raise ProtocolError(f"not a pose: {error}", remedy=_SCHEMA) from error
        if status != "localised" and status != "docked":
            return status
    return pose_from_json(payload, now_ns, epoch)


def pose_from_json(payload: bytes, now_ns: int, epoch: int) -> RobotPose:
    """The pose in one message that arrived at `now_ns` (timeline); ProtocolError for anything else."""
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise ProtocolError(f"a pose of more than {MAX_PAYLOAD_BYTES} bytes", remedy=_SCHEMA)
    check_depth(payload)
    try:
        message = _decoder.decode(payload)
    except UNREADABLE as error:
        raise ProtocolError(f"not a pose: {error}", remedy=_SCHEMA) from error
    _check(message, now_ns)
    return RobotPose(
        t_ns=now_ns if message.t_ns is None else message.t_ns,
        x_m=message.x_m,
        y_m=message.y_m,
        yaw_rad=math.remainder(message.yaw_rad, math.tau),
        sigma_m=message.sigma_m,
        sigma_yaw_rad=message.sigma_yaw_rad,
        epoch=epoch,
        quality="slam",
        status=message.status,
    )


def _check(message: _Message, now_ns: int) -> None:
    if not max(abs(message.x_m), abs(message.y_m)) <= MAX_COORDINATE_M:
        raise ProtocolError("x_m or y_m is outside any home", remedy="Send metres in the map frame")
    if not abs(message.yaw_rad) <= math.tau:
        raise ProtocolError("yaw_rad is outside -2 pi .. 2 pi", remedy="Send radians, wrapped to one turn")
    if not (0 < message.sigma_m < math.inf and 0 < message.sigma_yaw_rad < math.inf):
        raise ProtocolError("sigma_m and sigma_yaw_rad must be above 0", remedy="Leave them out if unknown")
    if message.t_ns is not None and not -MAX_AHEAD_NS <= now_ns - message.t_ns <= MAX_AGE_NS:
        raise ProtocolError(
            "t_ns is not the hub's present CLOCK_MONOTONIC",
            remedy="Leave t_ns out unless the robot's program runs on the hub",
        )
