"""The simulated home from outside: the files it writes, and every interface as a stranger would use it."""

from __future__ import annotations

import asyncio
import json
import os
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from waiting import until

from vad.config import FollowCsi, MjpegCameraSettings, NeatoRobot, Settings, load_settings
from vad.csi.attribution import Attribution
from vad.csi.logfile import read_log
from vad.mac import mac_from_text
from vad.robot.floor_plan import FREE, OCCUPIED
from vad.robot.map_server import load_floor_plan
from vad.sim.home import PLAN_STEP_M, SimulatedHome, floor_plan
from vad.sim.scenario import make_home

HOME = make_home(2, walks=2)
WALK = HOME.walks[0]
TIMEOUT_S = 40.0


@asynccontextmanager
async def played(folder: Path, start_at_s: float = 0.0) -> AsyncIterator[Settings]:
    """The settings of a home that is played meanwhile."""
    ready = asyncio.Event()
    home = SimulatedHome(HOME, folder, bus_port=7999, connector=False, start_at_s=start_at_s)
    task = asyncio.create_task(home.run(ready))
    opened = asyncio.create_task(ready.wait())
    try:
        await asyncio.wait({task, opened}, return_when=asyncio.FIRST_COMPLETED, timeout=TIMEOUT_S)
        assert ready.is_set()
        yield load_settings(folder / "vad.yaml")
    finally:
        opened.cancel()
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


async def ask_robot(port: str) -> str:
    """The robot's answer to one command."""
    loop = asyncio.get_running_loop()
    line = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    said = bytearray()
    answered = asyncio.Event()

    def readable() -> None:
        said.extend(os.read(line, 4096))
        if b"\x1a" in said:
            answered.set()

    loop.add_reader(line, readable)
    try:
        os.write(line, b"GetRobotPos Smooth\n")
        await asyncio.wait_for(answered.wait(), TIMEOUT_S)
    finally:
        loop.remove_reader(line)
        os.close(line)
    return said.decode("ascii")


async def pictures(url: str, count: int) -> list[np.ndarray]:
    """The next pictures of the camera's stream."""
    host, port = url.removeprefix("http://").split("/")[0].split(":")
    reader, writer = await asyncio.open_connection(host, int(port), limit=1 << 20)
    found = []
    try:
        writer.write(f"GET /{url.split('/', 3)[3]} HTTP/1.0\r\nHost: {host}\r\n\r\n".encode())
        async with asyncio.timeout(TIMEOUT_S):
            while len(found) < count:
                head = await reader.readuntil(b"\r\n\r\n")
                lengths = [line for line in head.split(b"\r\n") if line.startswith(b"Content-Length:")]
                if not lengths:
                    continue  # the answer's own head
                data = await reader.readexactly(int(lengths[0].split(b":")[1]))
                picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
                assert picture is not None
                found.append(picture)
    finally:
        writer.close()
    return found


async def ask_hostapd(path: Path, own: Path, *commands: str) -> list[str]:
    """hostapd's answers, from a socket of our own."""
    loop = asyncio.get_running_loop()
    answers = []
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.setblocking(False)
        sock.bind(str(own))
        async with asyncio.timeout(TIMEOUT_S):
            await until(path.exists)
            sock.connect(str(path))
            for command in commands:
                await loop.sock_sendall(sock, command.encode())
                answers.append((await loop.sock_recv(sock, 4096)).decode())
    return answers


async def read_fifo(path: Path, size: int) -> bytes:
    """The next bytes of the CSI log."""
    fifo = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    data = b""
    try:
        async with asyncio.timeout(TIMEOUT_S):
            while len(data) < size:
                with suppress(BlockingIOError):
                    data += os.read(fifo, 1 << 16)
                await asyncio.sleep(0.01)
    finally:
        os.close(fifo)
    return data


def test_the_floor_plan_shows_walls_rooms_and_free_floor() -> None:
    plan = floor_plan(HOME)
    x0, y0, x1, y1 = HOME.plan_m
    assert plan.bounds_m == pytest.approx((x0, y0, x1, y1), abs=PLAN_STEP_M)

    def cell(x_m: float, y_m: float) -> int:
        return int(plan.cells[int((y_m - y0) / PLAN_STEP_M), int((x_m - x0) / PLAN_STEP_M)])

    for x, y in HOME.robot_path_m:
        assert cell(x, y) == FREE, "the robot drives on free floor"
    middle_y = (y0 + y1) / 2
    for x, y in ((x0, middle_y), (x1 - 0.01, middle_y), ((x0 + x1) / 2, y0), ((x0 + x1) / 2, y1 - 0.01)):
        assert cell(x, y) == OCCUPIED, "walls all around"
    assert cell(HOME.room_m[2], middle_y) == OCCUPIED, "and between the rooms"
    for box in HOME.boxes:
        assert cell((box.x0_m + box.x1_m) / 2, (box.y0_m + box.y1_m) / 2) != FREE
    assert plan.room_at(HOME.room_m[0] + 1, middle_y) == "Living room"
    assert plan.room_at(x1 - 1, middle_y) == "Study"


