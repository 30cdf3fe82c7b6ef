"""ValetudoSource against a server of events, and against a zenoh key."""

from __future__ import annotations

import asyncio
import contextlib
import json
import zlib
from collections.abc import AsyncIterator

import pytest
import zenoh
from test_robot_valetudo import SMALL
from waiting import free_port, until

from vad.errors import ConfigError
from vad.robot.pose import MapSource, RobotPose
from vad.robot.valetudo_source import ValetudoSource
from vad.sim.valetudo import ValetudoServer
from vad.streams import DropOldestQueue

MAP = json.dumps(SMALL).encode()
Poses = DropOldestQueue[RobotPose]


@contextlib.asynccontextmanager
async def running(source: ValetudoSource, out: Poses) -> AsyncIterator[None]:
    task = asyncio.ensure_future(source.run(out))
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        assert task.cancelled()


async def take(out: Poses, timeout_s: float = 40.0) -> RobotPose:
    async with asyncio.timeout(timeout_s):
        return await out.get()


async def test_maps_and_poses_come_and_a_cut_connection_comes_back() -> None:
    out: Poses = DropOldestQueue(8)
    async with ValetudoServer(password="vad:s3cret", keep_alive_s=0.1) as robot:
        await robot.publish(MAP)
        source = ValetudoSource(robot.url, epoch=3)
        assert isinstance(source, MapSource)
        async with running(source, out):
            pose = await take(out)
            assert (pose.x_m, pose.y_m, pose.epoch, pose.status) == (1.5, 6.0, 3, "docked")
            assert source.plans.drain()[0].rooms[0].name == "Küche"
            moved = json.loads(MAP)
            moved["entities"][0]["points"] = [250, 200]
            await robot.publish(json.dumps(moved).encode())
            pose = await take(out)
            assert (pose.x_m, source.status) == (2.5, "localised")
            await robot.cut_off()
            assert (await take(out)).x_m == 2.5
            await robot.publish(b'{"nonsense": 1}')
            await until(lambda: source.health.counters["bad_input"] >= 1)
            await robot.publish(json.dumps(moved | {"entities": []}).encode())
            await until(lambda: source.status == "not_localised")
            assert "let it clean once" in source.health.detail
    assert robot.listeners == 0


async def test_a_robot_that_is_not_there_or_wants_a_password_is_told() -> None:
    async with ValetudoServer(free_port(), password="vad:s3cret") as robot:
        source = ValetudoSource(f"http://127.0.0.1:{robot.port}", epoch=0)
        async with running(source, DropOldestQueue(1)):
            await until(lambda: "password" in source.health.detail)
    source = ValetudoSource(f"http://127.0.0.1:{robot.port}", epoch=0)
    async with running(source, DropOldestQueue(1)):
        await until(lambda: "cannot be reached" in source.health.detail)


async def test_another_server_is_told() -> None:
    async def greet(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"SSH-2.0-dropbear\r\n\r\n")
        # A request that nobody has read would reset the connection, and take the greeting with it.
        with contextlib.suppress(OSError, asyncio.IncompleteReadError):
            await reader.readuntil(b"\r\n\r\n")
        writer.close()

    server = await asyncio.start_server(greet, "127.0.0.1", 0)
    async with server:
        port = server.sockets[0].getsockname()[1]
        source = ValetudoSource(f"http://127.0.0.1:{port}", epoch=0)
        async with running(source, DropOldestQueue(1)):
            await until(lambda: "no HTTP" in source.health.detail)


async def test_the_same_map_over_a_zenoh_key() -> None:
    out: Poses = DropOldestQueue(8)
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    with zenoh.open(config) as session:
        source = ValetudoSource(session, "valetudo/robot/MapData/map-data", epoch=1)
        async with running(source, out):
            await asyncio.sleep(0)
            session.put("valetudo/robot/MapData/map-data", zlib.compress(MAP))
            assert (await take(out)).y_m == 6.0


@pytest.mark.parametrize("url", ["robot.local", "ftp://robot", "http://"])
def test_addresses_that_are_none_are_refused(url: str) -> None:
    with pytest.raises(ConfigError):
        ValetudoSource(url, epoch=0)
