"""`vad doctor`: what it says of settings, daemon, disk, clock, networks, rights of the service's user."""

from __future__ import annotations

import asyncio
import os
import socket
import sys
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from doctor_world import STRANGER, open_to_all, verdicts, visit, write
from waiting import free_port

from vad.bus import messages as m
from vad.bus.node import Bus
from vad.bus.session import BusSettings
from vad.commands.doctor import examine
from vad.commands.doctor.hub import (
    check_clock,
    check_daemon,
    check_settings,
    check_state_dir,
    clock_findings,
    disk_finding,
)
from vad.commands.doctor.identity import Identity, service_identity
from vad.commands.doctor.network_model import check_model, check_processor, headroom, model_findings
from vad.commands.doctor.unit import unit_values
from vad.vision.people import MODEL_PATH

NOW = datetime(2026, 6, 1, 12, 0, tzinfo=UTC)


async def test_settings_that_can_be_used(tmp_path: Path) -> None:
    assert verdicts(await check_settings(visit(tmp_path))) == [("settings", "ok")]


async def test_settings_that_name_files_that_are_not_there(tmp_path: Path) -> None:
    wanted = visit(tmp_path, vision={"model": "none.onnx", "robot_detector": "no.onnx"})
    found = await check_settings(wanted)
    assert verdicts(found) == [("settings", "bad")] * 2
    assert "none.onnx" in found[0].text
    camera = {"source": {"type": "mjpeg", "url": "http://h/"}, "intrinsics": "lens.yaml"}
    assert ("settings", "bad") in [
        (f.check, f.verdict) for f in await check_settings(visit(tmp_path, camera=camera))
    ]


async def test_a_password_that_everybody_can_read(tmp_path: Path) -> None:
    wanted = visit(tmp_path, camera={"source": {"type": "rtsp", "url": "rtsp://me:secret@10.0.0.9/s"}})
    wanted.config_file.chmod(0o644)
    (found,) = await check_settings(wanted)
    assert (found.verdict, "chmod o-r" in found.remedy) == ("warning", True)
    assert "secret" not in found.text + found.remedy
    wanted.config_file.chmod(0o600)
    assert verdicts(await check_settings(wanted)) == [("settings", "ok")]


@pytest.fixture
def taken() -> Iterator[int]:
    """A port where somebody else listens."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


async def test_an_address_that_is_taken_and_one_that_is_free(tmp_path: Path, taken: int) -> None:
    wanted = visit(tmp_path, bus={"listen": [f"tcp/127.0.0.1:{taken}"]}, metrics={"port": taken})
    found = await check_daemon(wanted)
    assert verdicts(found) == [("zenoh", "bad"), ("metrics", "bad")]
    assert "in use" in found[0].text
    wanted = visit(tmp_path, bus={"listen": [f"tcp/127.0.0.1:{free_port()}"]})
    assert verdicts(await check_daemon(wanted)) == [("zenoh", "ok")]


async def test_a_daemon_that_runs_is_asked(tmp_path: Path) -> None:
    """Robot, camera and card are its own then: what it says of them counts."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    parts = (
        m.Part(part="daemon", state="ok", rates_per_s={"frames": 14.9, "poses": 5.0}),
        m.Part(part="robot /dev/x", state="degraded", detail="no pose for 9 s. Is it on?"),
        m.Part(part="camera", state="ok", detail="640x480 MJPG, stamps: driver"),
        m.Part(part="csi.connector", state="ok", detail="listening", rates_per_s={"packets": 400.0}),
        m.Part(part="store", state="degraded", detail="the disk is full. Free some space"),
    )
    wanted = visit(tmp_path, bus={"listen": [endpoint]})
    async with Bus(BusSettings(hub="home", listen=(endpoint,))) as bus:
        bus.publish_status(
            m.StatusMessage(source="live", version="9", uptime_s=7200.0, step="waiting", parts=parts)
        )
        found = await examine(wanted, ["daemon", "robot", "camera"])
        (csi,) = [f for f in await examine(wanted, ["radio"]) if f.check == "csi"]
    assert verdicts(found) == [("daemon", "ok"), ("store", "bad"), ("robot", "bad"), ("camera", "ok")]
    daemon, store, robot, camera = found
    assert "vad 9 runs for 2 h 0 min" in daemon.text
    assert (store.text, store.remedy) == ("the disk is full", "Free some space")
    assert (robot.text, robot.remedy) == ("no pose for 9 s", "Is it on?")
    assert "14.9 pictures a second" in camera.text
    assert "400 packets a second" in csi.text