async def test_the_files_say_where_everything_is(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "home"
    async with played(folder) as settings:
        assert settings.source == "simulated"
        assert settings.bus.listen == ("tcp/127.0.0.1:7999",)
        assert isinstance(settings.robot, NeatoRobot)
        assert settings.robot.port == str(folder / "neato.tty"), "the stable name, not today's pty"
        assert isinstance(settings.camera.source, MjpegCameraSettings)
        assert isinstance(settings.radio.source, FollowCsi)
        anchor = np.array(HOME.camera.eye_m) + settings.radio.antenna_offset_m
        np.testing.assert_allclose(anchor, HOME.anchor_m, atol=1e-3)
        written, drawn = load_floor_plan(folder / settings.map.file, epoch=1), floor_plan(HOME)
        np.testing.assert_array_equal(written.cells, drawn.cells)
        assert written.bounds_m == pytest.approx(drawn.bounds_m)
        assert [room.name for room in written.rooms] == ["Living room", "Study"]
        truth = json.loads((folder / "truth.json").read_text())
        assert list(truth) == [HOME.device_mac]
        assert [truth[HOME.device_mac][axis] for axis in ("x_m", "y_m", "z_m")] == list(HOME.device_m)
        assert sorted(path.name for path in folder.glob("*.new")) == []


async def test_before_the_drive_nobody_is_there(tmp_path: Path) -> None:
    # Ten minutes before: that is enough on any machine.
    async with played(tmp_path, -600.0) as settings:
        assert isinstance(settings.robot, NeatoRobot)
        assert "X=0.000, Y=0.000, Theta=0.000" in await ask_robot(settings.robot.port), "not localised yet"
        sock = tmp_path / "hostapd.sock"
        assert await ask_hostapd(sock, tmp_path / "own", "PING", "STA-FIRST") == ["PONG\n", ""]


async def test_every_interface_answers_in_the_middle_of_a_walk(tmp_path: Path) -> None:
    async with played(tmp_path, WALK.start_s + 4.0) as settings:
        assert isinstance(settings.robot, NeatoRobot)
        assert isinstance(settings.camera.source, MjpegCameraSettings)
        # The pictures first: somebody walks for another 13 s only.
        first, *_, last = await pictures(settings.camera.source.url, 6)
        assert first.shape == (HOME.camera.height_px, HOME.camera.width_px, 3)
        changed = np.abs(first.astype(int) - last).max(axis=2) > 40
        assert np.count_nonzero(changed) > 300, "somebody walks"

        x, y, _ = HOME.robot_at(WALK.start_s)
        said = await ask_robot(settings.robot.port)
        assert said.startswith("GetRobotPos Smooth\r\nRobot Smooth pose: X=")
        found_x, found_y = (float(part.split("=")[1]) for part in said.split("pose: ")[1].split(", ")[:2])
        assert np.hypot(found_x - x, found_y - y) < 0.1, "it stands where its drive ended"

        (station,) = await ask_hostapd(tmp_path / "hostapd.sock", tmp_path / "own", "STA-FIRST")
        assert station.startswith(f"{HOME.device_mac}\n"), "who joined before is listed"

        packets, stats = read_log(await read_fifo(tmp_path / "csi.fifo", 60_000), Attribution())
        assert len(packets) > 100
        assert not stats.bad
        assert np.mean(packets.mac == mac_from_text(HOME.device_mac)) > 0.9
        assert (packets.n_rx == 3).all()


async def test_it_leaves_no_interface_behind(tmp_path: Path) -> None:
    async with played(tmp_path):
        assert (tmp_path / "neato.tty").is_symlink()
        assert (tmp_path / "csi.fifo").is_fifo()
    for name in ("neato.tty", "csi.fifo", "hostapd.sock"):
        assert not (tmp_path / name).exists()
        assert not (tmp_path / name).is_symlink()
    # And the same folder can be played again.
    async with played(tmp_path) as settings:
        assert isinstance(settings.robot, NeatoRobot)
        assert "Robot Smooth pose" in await ask_robot(settings.robot.port)
