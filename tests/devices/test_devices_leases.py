"""dnsmasq's lease file, the file watch, and lists of makers: text and bytes, then the files themselves."""

from __future__ import annotations

import asyncio
import logging
import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from source_world import running
from waiting import until

from vad.devices.inotify import CREATE, MODIFY, FileEvent, Inotify, parse_events
from vad.devices.lease_source import LeaseSource
from vad.devices.leases import MAX_LEASES, Lease, parse_leases
from vad.devices.oui import MAX_NAME, Makers, load_makers, parse_makers
from vad.devices.station import StationEvent
from vad.mac import mac_to_text
from vad.streams import DropOldestQueue

Events = DropOldestQueue[StationEvent]

LAMP, PHONE = "f4:f5:d8:00:00:01", "02:00:00:00:00:0a"
REAL = """1700003600 f4:f5:d8:00:00:01 192.168.88.36 lamp 01:f4:f5:d8:00:00:01
1700003700 02:00:00:00:00:0a 192.168.88.40 * ff:b5:5e:67:ff:00:02:00:00:ab:11:6d
0 00:16:EA:00:00:02 192.168.88.2 hub *
1700003700 20-80:00:02:08:fe:80 192.168.88.41 ib *
duid 00:01:00:01:2c:8a:5b:10:f4:f5:d8:00:00:01
1700003600 1234567 fd00::36 lamp 00:01:00:01:2c
"""


def test_the_lines_of_dnsmasq() -> None:
    leases, bad = parse_leases(REAL)
    assert bad == 0
    assert leases == {
        LAMP: Lease(LAMP, "192.168.88.36", "lamp", "01:f4:f5:d8:00:00:01"),
        PHONE: Lease(PHONE, "192.168.88.40", None, "ff:b5:5e:67:ff:00:02:00:00:ab:11:6d"),
        "00:16:ea:00:00:02": Lease("00:16:ea:00:00:02", "192.168.88.2", "hub", None),
    }


@pytest.mark.parametrize(
    "line",
    [
        "soon f4:f5:d8:00:00:01 10.0.0.1 lamp *",
        "17 f4:f5:d8:00:01 10.0.0.1 lamp *",
        "17 f4:f5:d8:00:00:01 10.0.0.256 lamp *",
        "17 f4:f5:d8:00:00:01 10.0.0.1",
        "words",
    ],
)
def test_lines_that_are_no_leases_are_counted(line: str) -> None:
    assert parse_leases(f"{line}\n{REAL}") == (parse_leases(REAL)[0], 1)


@given(st.integers(0, len(REAL)))
def test_a_file_that_is_being_written_gives_its_whole_lines(cut: int) -> None:
    leases, bad = parse_leases(REAL[:cut])
    assert bad == 0
    assert leases.items() <= parse_leases(REAL)[0].items()


@given(st.text(max_size=300))
def test_any_text_gives_leases_or_a_count(text: str) -> None:
    leases, bad = parse_leases(text)
    assert len(leases) + bad <= len(text.split("\n"))


@given(
    st.dictionaries(
        st.integers(0, (1 << 48) - 1).map(mac_to_text),
        st.tuples(st.ip_addresses(v=4).map(str), st.from_regex(r"[a-zA-Z0-9-]{1,20}", fullmatch=True)),
        max_size=5,
    )
)
def test_every_lease_comes_back(given_out: dict[str, tuple[str, str]]) -> None:
    text = "".join(f"17 {mac} {ip} {name} *\n" for mac, (ip, name) in given_out.items())
    wanted = {mac: Lease(mac, ip, name) for mac, (ip, name) in given_out.items()}
    assert parse_leases(text) == (wanted, 0)


def test_leases_are_bounded() -> None:
    lines = (f"17 {mac_to_text(number)} 10.0.0.1 * *" for number in range(MAX_LEASES + 500))
    assert len(parse_leases("\n".join(lines) + "\n")[0]) == MAX_LEASES


