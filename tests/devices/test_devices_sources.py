"""HostapdSource against the emulator on a real socket, and the static list."""

from __future__ import annotations

import asyncio
import logging
import socket
import time
from pathlib import Path

import pytest
from source_world import running
from waiting import until

from vad.devices import hostapd_source
from vad.devices.hostapd_source import HostapdSource
from vad.devices.static_list import StaticList
from vad.devices.station import StationEvent
from vad.errors import VadError
from vad.sim.hostapd import HostapdEmulator
from vad.streams import DropOldestQueue

Events = DropOldestQueue[StationEvent]

A, B, C = "02:00:00:00:00:0a", "02:00:00:00:00:0b", "02:00:00:00:00:0c"


async def take(out: Events) -> tuple[str, str]:
    async with asyncio.timeout(40.0):
        event = await out.get()
    return event.kind, event.mac


def nothing_in(folder: Path) -> bool:
    return not list(folder.iterdir())


async def received(sock: socket.socket) -> tuple[bytes, str]:
    """The next datagram and who sent it."""
    async with asyncio.timeout(40.0):
        return await asyncio.get_running_loop().sock_recvfrom(sock, 1000)


@pytest.fixture
def socket_path(tmp_path: Path) -> Path:
    return tmp_path / "wlan0"


@pytest.fixture
def own_dir(tmp_path: Path) -> Path:
    own = tmp_path / "own"
    own.mkdir()
    return own


@pytest.fixture
def source(socket_path: Path, own_dir: Path) -> HostapdSource:
    return HostapdSource(socket_path, interface="wlan0", own_dir=own_dir)


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """hostapd answers in this process: a late reply tells of the machine, not of hostapd."""
    monkeypatch.setattr(hostapd_source, "REPLY_S", 600.0)


@pytest.mark.usefixtures("patient")
async def test_coming_and_going(socket_path: Path, own_dir: Path, source: HostapdSource) -> None:
    hostapd, out = HostapdEmulator(socket_path), Events(16)
    async with running(hostapd):
        async with running(source, out):
            await until(lambda: source.health.state == "ok")
            assert hostapd.attached == 1
            before_ns = time.monotonic_ns()
            hostapd.announce(A.upper(), "keyid=guest")
            async with asyncio.timeout(40.0):
                event = await out.get()
            assert before_ns <= event.t_ns <= time.monotonic_ns()
            assert (event.kind, event.mac, event.interface, event.host_name) == ("joined", A, "wlan0", None)
            hostapd.leave(A)
            assert await take(out) == ("left", A)
            assert source.health.detail == "0 stations"
        await until(lambda: hostapd.attached == 0)
    assert nothing_in(own_dir)


@pytest.mark.usefixtures("patient")
async def test_who_is_in_already_joins_once(socket_path: Path, source: HostapdSource) -> None:
    hostapd, out = HostapdEmulator(socket_path), Events(16)
    for mac in (B, A, C):
        hostapd.announce(mac)
    async with running(hostapd), running(source, out):
        assert [await take(out) for _ in range(3)] == [("joined", A), ("joined", B), ("joined", C)]
        await until(lambda: source.health.detail == "3 stations")
        assert len(out) == 0


@pytest.mark.usefixtures("patient")
async def test_hostapd_restarts(
    socket_path: Path, own_dir: Path, source: HostapdSource, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, "vad.devices")
    out = Events(16)
    async with running(source, out):
        await until(lambda: source.health.state == "degraded")
        assert "ctrl_interface" in source.health.detail
        first = HostapdEmulator(socket_path)
        first.announce(A)
        first.announce(B)
        async with running(first):
            assert [await take(out), await take(out)] == [("joined", A), ("joined", B)]
        # Counted from its end on: a slow machine has looked for it many times before it came.
        tries = lambda: sum("is not there" in r.getMessage() for r in caplog.records)  # noqa: E731
        before = tries()
        await until(lambda: tries() >= before + 3)
        second = HostapdEmulator(socket_path)
        second.announce(B)
        second.announce(C)
        async with running(second):
            # A went and C came while hostapd was away; B is still known.
            assert [await take(out), await take(out)] == [("joined", C), ("left", A)]
            second.announce(A)
            assert await take(out) == ("joined", A)
            warnings = [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING]
            assert len(warnings) == len(set(warnings)) + 1  # "is not there" is new again after it was well
    assert nothing_in(own_dir)