async def test_a_state_folder_that_is_written_and_one_that_is_not(tmp_path: Path) -> None:
    wanted = visit(tmp_path)
    found = await check_state_dir(wanted)
    assert found[0].text.endswith("will be made")
    wanted.state_dir.mkdir()
    assert [f.check for f in await check_state_dir(wanted)] == ["state", "disk"]
    blocked = replace(wanted, settings=visit(tmp_path, state_dir="vad.yaml/state").settings)
    assert ("state", "bad") in verdicts(await check_state_dir(blocked))


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file to somebody else")
async def test_a_state_folder_with_files_of_another_user(tmp_path: Path) -> None:
    wanted = visit(tmp_path)
    wanted.state_dir.mkdir()
    (wanted.state_dir / "vad.sqlite").touch()
    os.chown(wanted.state_dir, STRANGER.uid, STRANGER.uid)
    (found,) = await check_state_dir(wanted)
    assert found.verdict == "bad"
    assert "vad.sqlite" in found.text
    assert "chown" in found.remedy


@pytest.mark.parametrize(
    ("free_mb", "total_mb", "free_files", "verdict", "words"),
    [
        (40_000, 60_000, 10**6, "ok", "40000 MB"),
        (20, 60_000, 10**6, "bad", "Free some space"),
        (40_000, 60_000, 3, "bad", "3 more files"),
        (300, 60_000, 10**6, "warning", "keep_free_mb"),
        (1500, 1800, 10**6, "warning", "quota_mb: 450"),
    ],
)
def test_room_on_the_disk(
    tmp_path: Path, free_mb: int, total_mb: int, free_files: int, verdict: str, words: str
) -> None:
    found = disk_finding(free_mb, total_mb, free_files, visit(tmp_path))
    assert found.verdict == verdict
    assert words in found.text + found.remedy


def test_clocks(tmp_path: Path) -> None:
    wanted = visit(tmp_path)
    os.utime(wanted.config_file, (NOW.timestamp(), NOW.timestamp()))
    rtc = write(tmp_path, "sys/class/rtc/rtc0", "")
    assert verdicts(clock_findings(wanted, synchronised=True, now=NOW)) == [("clock", "ok")]
    (loose,) = clock_findings(wanted, synchronised=False, now=NOW)
    assert (loose.verdict, loose.remedy) == ("warning", "sudo timedatectl set-ntp true")
    (late,) = clock_findings(wanted, synchronised=False, now=NOW - timedelta(days=400))
    assert late.verdict == "bad"
    assert "2025" in late.text
    rtc.unlink()
    (bare,) = clock_findings(wanted, synchronised=True, now=NOW)
    assert "no battery clock" in bare.text


async def test_the_clock_of_this_machine_is_read(tmp_path: Path) -> None:
    assert {check for check, _ in verdicts(await check_clock(visit(tmp_path)))} == {"clock"}


async def test_networks_as_packed_damaged_and_missing(tmp_path: Path) -> None:
    assert verdicts(await check_model(visit(tmp_path))) == [("networks", "ok")]
    (tmp_path / "MODELS.md").write_text((MODEL_PATH.parent / "MODELS.md").read_text())
    (tmp_path / MODEL_PATH.name).write_bytes(MODEL_PATH.read_bytes()[:-1] + b"\0")
    damaged, missing = model_findings(tmp_path)
    assert "not the one that was packed" in damaged.text
    assert "robot.onnx is missing" in missing.text
    (nothing,) = model_findings(tmp_path / "none")
    assert nothing.verdict == "bad"


@pytest.mark.slow
async def test_the_processor_is_measured(tmp_path: Path) -> None:
    assert [f.check for f in await check_processor(visit(tmp_path, vision={"max_fps": 0.5}))] == ["processor"]
    (fast,) = await check_processor(visit(tmp_path, vision={"max_fps": 5000}))
    assert fast.verdict == "bad"
    assert "max_fps" in fast.remedy or "faster machine" in fast.remedy
    (broken,) = await check_processor(visit(tmp_path, vision={"model": "vad.yaml"}))
    assert "cannot be loaded" in broken.text


