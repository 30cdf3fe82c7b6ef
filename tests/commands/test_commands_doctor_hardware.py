"""`vad doctor`: what it says of robot, camera, card, hostapd, leases and broker, against emulators."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
from collections.abc import AsyncIterator, Coroutine
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from doctor_world import STRANGER, open_to_all, verdicts, visit, write
from waiting import free_port, until

from vad.camera.v4l2_formats import Format, V4l2Description
from vad.commands.doctor import network, robot, sight
from vad.commands.doctor.network import check_access_point, check_leases, check_mqtt
from vad.commands.doctor.radio import check_card, check_connector, check_csi, check_rights
from vad.commands.doctor.robot import check_robot, check_router, check_serial_port
from vad.commands.doctor.sight import check_camera, format_finding
from vad.config import V4l2CameraSettings
from vad.csi.logfile import record
from vad.sim.hostapd import HostapdEmulator
from vad.sim.mjpeg import MjpegServer
from vad.sim.neato import VirtualNeato

sys.path.append(str(Path(__file__).parents[1] / "csi"))
sys.path.append(str(Path(__file__).parents[1] / "homeassistant"))
from csi_tools import bodies
from mosquitto_world import Mosquitto, needs_mosquitto

CONNECTOR = {"source": {"type": "connector", "group": 12}}


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorter looks than a user's."""
    monkeypatch.setattr(sight, "MEASURE_S", 0.8)
    monkeypatch.setattr(robot, "RATE_S", 0.8)
    # And more patience with this machine, which may be busy.
    monkeypatch.setattr(network, "_SETTLE_S", 40.0)


@contextlib.asynccontextmanager
async def going(work: Coroutine[Any, Any, None]) -> AsyncIterator[None]:
    """`work` as a task that ends with the block."""
    task = asyncio.create_task(work)
    try:
        yield
    finally:
        task.cancel()
        await asyncio.wait({task})


async def test_a_robot_that_answers_on_its_port(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robot, "RATE_S", 4.0)
    link = tmp_path / "tty"
    neato = VirtualNeato(lambda _t_ns: (1.5, -0.5, 0.25), link=link)
    asked = {"type": "neato", "port": str(link), "rate_hz": 1.0}
    wanted = visit(tmp_path, robot=asked, bus={"listen": []}, listen_s=40.0)
    async with going(neato.run()):
        assert verdicts(await check_serial_port(wanted)) == [("serial port", "ok")]
        (found,) = await check_robot(wanted)
    assert found.verdict == "ok"
    assert "poses a second" in found.text


async def test_a_robot_that_is_slower_than_asked(tmp_path: Path) -> None:
    link = tmp_path / "tty"
    neato = VirtualNeato(lambda _t_ns: (1.5, -0.5, 0.25), link=link)
    asked = {"type": "neato", "port": str(link), "rate_hz": 2000.0}
    wanted = visit(tmp_path, robot=asked, bus={"listen": []}, listen_s=40.0)
    async with going(neato.run()):
        (found,) = await check_robot(wanted)
    assert (found.verdict, "rate_hz" in found.remedy) == ("warning", True)


async def test_routers_that_answer_or_do_not(tmp_path: Path) -> None:
    server = await asyncio.start_server(lambda _, writer: writer.close(), "127.0.0.1", 0)
    async with server:
        there = f"tcp/127.0.0.1:{server.sockets[0].getsockname()[1]}"
        nobody = f"tcp/127.0.0.1:{free_port()}"
        found = await check_router(visit(tmp_path, bus={"connect": [there, nobody]}, listen_s=40.0))
    assert verdicts(found) == [("zenoh router", "ok"), ("zenoh router", "bad")]


async def test_a_port_that_the_service_may_not_open(tmp_path: Path) -> None:
    open_to_all(tmp_path)
    port = tmp_path / "tty"
    port.touch(0o600)
    wanted = visit(tmp_path, robot={"type": "neato", "port": str(port)}, service=STRANGER)
    (found,) = await check_serial_port(wanted)
    assert found.text == f"vad may not read and write {port}"


