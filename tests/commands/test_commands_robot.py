"""`vad robot watch`, `vad doctor`, `vad map import|export|show`: what people see, and exit codes."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import threading
import time
import tty
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner, Result
from waiting import free_port

from vad.bus import messages as m
from vad.bus.grid import grid_to_png
from vad.bus.node import Bus
from vad.bus.session import BusSettings
from vad.commands import robot as robot_commands
from vad.commands.app import app
from vad.commands.doctor import robot as doctor_robot
from vad.config import load_settings
from vad.robot.map_server import load_floor_plan
from vad.sim.neato import VirtualNeato
from vad.sim.valetudo import ValetudoServer

CONFIG = Path(__file__).parents[2] / "config"
REST: dict[str, Any] = {
    "camera": {"source": {"type": "v4l2", "device": "/dev/video0"}},
    "radio": {},
    "devices": {},
    "bus": {"listen": []},
}
SMALL_MAP = {
    "__class": "ValetudoMap",
    "size": {"x": 1000, "y": 800},
    "pixelSize": 5,
    "layers": [
        {"type": "wall", "pixels": [], "compressedPixels": [10, 20, 41]},
        {
            "type": "segment",
            "metaData": {"segmentId": "3", "name": "Küche"},
            "compressedPixels": [v for y in range(21, 60) for v in (10, y, 40)],
        },
    ],
    "entities": [{"type": "robot_position", "points": [150, 200], "metaData": {"angle": 0}}],
}


def run(*arguments: str, code: int = 0) -> Result:
    result = CliRunner().invoke(app, list(arguments), env={"COLUMNS": "200"})
    assert result.exit_code == code, (result.output, result.exception)
    return result


@contextlib.contextmanager
def playing(play: Callable[[asyncio.Event], Coroutine[Any, Any, None]]) -> Iterator[None]:
    """An emulator on an event loop of its own, while the command has the test's thread."""
    ready, stop, loops = threading.Event(), asyncio.Event(), []

    async def main() -> None:
        loops.append(asyncio.get_running_loop())
        async with asyncio.TaskGroup() as group:
            begun = asyncio.Event()
            task = group.create_task(play(begun))
            await begun.wait()
            ready.set()
            await stop.wait()
            task.cancel()

    thread = threading.Thread(target=lambda: asyncio.run(main()))
    thread.start()
    assert ready.wait(40)
    try:
        yield
    finally:
        loops[0].call_soon_threadsafe(stop.set)
        thread.join(40)


@contextlib.contextmanager
def neato(link: Path) -> Iterator[None]:
    async def play(begun: asyncio.Event) -> None:
        robot = VirtualNeato(lambda _t_ns: (1.5, -0.5, 0.25), link=link)
        begun.set()
        await robot.run()

    with playing(play):
        yield


def settings(folder: Path, robot: dict[str, Any], **sections: Any) -> str:
    path = folder / "vad.yaml"
    path.write_text(yaml.safe_dump(REST | {"robot": robot} | sections))
    return str(path)


@pytest.fixture
def floor(tmp_path: Path) -> dict[str, str]:
    source = tmp_path / "robot.json"
    source.write_text(json.dumps(SMALL_MAP))
    run("map", "import", str(source), str(tmp_path / "floor.yaml"))
    return {"file": "floor.yaml"}


class PoseClock:
    """Time that passes 0.2 s with every pose that is taken, however busy the machine."""

    def __init__(self) -> None:
        self._ns = time.monotonic_ns()

    def monotonic_ns(self) -> int:
        self._ns += 200_000_000
        return self._ns

    def monotonic(self) -> float:
        return self._ns / 1e9


