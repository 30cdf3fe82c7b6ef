"""Ros2Source against a real zenoh router that goes away and comes back."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Any

import numpy as np
import pytest
import ros2_messages as ros
import zenoh
import zenoh.ext
from waiting import free_port, until

from vad.robot.pose import RobotPose
from vad.robot.ros2_source import Ros2Source, Ros2Topics
from vad.streams import DropOldestQueue

HASH = "RIHS01_00112233"
CELLS = np.arange(12, dtype=np.int8).reshape(3, 4)


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@contextlib.contextmanager
def router(endpoint: str) -> Iterator[zenoh.Session]:
    """A router with the robot in the same session."""
    config = zenoh.Config()
    for key, value in {
        "mode": "router",
        "listen/endpoints": [endpoint],
        "scouting/delay": 0,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    config.insert_json5("timestamping/enabled", "true")
    session = zenoh.open(config)
    try:
        yield session
    finally:
        session.close()  # type: ignore[no-untyped-call]


def rmw(topic: str, kind: str, domain: int = 0) -> str:
    package, _, name = kind.split("/")
    return f"{domain}/{topic}/{package}::msg::dds_::{name}_/{HASH}"


def latched(session: zenoh.Session, key: str) -> Any:
    return zenoh.ext.declare_advanced_publisher(
        session, key, cache=zenoh.ext.CacheConfig(1), publisher_detection=True
    )


@contextlib.asynccontextmanager
async def running(source: Ros2Source, out: DropOldestQueue[RobotPose]) -> AsyncIterator[None]:
    task = asyncio.ensure_future(source.run(out))
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        assert task.cancelled()


@contextlib.asynccontextmanager
async def driving(session: zenoh.Session, key: str, make: Callable[[int], bytes]) -> AsyncIterator[None]:
    """Puts a message every 50 ms, as a robot does."""

    async def drive() -> None:
        while True:
            session.put(key, make(time.time_ns()))
            await asyncio.sleep(0.05)

    task = asyncio.ensure_future(drive())
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


def drive_tf(stamp_ns: int) -> bytes:
    links = (("map", "odom", 2.0, 0.0, 0.0), ("odom", "base_link", 1.0, 0.5, 0.0))
    return ros.tf(*links, stamp_ns=stamp_ns)


async def take(out: DropOldestQueue[RobotPose], timeout_s: float = 40.0) -> RobotPose:
    async with asyncio.timeout(timeout_s):
        return await out.get()


@pytest.mark.parametrize("style", ["rmw_zenoh", "bridge"])
async def test_poses_and_a_map_that_was_there_before(endpoint: str, style: str) -> None:
    is_rmw = style == "rmw_zenoh"
    map_key = rmw("robot1/map", "nav_msgs/msg/OccupancyGrid", 7) if is_rmw else "robot1/map"
    tf_key = rmw("robot1/tf", "tf2_msgs/msg/TFMessage", 7) if is_rmw else "robot1/tf"
    with router(endpoint) as robot:
        keeper = latched(robot, map_key)
        keeper.put(ros.grid(CELLS))
        source = Ros2Source(endpoint, Ros2Topics(namespace="robot1", domain=7), epoch=5)
        out: DropOldestQueue[RobotPose] = DropOldestQueue(64)
        async with running(source, out), driving(robot, tf_key, drive_tf):
            before_ns = time.monotonic_ns()
            pose = await take(out)
            async with asyncio.timeout(40):
                plan = await source.plans.get()
            await until(lambda: source.health.state == "ok" and source.status == "localised")
        assert (pose.x_m, pose.y_m, pose.epoch) == (3.0, 0.5, 5)
        assert before_ns - 10**9 < pose.t_ns <= time.monotonic_ns()
        np.testing.assert_array_equal(plan.cells, CELLS)
        keeper.undeclare()


async def test_the_router_is_restarted(endpoint: str) -> None:
    source = Ros2Source(endpoint, Ros2Topics(), epoch=0)
    out: DropOldestQueue[RobotPose] = DropOldestQueue(64)
    tf_key, map_key = rmw("tf", "tf2_msgs/msg/TFMessage"), rmw("map", "nav_msgs/msg/OccupancyGrid")
    async with running(source, out):
        # Nobody is there yet.
        await until(lambda: source.health.state == "degraded")
        assert "rmw_zenohd" in source.health.detail
        with router(endpoint) as robot:
            async with driving(robot, tf_key, drive_tf):
                await take(out)
        await until(lambda: source.health.state == "degraded")
        assert source.status == "lost"
        out.drain()
        with router(endpoint) as robot:
            async with driving(robot, tf_key, drive_tf):
                await take(out)
                await until(lambda: source.health.state == "ok")
                # The map comes long after the robot was found.
                keeper = latched(robot, map_key)
                keeper.put(ros.grid(CELLS))
                async with asyncio.timeout(40):
                    plan = await source.plans.get()
                keeper.undeclare()
    np.testing.assert_array_equal(plan.cells, CELLS)


async def test_rubbish_is_counted_and_other_topics_are_left_alone(endpoint: str) -> None:
    with router(endpoint) as robot:
        source = Ros2Source(endpoint, Ros2Topics(pose_kind="pose", pose_topic="pose"), epoch=0)
        out: DropOldestQueue[RobotPose] = DropOldestQueue(64)
        turns = iter(range(10**6))

        def mixed(stamp_ns: int) -> bytes:
            good = ros.pose_stamped(1, 1, 0, stamp_ns=stamp_ns)
            return good if next(turns) % 2 else good[:-9]

        async with running(source, out), driving(robot, "pose", mixed):
            await take(out)
            await take(out)
            assert source.health.counters["bad_input"] >= 1
            await until(lambda: source.health.state == "ok")