WEBCAM = V4l2Description(
    "Webcam", (Format("YUYV", 640, 480, (30.0,)), Format("MJPG", 1280, 720, (30.0, 15.0)))
)


@pytest.mark.parametrize(
    ("asked", "verdict", "words"),
    [
        ({"format": "YUYV"}, "ok", "YUYV 640x480 at 15 is offered"),
        ({}, "warning", "format: YUYV, width_px: 640, height_px: 480"),
        ({"format": "YUYV", "fps": 60.0}, "warning", "fps: 30"),
        ({"width_px": 1280, "height_px": 720}, "ok", "MJPG 1280x720"),
    ],
)
def test_formats_of_a_camera(asked: dict[str, Any], verdict: str, words: str) -> None:
    found = format_finding(V4l2CameraSettings(device="/dev/video0", **asked), WEBCAM)
    assert found.verdict == verdict
    assert words in found.text + found.remedy


def test_a_camera_without_a_known_format() -> None:
    odd = V4l2Description("Odd", (Format("H264", 640, 480, (30.0,)),))
    assert format_finding(V4l2CameraSettings(device="/dev/video0"), odd).verdict == "bad"


@pytest.mark.parametrize(
    ("device", "words"), [("/dev/none", "No such file"), ("/dev/null", "does not answer")]
)
async def test_a_camera_that_is_none(tmp_path: Path, device: str, words: str) -> None:
    (found,) = await check_camera(visit(tmp_path, camera={"source": {"type": "v4l2", "device": device}}))
    assert found.verdict == "bad"
    assert words in found.text


@contextlib.asynccontextmanager
async def mjpeg(fps: float, grey: int) -> AsyncIterator[str]:
    """A network camera at so many pictures a second."""
    _, encoded = cv2.imencode(".jpg", np.full((48, 64, 3), grey, np.uint8))
    jpeg = encoded.tobytes()

    async def play(server: MjpegServer) -> None:
        loop = asyncio.get_running_loop()
        while True:
            server.publish(jpeg, round(loop.time() * 1e9))
            await asyncio.sleep(1 / fps)

    async with MjpegServer("127.0.0.1", 0) as server, going(play(server)):
        yield server.url


@pytest.mark.parametrize(
    ("fps", "grey", "expected"),
    [
        (50.0, 120, [("camera", "ok")]),
        (2.0, 120, [("camera", "warning")]),
        (50.0, 0, [("camera", "ok"), ("camera picture", "warning")]),
    ],
)
async def test_pictures_are_counted_and_looked_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fps: float, grey: int, expected: list[tuple[str, str]]
) -> None:
    monkeypatch.setattr(sight, "MEASURE_S", 2.0)  # 4 a second are enough, of 50, however busy the machine
    async with mjpeg(fps, grey) as url:
        wanted = visit(tmp_path, camera={"source": {"type": "mjpeg", "url": url}}, listen_s=40.0)
        assert verdicts(await check_camera(wanted)) == expected


async def test_a_camera_that_is_off(tmp_path: Path) -> None:
    url = f"http://127.0.0.1:{free_port()}/"
    wanted = visit(tmp_path, camera={"source": {"type": "mjpeg", "url": url}}, listen_s=0.5)
    assert verdicts(await check_camera(wanted)) == [("camera", "bad")]


UNIT = "[Service]\nUser=vad\nAmbientCapabilities=CAP_NET_ADMIN\n"


