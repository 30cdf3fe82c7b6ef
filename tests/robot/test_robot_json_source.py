"""JSON poses: the schema, refusals, and the way over a real zenoh session."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import time
from collections.abc import Iterator

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from waiting import until

from vad.errors import ProtocolError
from vad.robot.json_source import MAX_AGE_NS, pose_from_json
from vad.robot.pose import RobotPose
from vad.robot.zenoh_source import ZenohPoseSource
from vad.streams import DropOldestQueue

NOW_NS = 10**12


def payload(**values: object) -> bytes:
    return json.dumps({"x_m": 1.5, "y_m": -2, "yaw_rad": 0.5} | values).encode()


def test_the_least_message() -> None:
    pose = pose_from_json(payload(battery=0.7), NOW_NS, epoch=4)
    assert (pose.t_ns, pose.x_m, pose.y_m, pose.yaw_rad, pose.epoch) == (NOW_NS, 1.5, -2.0, 0.5, 4)
    assert pose.sigma_m > 0
    assert pose.sigma_yaw_rad > 0


def test_the_whole_message() -> None:
    pose = pose_from_json(payload(sigma_m=0.1, sigma_yaw_rad=0.2, t_ns=NOW_NS - 7), NOW_NS, epoch=0)
    assert (pose.sigma_m, pose.sigma_yaw_rad, pose.t_ns) == (0.1, 0.2, NOW_NS - 7)


@given(st.floats(-math.tau, math.tau))
def test_the_yaw_is_wrapped(yaw_rad: float) -> None:
    got = pose_from_json(payload(yaw_rad=yaw_rad), NOW_NS, 0).yaw_rad
    assert -math.pi <= got <= math.pi
    assert math.remainder(got - yaw_rad, math.tau) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(
    ("data", "what"),
    [
        (b"", "not a pose"),
        (b"\xff", "not a pose"),
        (b"[1, 2, 3]", "not a pose"),
        (b'{"x_m": 1}', "not a pose"),
        (payload(x_m="1"), "not a pose"),
        (payload(x_m=None), "not a pose"),
        (payload(y_m=1e6), "outside any home"),
        (payload(yaw_rad=90), "yaw_rad"),
        (payload(sigma_m=0), "sigma"),
        (payload(sigma_yaw_rad=-1), "sigma"),
        (payload(t_ns=NOW_NS - MAX_AGE_NS - 1), "CLOCK_MONOTONIC"),
        (payload(t_ns=NOW_NS + 10**9), "CLOCK_MONOTONIC"),
        (payload(t_ns=1.5), "not a pose"),
        (payload(note="x" * 5000), "more than"),
    ],
)
def test_refusals_are_typed_and_name_a_remedy(data: bytes, what: str) -> None:
    with pytest.raises(ProtocolError, match=what) as caught:
        pose_from_json(data, NOW_NS, 0)
    assert caught.value.remedy


@given(st.binary(max_size=100) | st.dictionaries(st.sampled_from(["x_m", "y_m", "yaw_rad"]), st.floats()).map(
    lambda values: json.dumps(values).encode()
))  # fmt: skip
def test_any_bytes_give_a_pose_or_a_typed_error(data: bytes) -> None:
    try:
        pose = pose_from_json(data, NOW_NS, 0)
    except ProtocolError:
        return
    assert math.isfinite(pose.x_m + pose.y_m + pose.yaw_rad)


@pytest.fixture
def session() -> Iterator[zenoh.Session]:
    """A session that talks to nobody else."""
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")
    with zenoh.open(config) as opened:
        yield opened


async def test_poses_over_zenoh(session: zenoh.Session, caplog: pytest.LogCaptureFixture) -> None:
    source = ZenohPoseSource(session, "home/robot/*", epoch=2)
    out: DropOldestQueue[RobotPose] = DropOldestQueue(8)
    task = asyncio.create_task(source.run(out))
    try:
        await asyncio.sleep(0)
        before_ns = time.monotonic_ns()
        session.put("home/robot/pose", b"rubbish")
        session.put("home/robot/pose", b"more")
        session.put("home/robot/pose", payload(x_m=3))
        async with asyncio.timeout(40):
            pose = await out.get()
        assert (pose.x_m, pose.epoch) == (3.0, 2)
        assert before_ns <= pose.t_ns <= time.monotonic_ns()
        assert source.health.state == "ok"
        assert source.health.counters["bad_input"] == 2
        assert [r.levelname for r in caplog.records if "not a pose" in r.getMessage()] == ["WARNING"]
        await until(lambda: "no pose for 2 s" in source.health.detail)
        assert source.health.state == "degraded"
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
    session.put("home/robot/pose", payload())
    assert len(out) == 0


async def test_a_closed_session_is_trouble_not_an_end(session: zenoh.Session) -> None:
    session.close()
    source = ZenohPoseSource(session, "home/robot/pose", epoch=0)
    task = asyncio.create_task(source.run(DropOldestQueue(1)))
    await until(lambda: source.health.state == "degraded")
    assert "cannot subscribe" in source.health.detail
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