@given(st.binary(max_size=80))
def test_any_bytes_of_inotify(data: bytes) -> None:
    assert all(isinstance(event, FileEvent) for event in parse_events(data))


def test_events_of_inotify() -> None:
    name = b"leases".ljust(16, b"\0")
    data = struct.pack("=iIII", 1, CREATE, 0, 16) + name + struct.pack("=iIII", 2, MODIFY, 0, 0)
    assert parse_events(data) == [FileEvent(1, CREATE, "leases"), FileEvent(2, MODIFY, "")]
    assert parse_events(data[:40]) == [FileEvent(1, CREATE, "leases")]


def test_the_kernels_own_events(tmp_path: Path) -> None:
    watcher = Inotify()
    try:
        folder = watcher.watch(tmp_path, CREATE)
        assert watcher.read() == []
        (tmp_path / "é").write_text("x")
        assert watcher.read() == [FileEvent(folder, CREATE, "é")]
        with pytest.raises(FileNotFoundError):
            watcher.watch(tmp_path / "none", MODIFY)
    finally:
        watcher.close()


async def take(out: Events) -> tuple[str, str, str | None, str | None]:
    async with asyncio.timeout(40.0):
        event = await out.get()
    return event.kind, event.mac, event.host_name, event.ip


def write(path: Path, *lines: str) -> None:
    """Write the file anew in place, in pieces, as dnsmasq does."""
    with path.open("r+" if path.exists() else "w") as file:
        for line in lines:
            file.write(line + "\n")
            file.flush()
        file.truncate()


LAMP_LEASE = f"17 {LAMP} 10.0.0.2 lamp *"
PHONE_LEASE = f"17 {PHONE} 10.0.0.3 anna *"


async def test_leases_are_told_when_they_change(tmp_path: Path) -> None:
    path, out = tmp_path / "leases", Events(64)
    source = LeaseSource(path)
    write(path, LAMP_LEASE)
    async with running(source, out):
        assert await take(out) == ("told", LAMP, "lamp", "10.0.0.2")
        assert source.health.detail == "1 leases"
        write(path, LAMP_LEASE.replace("17 ", "18 "), PHONE_LEASE)  # a renewal is no news
        assert await take(out) == ("told", PHONE, "anna", "10.0.0.3")
        write(path, PHONE_LEASE.replace("10.0.0.3", "10.0.0.9"))
        assert await take(out) == ("told", PHONE, "anna", "10.0.0.9")
        await until(lambda: source.health.detail == "1 leases")
        assert len(out) == 0


async def test_leases_let_join_where_nothing_else_does(tmp_path: Path) -> None:
    path, out = tmp_path / "leases", Events(64)
    write(path, LAMP_LEASE)
    async with running(LeaseSource(path, joins=True), out):
        assert await take(out) == ("joined", LAMP, "lamp", "10.0.0.2")
        write(path, LAMP_LEASE.replace("lamp", "light"), PHONE_LEASE)
        assert await take(out) == ("told", LAMP, "light", "10.0.0.2")
        assert await take(out) == ("joined", PHONE, "anna", "10.0.0.3")
        write(path, PHONE_LEASE)
        assert await take(out) == ("left", LAMP, "light", "10.0.0.2")