@pytest.mark.parametrize(
    ("unit", "capabilities", "verdict"),
    [
        (UNIT, 0, "ok"),
        ("[Service]\nUser=vad\n", 1 << 12, "bad"),
        ("[Service]\nExecStart=/usr/bin/vad run\n", 0, "ok"),
        ("[Service]\nDynamicUser=yes\n", 0, "bad"),
        (None, 1 << 12, "ok"),
        (None, ~(1 << 12) & (1 << 40) - 1, "bad"),
    ],
)
async def test_rights_of_the_service(
    tmp_path: Path, unit: str | None, capabilities: int, verdict: str
) -> None:
    if unit is not None:
        write(tmp_path, "etc/systemd/system/vad.service", unit)
    write(tmp_path, "proc/self/status", f"Name:\tvad\nCapEff:\t{capabilities:016x}\n")
    assert verdicts(await check_rights(visit(tmp_path, radio=CONNECTOR))) == [("rights", verdict)]


async def test_the_connectors_group_is_joined(tmp_path: Path) -> None:
    (found,) = await check_connector(visit(tmp_path, radio=CONNECTOR))
    if "not permitted" in found.text or "no connector" in found.text:
        pytest.skip(found.text)
    assert found.verdict == "ok"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become a user without rights")
async def test_the_connectors_group_without_rights(tmp_path: Path) -> None:
    """Another user, in a process of its own, is refused by the kernel."""
    program = (
        "import asyncio; from pathlib import Path; from vad.commands.doctor.visit import Visit;"
        "from vad.commands.doctor.radio import check_connector; from vad.config import parse_settings;"
        "import os; text = open('vad.yaml').read(); os.setgid(65534); os.setuid(65534);"
        "v = Visit(parse_settings(text, where=''), Path('vad.yaml'), 1.0, root=Path('/none'));"
        "print(asyncio.run(check_connector(v))[0].text)"
    )
    visit(tmp_path, radio=CONNECTOR)
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", program, cwd=tmp_path, stdout=asyncio.subprocess.PIPE
    )
    told, _ = await process.communicate()
    assert b"is not permitted" in told or b"no connector" in told


def card(folder: Path, *, device: str = "0x4235", flags: str | None = "0x5", firmware: str = "csi") -> None:
    """A machine with the card, the modified driver, its firmware."""
    write(folder, "sys/bus/pci/devices/0000:03:00.0/vendor", "0x8086\n")
    write(folder, "sys/bus/pci/devices/0000:03:00.0/device", f"{device}\n")
    write(folder, "sys/module/iwlwifi/parameters/debug", "0\n")
    if flags is not None:
        write(folder, "sys/module/iwlwifi/parameters/connector_log", f"{flags}\n")
    tool = write(folder, "lib/firmware/iwlwifi-5000-2.ucode.sigcomm2010", "csi firmware")
    used = tool.with_name("iwlwifi-5000-2.ucode")
    if firmware == "csi":
        used.symlink_to(tool.name)
    elif firmware == "copied":
        used.write_bytes(tool.read_bytes())
    elif firmware == "intel":
        used.write_text("Intel's own")


@pytest.mark.parametrize(
    ("machine", "expected"),
    [
        ({}, ["ok", "ok", "ok"]),
        ({"device": "0x4236", "firmware": "copied"}, ["ok", "ok", "ok"]),
        ({"flags": "5"}, ["ok", "ok", "ok"]),
        ({"device": "0x08b1"}, ["bad", "ok", "ok"]),
        ({"flags": None}, ["ok", "bad", "ok"]),
        ({"flags": "0x0"}, ["ok", "bad", "ok"]),
        ({"flags": "0x1"}, ["ok", "bad", "ok"]),
        ({"flags": "many"}, ["ok", "bad", "ok"]),
        ({"firmware": "intel"}, ["ok", "ok", "warning"]),
        ({"firmware": "none"}, ["ok", "ok", "bad"]),
    ],
)
async def test_card_driver_and_firmware(tmp_path: Path, machine: dict[str, Any], expected: list[str]) -> None:
    card(tmp_path, **machine)
    found = verdicts(await check_card(visit(tmp_path, radio=CONNECTOR)))
    assert found == list(zip(["card", "driver", "firmware"], expected, strict=True))