@pytest.mark.parametrize(
    ("wall_ms", "cpu_ms", "fps", "verdict", "words"),
    [
        (24, 24, 15, "ok", "36 % of a core"),
        (50, 50, 15, "warning", "max_fps: 12"),
        (80, 80, 15, "bad", "max_fps: 7"),
        (300, 300, 15, "bad", "faster machine"),
        (90, 24, 15, "warning", "other programs"),
    ],
)
def test_headroom(wall_ms: float, cpu_ms: float, fps: float, verdict: str, words: str) -> None:
    found = headroom(wall_ms / 1e3, cpu_ms / 1e3, fps, 1, 4)
    assert found.verdict == verdict
    assert words in found.text + found.remedy


def test_what_the_services_user_may_use(tmp_path: Path) -> None:
    open_to_all(tmp_path)
    file = tmp_path / "secret"
    file.touch(0o600)
    assert STRANGER.refusal(file, "r") == f"vad may not read {file}"
    file.chmod(0o644)
    assert STRANGER.refusal(file, "r") == ""
    assert "may not read and write" in STRANGER.refusal(file, "rw")
    file.chmod(0o660)
    member = Identity("vad", 54_321, frozenset({file.stat().st_gid}))
    assert member.refusal(file, "rw") == ""
    tmp_path.chmod(0o700)
    assert STRANGER.refusal(file, "r") == f"vad may not enter {tmp_path}"
    assert "chmod o+x" in STRANGER.remedy(file)


async def test_a_file_that_only_root_may_read_is_found(tmp_path: Path) -> None:
    wanted = visit(tmp_path, service=STRANGER)
    wanted.config_file.chmod(0o600)
    found = await check_settings(wanted)
    assert verdicts(found) == [("settings", "bad")]
    assert "vad may not" in found[0].text


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
async def test_what_another_user_may_not_look_at_is_advice(tmp_path: Path) -> None:
    """The state folder is the service's alone: who asks without sudo is told so, and sees all the rest."""
    open_to_all(tmp_path)
    wanted = visit(tmp_path, bus={"listen": []})
    wanted.state_dir.mkdir(0o700)
    program = (
        "import asyncio, concurrent.futures.thread, os; from pathlib import Path;"
        "from vad.commands.doctor import examine, Visit;"
        "from vad.config import parse_settings; text = open('vad.yaml').read();"
        "os.setgid(65534); os.setuid(65534);"
        "v = Visit(parse_settings(text, where=''), Path('vad.yaml'), 1.0, root=Path('/none'));"
        "[print(f) for f in asyncio.run(examine(v, ['disk', 'clock']))]"
    )
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", program, cwd=tmp_path, stdout=asyncio.subprocess.PIPE
    )
    told, _ = await process.communicate()
    assert b"state may not be looked at by you" in told
    assert b"sudo vad doctor" in told
    assert b"check='clock'" in told


def test_drop_ins_of_the_unit_count(tmp_path: Path) -> None:
    root = tmp_path / "root"
    write(tmp_path, "usr/lib/systemd/system/vad.service", "[Service]\nUser=vad\nSupplementaryGroups=video\n")
    write(tmp_path, "etc/systemd/system/vad.service.d/10.conf", "[Service]\nSupplementaryGroups=netdev\n")
    assert unit_values(root, "SupplementaryGroups") == ["video", "netdev"]
    write(
        tmp_path, "etc/systemd/system/vad.service.d/20.conf", "[Service]\nSupplementaryGroups=\nUser=other\n"
    )
    assert unit_values(root, "SupplementaryGroups") == []
    assert unit_values(root, "User") == ["vad", "other"]
    assert service_identity(root) is None  # there is no such user


async def test_checks_run_at_the_same_time(tmp_path: Path) -> None:
    async with asyncio.timeout(40):
        found = await examine(visit(tmp_path, bus={"listen": []}), ["settings", "clock"])
    assert next(f.check for f in found) == "settings"