async def test_a_file_that_comes_later_is_replaced_and_goes(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "misc"
    path, out = folder / "leases", Events(64)
    source = LeaseSource(path)
    async with running(source, out):
        await until(lambda: "no folder" in source.health.detail)
        folder.mkdir()
        await until(lambda: "not there" in source.health.detail)
        write(path, LAMP_LEASE)
        assert await take(out) == ("told", LAMP, "lamp", "10.0.0.2")
        write(folder / "new", PHONE_LEASE)
        (folder / "new").replace(path)
        assert await take(out) == ("told", PHONE, "anna", "10.0.0.3")
        write(path, PHONE_LEASE.replace("anna", "ben"))  # the new file is watched
        assert await take(out) == ("told", PHONE, "ben", "10.0.0.3")
        path.unlink()
        await until(lambda: source.health.state == "degraded")
        write(path, PHONE_LEASE)
        assert await take(out) == ("told", PHONE, "anna", "10.0.0.3")
        (folder / "other").write_text("x")
        path.unlink()
        (folder / "other").unlink()
        folder.rmdir()
        await until(lambda: "no folder" in source.health.detail)
        folder.mkdir()
        write(path, LAMP_LEASE)
        assert await take(out) == ("told", LAMP, "lamp", "10.0.0.2")
    assert all(record.levelno <= logging.WARNING for record in caplog.records)


async def test_nonsense_in_the_file_is_counted_and_logged_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path, out = tmp_path / "leases", Events(64)
    source = LeaseSource(path)
    path.write_bytes(b"\xff\xfe nonsense\n" + LAMP_LEASE.encode() + b"\n")
    async with running(source, out):
        assert (await take(out))[1] == LAMP
        write(path, "nonsense", "more", PHONE_LEASE)
        assert (await take(out))[1] == PHONE
    assert source.health.counters["bad_input"] == 3
    assert len([record for record in caplog.records if record.levelno == logging.WARNING]) == 1


async def test_nothing_happens_while_nothing_changes(tmp_path: Path) -> None:
    """No wake-ups: between changes the source's task waits for the descriptor alone."""
    path, out = tmp_path / "leases", Events(64)
    source = LeaseSource(path)
    write(path, LAMP_LEASE)
    async with running(source, out):
        await take(out)
        await until(lambda: source.health.state == "ok")
        loop = asyncio.get_running_loop()
        waiting = [handle for handle in loop._scheduled if not handle.cancelled()]  # type: ignore[attr-defined]
        assert len(waiting) <= 1, "`until` is the only one with a timer"


IEEE = "28-6F-B9   (hex)\t\tNokia Shanghai Bell Co., Ltd.\n286FB9     (base 16)\t\tNokia\n\t\t\t\tChina\n"
NMAP = "# comment\n286FB9 Nokia Shanghai Bell\n0055DA0 ShinkoTechno\n70B3D5001 Soluciones\n"
MANUF = "28:6F:B9\tNokiaSha\tNokia Shanghai Bell\n00:55:DA:00:00:00/28\tShinko\tShinko Technos\n00:00:00 0 \n"


@pytest.mark.parametrize("text", [IEEE, NMAP, MANUF])
def test_lists_of_makers(text: str) -> None:
    makers = Makers(parse_makers(text.splitlines()))
    assert (makers.of("28:6f:b9:01:02:03") or "").startswith("Nokia Shanghai Bell")
    assert makers.of("2a:6f:b9:01:02:03") is None
    assert makers.of("28:6f:ba:01:02:03") is None


def test_the_longest_prefix_wins() -> None:
    makers = Makers(parse_makers(["0055DA Registry", *NMAP.splitlines()]))
    assert [makers.of(f"00:55:da:{byte}:00:01") for byte in ("0f", "1f")] == ["ShinkoTechno", "Registry"]
    assert makers.of("70:b3:d5:00:12:34") == "Soluciones"
    assert Makers(parse_makers(MANUF.splitlines())).of("00:55:da:0f:00:00") == "Shinko Technos"


@given(st.lists(st.text(max_size=60), max_size=5))
def test_any_list_of_makers(lines: list[str]) -> None:
    assert all(0 < bits <= 48 and value < 1 << bits for bits, value in parse_makers(lines))
    assert all(len(name) <= MAX_NAME for name in parse_makers(lines).values())


def test_the_first_list_that_is_there(tmp_path: Path) -> None:
    (tmp_path / "empty").write_text("")
    (tmp_path / "nmap").write_text(NMAP)
    makers = load_makers([tmp_path / "none", tmp_path / "empty", tmp_path / "nmap"])
    assert len(makers) == 3
    assert len(load_makers([tmp_path / "none"])) == 0