async def test_frames_need_not_be_logged_where_the_transmitter_is_known(tmp_path: Path) -> None:
    card(tmp_path, flags="0x1")
    radio = CONNECTOR | {"transmitter": "aa:bb:cc:dd:ee:ff"}
    assert ("driver", "ok") in verdicts(await check_card(visit(tmp_path, radio=radio)))


async def test_a_machine_without_anything_of_the_card(tmp_path: Path) -> None:
    found = await check_card(visit(tmp_path, radio=CONNECTOR))
    assert [finding.verdict for finding in found] == ["bad"] * 3
    assert (
        verdicts(await check_card(visit(tmp_path, radio={"source": {"type": "follow", "path": "p"}}))) == []
    )


async def test_packets_come_or_do_not(tmp_path: Path) -> None:
    follow = {"source": {"type": "follow", "path": "csi.dat"}}
    wanted = visit(tmp_path, radio=follow, listen_s=0.5)
    assert verdicts(await check_csi(wanted)) == [("csi", "bad")]
    log = tmp_path / "csi.dat"
    log.touch()
    (silent,) = await check_csi(wanted)
    assert (silent.verdict, "no packet" in silent.text) == ("warning", True)
    log.write_bytes(b"".join(record(0xBB, body) for body in bodies(100)))
    (heard,) = await check_csi(wanted)
    assert heard.verdict == "ok"
    assert "packets a second" in heard.text


async def test_hostapd_answers_is_away_or_is_not_for_us(tmp_path: Path) -> None:
    open_to_all(tmp_path)
    path = tmp_path / "wlan0"
    wanted = visit(tmp_path, devices={"hostapd": [str(path)]})
    assert verdicts(await check_access_point(wanted)) == [("hostapd", "bad")]
    async with going(HostapdEmulator(path).run()):
        await until(path.exists)
        assert verdicts(await check_access_point(wanted)) == [("hostapd", "ok")]
        path.chmod(0o700)
        refused = visit(tmp_path, devices={"hostapd": [str(path)]}, service=STRANGER)
        (found,) = await check_access_point(refused)
        assert found.text == f"vad may not write {path}"


async def test_nobody_who_tells_of_devices(tmp_path: Path) -> None:
    wanted = visit(tmp_path, devices={"agents": False})
    assert verdicts(await check_access_point(wanted)) == [("devices", "bad")]


async def test_leases_that_can_be_read_and_that_are_not_there(tmp_path: Path) -> None:
    file = tmp_path / "dnsmasq.leases"
    wanted = visit(tmp_path, devices={"leases": [str(file)]})
    assert verdicts(await check_leases(wanted)) == [("leases", "bad")]
    file.write_text("1893456000 f4:f5:d8:00:00:01 192.168.1.7 lamp *\n")
    (found,) = await check_leases(wanted)
    assert (found.verdict, found.text) == ("ok", "1 leases")


async def test_no_broker_where_one_is_wanted(tmp_path: Path) -> None:
    assert verdicts(await check_mqtt(visit(tmp_path))) == []
    found = await check_mqtt(visit(tmp_path, mqtt={"host": "127.0.0.1", "port": free_port()}))
    assert verdicts(found) == [("mqtt", "bad")]


@needs_mosquitto
async def test_a_broker_that_answers_and_a_password_for_all(tmp_path: Path) -> None:
    with Mosquitto(tmp_path) as broker:
        mqtt = {"host": "127.0.0.1", "port": broker.port}
        assert verdicts(await check_mqtt(visit(tmp_path, mqtt=mqtt))) == [("mqtt", "ok")]
        secret = tmp_path / "password"
        secret.write_text("sesame\n")
        secret.chmod(0o644)
        more = mqtt | {"username": "vad", "password_file": "password"}
        found = await check_mqtt(visit(tmp_path, mqtt=more))
        assert verdicts(found) == [("mqtt", "warning"), ("mqtt", "ok")]