async def test_a_hostapd_that_was_killed(
    socket_path: Path, source: HostapdSource, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No farewell, the socket's file stays; then another one takes its place."""
    # While it lives, a late reply tells of the machine.
    monkeypatch.setattr(hostapd_source, "REPLY_S", 600.0)
    out = Events(16)
    mute = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    mute.bind(str(socket_path))
    mute.setblocking(False)
    async with running(source, out):
        command, client = await received(mute)
        assert command == b"ATTACH"
        mute.sendto(b"<3>AP-STA-CONNECTED 02:00:00:00:00:0b", client)
        mute.sendto(b"OK\n", client)
        assert await take(out) == ("joined", B)
        for asked, answer in ((b"STA-FIRST", f"{B}\nflags=[AUTHORIZED]\n"), (f"STA-NEXT {B}".encode(), "")):
            assert await received(mute) == (asked, client)
            mute.sendto(answer.encode(), client)
        monkeypatch.undo()
        await until(lambda: source.health.counters["attached"] == 1)
        mute.close()
        await until(lambda: source.health.state == "degraded")
        hostapd = HostapdEmulator(socket_path)
        hostapd.announce(A)
        async with running(hostapd):
            assert [await take(out), await take(out)] == [("joined", A), ("left", B)]


async def test_a_second_hostapd_takes_the_socket_over(
    socket_path: Path, tmp_path: Path, source: HostapdSource
) -> None:
    """The old one stays alive and still answers, but its socket is no longer the one at the path."""
    old, new, out = HostapdEmulator(tmp_path / "old"), HostapdEmulator(tmp_path / "new"), Events(16)
    async with running(old), running(new):
        await until(lambda: (tmp_path / "old").exists() and (tmp_path / "new").exists())
        (tmp_path / "old").rename(socket_path)
        async with running(source, out):
            await until(lambda: old.attached == 1)
            (tmp_path / "new").rename(socket_path)
            await until(lambda: new.attached == 1)
            new.announce(A)
            assert await take(out) == ("joined", A)


@pytest.mark.usefixtures("patient")
async def test_a_station_that_leaves_while_the_list_is_read(socket_path: Path, source: HostapdSource) -> None:
    out = Events(16)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server:
        server.bind(str(socket_path))
        server.setblocking(False)
        entry = "{}\nflags=[AUTH][ASSOC]{}\n"
        # Command awaited, then what is sent.
        script = [
            ("ATTACH", ["OK\n"]),
            ("STA-FIRST", [entry.format(A, "[AUTHORIZED]")]),
            (f"STA-NEXT {A}", [f"<3>AP-STA-DISCONNECTED {A}", "FAIL\n"]),
            ("STA-FIRST", [entry.format(B, "[AUTHORIZED]")]),
            (f"STA-NEXT {B}", [f"<3>AP-STA-CONNECTED {A}", entry.format(C, "")]),
            (f"STA-NEXT {C}", [""]),
            ("PING", ["<3>AP-STA-CONNECTED nonsense", "PONG\n"]),
            ("PING", ["PONG\n"]),
        ]
        async with running(source, out):
            for awaited, answers in script:
                command, client = await received(server)
                assert command.decode() == awaited
                for answer in answers:
                    server.sendto(answer.encode(), client)
            await until(lambda: len(out) >= 3)
            assert [(e.kind, e.mac) for e in out.drain()] == [("left", A), ("joined", A), ("joined", B)]
            assert source.health.counters["bad_input"] == 1


async def test_a_mute_hostapd_is_trouble(socket_path: Path, source: HostapdSource) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as mute:
        mute.bind(str(socket_path))
        async with running(source, Events(1)):
            await until(lambda: "no reply" in source.health.detail)


async def test_a_refusal_is_trouble(socket_path: Path, source: HostapdSource) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server:
        server.bind(str(socket_path))
        server.setblocking(False)
        async with running(source, Events(1)):
            _, client = await received(server)
            server.sendto(b"FAIL\n", client)
            await until(lambda: "refuses ATTACH" in source.health.detail)


async def test_a_hundred_at_once(socket_path: Path, source: HostapdSource) -> None:
    hostapd, out = HostapdEmulator(socket_path), Events(4096)
    wanted = {f"02:00:00:00:01:{number:02x}" for number in range(100)}
    async with running(hostapd), running(source, out):
        await until(lambda: source.health.state == "ok")
        for mac in sorted(wanted):
            hostapd.announce(mac)
            await asyncio.sleep(0)
        await until(lambda: len(out) >= 100)
        assert {event.mac for event in out.drain()} == wanted


async def test_the_emulator_answers_like_hostapd(socket_path: Path, own_dir: Path) -> None:
    hostapd = HostapdEmulator(socket_path)
    hostapd.announce(A)
    asked = {
        b"PING": b"PONG\n",
        b"STATUS": b"state=ENABLED\nnum_sta[0]=1\n",
        b"DETACH": b"FAIL\n",
        f"STA-NEXT {A}".encode(): b"",
        f"STA-NEXT {B}".encode(): b"FAIL\n",
        b"DANCE": b"UNKNOWN COMMAND\n",
    }
    async with running(hostapd):
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as client:
            client.bind(str(own_dir / "client"))
            client.setblocking(False)
            await until(socket_path.exists)
            for command, answer in asked.items():
                client.sendto(command, str(socket_path))
                assert (await received(client))[0] == answer


async def test_the_static_list() -> None:
    out = Events(8)
    source = StaticList([A.upper(), B, A])
    async with running(source, out):
        assert [await take(out), await take(out)] == [("listed", A), ("listed", B)]
        assert source.health.state == "ok"
        assert len(out) == 0


def test_the_static_list_refuses_what_is_no_mac() -> None:
    with pytest.raises(VadError, match="aa:bb"):
        StaticList(["kitchen lamp"])