def test_watch_shows_poses_rate_and_age(
    tmp_path: Path, floor: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(robot_commands, "time", PoseClock())
    link = tmp_path / "tty"
    config = settings(tmp_path, {"type": "neato", "port": str(link)}, map=floor)
    with neato(link):
        lines = run("robot", "watch", "--config", config, "--for", "1.5", "--json").stdout.splitlines()
        table = run("robot", "watch", "--config", config, "--for", "1").stdout
    assert len(lines) == 8
    last = json.loads(lines[-1])
    assert (last["x_m"], last["y_m"], last["quality"], last["status"]) == (1.5, -0.5, "slam", "localised")
    assert last["rate_hz"] == pytest.approx(5.0)
    for said in ("localised", "x   1.500 m", "5.0 Hz", "old when it comes", "answers in"):
        assert said in table


def test_watch_says_what_is_wrong(tmp_path: Path, floor: dict[str, str]) -> None:
    config = settings(tmp_path, {"type": "neato", "port": str(tmp_path / "nothing")}, map=floor)
    result = run("robot", "watch", "--config", config, "--for", "3", code=1)
    assert "Is the adapter plugged in?" in result.stderr


def test_doctor_finds_nothing_wrong(
    tmp_path: Path, floor: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor_robot, "RATE_S", 4.0)
    link = tmp_path / "tty"
    # Half of the rate is enough: a machine that is busy for 2 s on end still keeps it.
    config = settings(tmp_path, {"type": "neato", "port": str(link), "rate_hz": 1.0}, map=floor)
    with neato(link):
        only = ("--only", "map", "--only", "robot", "--listen", "40")
        told = run("doctor", "--config", config, *only).stdout
    assert told.count("✓") == 3
    assert "1 rooms" in told
    assert "nothing is wrong" in told


def test_doctor_on_a_port_that_is_missing_and_a_plan_that_is_none(tmp_path: Path) -> None:
    robot = {"type": "neato", "port": str(tmp_path / "nothing")}
    config = settings(tmp_path, robot, map={"file": "floor.yaml"})
    only = ("--only", "map", "--only", "robot", "--json")
    found = json.loads(run("doctor", "--config", config, *only, code=1).stdout)
    assert {(f["check"], f["verdict"]) for f in found} == {("floor plan", "bad"), ("serial port", "bad")}
    assert all(f["remedy"] for f in found)


def test_doctor_on_a_port_without_permission(
    tmp_path: Path, floor: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    port = tmp_path / "tty"
    port.touch()
    # Root may open everything: what the kernel would tell another user.
    monkeypatch.setattr(doctor_robot, "access", lambda *_: False)
    config = settings(tmp_path, {"type": "neato", "port": str(port)}, map=floor)
    told = run("doctor", "--config", config, "--only", "robot", code=1).stdout
    assert "may not be read and written" in told
    assert "usermod -aG" in told


def test_doctor_on_a_wrong_baud_rate(tmp_path: Path, floor: dict[str, str]) -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    ended = threading.Event()

    def babble() -> None:
        while not ended.wait(0.05):
            os.write(master, bytes(range(128, 160)))

    thread = threading.Thread(target=babble)
    thread.start()
    config = settings(tmp_path, {"type": "neato", "port": os.ttyname(slave)}, map=floor)
    try:
        told = run("doctor", "--config", config, "--listen", "8", "--only", "robot", code=1).stdout
    finally:
        ended.set()
        thread.join()
        os.close(master)
        os.close(slave)
    assert "bytes come but nothing is understood" in told
    assert "baud rate" in told


@pytest.mark.slow
def test_doctor_on_everything_of_a_machine_that_is_no_hub(tmp_path: Path) -> None:
    config = settings(
        tmp_path, {"type": "neato", "port": str(tmp_path / "nothing")}, map={"file": "none.yaml"}
    )
    found = json.loads(run("doctor", "--config", config, "--listen", "0.3", "--json", code=1).stdout)
    checks = {f["check"] for f in found}
    assert checks >= {"settings", "state", "disk", "clock", "networks", "processor", "floor plan", "camera"}
    assert all(f["remedy"] or f["verdict"] == "ok" for f in found)


def test_doctor_knows_its_checks(tmp_path: Path) -> None:
    config = settings(tmp_path, {"type": "neato", "port": "/dev/none"}, map={"file": "none.yaml"})
    told = run("doctor", "--config", config, "--only", "robots", code=2).stderr
    assert "There are settings, daemon" in told


def test_doctor_without_router_and_without_map(tmp_path: Path) -> None:
    config = settings(tmp_path, {"type": "ros2", "endpoint": "tcp/127.0.0.1:9"})
    told = run("doctor", "--config", config, "--listen", "0.6", "--only", "robot", code=1).stdout
    assert "zenoh router" in told
    assert "rmw_zenohd" in told
    assert "none came in 0.6 s" in told


def test_doctor_takes_the_map_of_the_robot(tmp_path: Path) -> None:
    urls: list[str] = []

    async def play(begun: asyncio.Event) -> None:
        async with ValetudoServer() as robot:
            await robot.publish(json.dumps(SMALL_MAP).encode())
            urls.append(robot.url)
            begun.set()
            await asyncio.Event().wait()

    with playing(play):
        config = settings(tmp_path, {"type": "valetudo", "url": urls[0]})
        told = run("doctor", "--config", config, "--listen", "40", "--only", "robot").stdout
    assert "robot's map" in told
    assert told.count("✓") == 2


def test_import_and_show(tmp_path: Path, floor: dict[str, str]) -> None:
    plan = load_floor_plan(tmp_path / floor["file"], epoch=1)
    assert [room.name for room in plan.rooms] == ["Küche"]
    picture = tmp_path / "floor.png"
    told = run("map", "show", str(tmp_path / floor["file"]), "--png", str(picture)).stdout
    assert "Küche" in told
    assert "3.9 m² free" in told
    assert picture.read_bytes().startswith(b"\x89PNG")
    rooms = tmp_path / "rooms.yaml"
    rooms.write_text("rooms: [{name: Bad, polygon_m: [[0, 0], [1, 0], [1, 1]]}]")
    other = tmp_path / "other.yaml"
    run("map", "import", str(tmp_path / "floor.yaml"), str(other), "--rooms", str(rooms))
    assert [room.name for room in load_floor_plan(other, epoch=1).rooms] == ["Bad"]


def test_files_that_are_no_map_are_told(tmp_path: Path) -> None:
    rubbish = tmp_path / "rubbish.json"
    rubbish.write_text("[]")
    to = str(tmp_path / "floor.yaml")
    assert "no Valetudo map" in run("map", "import", str(rubbish), to, code=2).stderr
    assert "cannot be read" in run("map", "import", str(tmp_path / "none"), to, code=2).stderr
    assert ".yaml" in run("map", "show", str(tmp_path / "none.yaml"), code=2).stderr


def test_export_writes_what_the_daemon_uses(tmp_path: Path, floor: dict[str, str]) -> None:
    plan = load_floor_plan(tmp_path / floor["file"], epoch=1)
    rows, columns = plan.cells.shape
    endpoints: list[str] = []

    async def play(begun: asyncio.Event) -> None:
        endpoints.append(f"tcp/127.0.0.1:{free_port()}")
        bus = Bus(BusSettings(listen=(endpoints[0],)))
        await bus.open()
        try:
            room = m.Room(name="Küche", polygon_m=((0.0, 0.0), (1.0, 0.0), (1.0, 1.0)))
            bus.publish_map(
                m.MapMessage(
                    source="live",
                    epoch=1,
                    bounds_m=plan.bounds_m,
                    resolution_m=plan.resolution_m,
                    origin=plan.origin,
                    width=columns,
                    height=rows,
                    rooms=(room,),
                )
            )
            bus.publish_grid(grid_to_png(plan.cells))
            begun.set()
            await asyncio.Event().wait()
        finally:
            await bus.close()

    to = tmp_path / "exported.yaml"
    with playing(play):
        run("map", "export", str(to), "--endpoint", endpoints[0])
    again = load_floor_plan(to, epoch=1)
    np.testing.assert_array_equal(again.cells, plan.cells)
    assert again.origin == pytest.approx(plan.origin)
    assert again.rooms[0].name == "Küche"


def test_every_example_of_a_robot_can_be_used() -> None:
    kinds = {}
    for path in sorted(CONFIG.glob("*.yaml")):
        if path.stem == "agent":
            continue  # of another program: vad agent
        kinds[path.stem] = type(load_settings(path).robot).__name__
    assert kinds.items() >= {
        ("neato-usb", "NeatoRobot"),
        ("roomba", "RoombaRobot"),
        ("turtlebot4", "Ros2Robot"),
        ("valetudo", "ValetudoRobot"),
    }


@pytest.mark.parametrize(
    ("robot", "what"),
    [
        ({"type": "neato", "port": "/dev/null"}, "there is no floor plan"),
        ({"type": "valetudo"}, "either url or key"),
        ({"type": "ros2", "pose": "odometry"}, "pose_topic"),
        ({"type": "ros2", "pose_topic": "amcl_pose"}, "pose_topic"),
    ],
)
def test_settings_that_do_not_go_together_are_refused(
    tmp_path: Path, robot: dict[str, Any], what: str
) -> None:
    assert what in run("doctor", "--config", settings(tmp_path, robot), code=2).stderr
