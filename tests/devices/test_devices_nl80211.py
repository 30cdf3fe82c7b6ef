"""The kernel's stations: messages byte by byte, and the source against a kernel that speaks them."""

from __future__ import annotations

import asyncio
import contextlib
import struct
from collections.abc import AsyncIterator

import fake_nl80211 as fake
import pytest
from fake_nl80211 import ACCESS_POINT, FAMILY, STATION, FakeKernel
from hypothesis import given
from hypothesis import strategies as st
from source_world import running
from waiting import until

from vad.devices import nl80211_source
from vad.devices.nl80211 import (
    Family,
    Finished,
    Interface,
    StationSeen,
    family_request,
    interfaces_request,
    parse_datagram,
    stations_request,
)
from vad.devices.nl80211_source import Nl80211Source
from vad.devices.station import StationEvent
from vad.errors import ProtocolError
from vad.mac import mac_to_text
from vad.streams import DropOldestQueue

Events = DropOldestQueue[StationEvent]

A, B, C = "f4:f5:d8:00:00:0a", "f4:f5:d8:00:00:0b", "02:00:00:00:00:0c"
DAMAGED = fake.interface(3, "wlan0", 3) + fake.station(3, A, True)


def test_requests() -> None:
    """As `strace iw` shows them."""
    assert (
        family_request(1).hex()
        == "2000000010000100010000000000000003010000" + "0c000200" + b"nl80211\0".hex()
    )
    assert interfaces_request(30, 2).hex() == "140000001e000103020000000000000005010000"
    assert stations_request(30, 3, 7).hex() == "1c0000001e0001030300000000000000110100000800030007000000"


def test_messages() -> None:
    datagram = b"".join(
        (
            fake.family(1),
            fake.interface(3, "wlan0", ACCESS_POINT, seq=2),
            fake.interface(4, "wlan1", STATION, seq=2),
            fake.station(3, A, None),
            fake.station(3, B, False, seq=3),
            fake.station(3, C, True, seq=3),
            fake.station(3, C, None, gone=True),
            fake.message(FAMILY, 15, fake.attribute(3, struct.pack("=I", 3))),
            fake.message(FAMILY, 1),
            fake.message(99, 19),
            fake.done(3),
            fake.refusal(4, 19),
        )
    )
    assert list(parse_datagram(datagram, FAMILY)) == [
        Family(FAMILY, {"config": fake.CONFIG, "mlme": fake.MLME}),
        Interface(2, 3, "wlan0", access_point=True),
        Interface(2, 4, "wlan1", access_point=False),
        StationSeen(0, 3, A, None),
        StationSeen(3, 3, B, authorized=False),
        StationSeen(3, 3, C, authorized=True),
        StationSeen(0, 3, C, None, present=False),
        Interface(0, 3, "", access_point=False),
        Finished(3, 0),
        Finished(4, 19),
    ]


@given(st.integers(1, 1 << 20), st.integers(0, (1 << 48) - 1).map(mac_to_text), st.booleans(), st.booleans())
def test_every_station_comes_back(index: int, mac: str, authorized: bool, gone: bool) -> None:
    data = fake.station(index, mac, authorized, gone=gone)
    assert list(parse_datagram(data, FAMILY)) == [StationSeen(0, index, mac, authorized, not gone)]


@given(st.data())
def test_damaged_messages_give_values_or_a_typed_error(data: st.DataObject) -> None:
    raw = bytearray(DAMAGED)
    for place in data.draw(st.lists(st.integers(0, len(raw) - 1), max_size=4)):
        raw[place] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(raw)))
    with contextlib.suppress(ProtocolError):
        list(parse_datagram(bytes(raw[:cut]), FAMILY))


@given(st.binary(max_size=100))
def test_any_bytes_give_values_or_a_typed_error(raw: bytes) -> None:
    with contextlib.suppress(ProtocolError):
        list(parse_datagram(raw, FAMILY))


async def take(out: Events) -> tuple[str, str, str]:
    async with asyncio.timeout(40.0):
        event = await out.get()
    return event.kind, event.mac, event.interface


@pytest.fixture
async def kernel() -> AsyncIterator[FakeKernel]:
    kernel = FakeKernel()
    kernel.interfaces = {3: ("wlan0", ACCESS_POINT), 4: ("wlan1", ACCESS_POINT), 5: ("wlp2s0", STATION)}
    yield kernel
    kernel.close()


@pytest.fixture
def source(kernel: FakeKernel) -> Nl80211Source:
    return Nl80211Source(["wlan0", "wlan1"], opened=kernel.opened)


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel answers in this process: a late answer tells of the machine, not of the kernel."""
    monkeypatch.setattr(nl80211_source, "REPLY_S", 600.0)


@pytest.mark.usefixtures("patient")
async def test_who_is_in_comes_and_goes(kernel: FakeKernel, source: Nl80211Source) -> None:
    out = Events(64)
    kernel.stations = {3: {A: True, C: False}, 4: {B: True}, 5: {C: True}}
    async with running(source, out):
        assert {await take(out), await take(out)} == {("joined", A, "wlan0"), ("joined", B, "wlan1")}
        await until(lambda: source.health.state == "ok")
        assert sorted(option[2] for option in kernel.memberships) == sorted((fake.MLME, fake.CONFIG))
        kernel.associate(3, B, authorized=True)
        assert await take(out) == ("joined", B, "wlan0")
        kernel.leave(3, B)
        assert await take(out) == ("left", B, "wlan0")
        kernel.leave(3, C)  # was never let in
        kernel.associate(5, A)  # we are no access point there
        kernel.leave(3, A)
        assert await take(out) == ("left", A, "wlan0")
        assert source.health.detail == "1 stations"
        assert len(out) == 0


@pytest.mark.usefixtures("patient")
async def test_a_station_joins_when_it_was_let_in_and_nobody_asks_afterwards(
    kernel: FakeKernel, source: Nl80211Source
) -> None:
    out = Events(64)
    async with running(source, out):
        await until(lambda: source.health.state == "ok")
        kernel.associate(3, A)
        asked = kernel.lists
        await until(lambda: kernel.lists >= asked + 2)
        assert len(out) == 0, "it has associated, the handshake goes on"
        kernel.stations[3][A] = True
        assert await take(out) == ("joined", A, "wlan0")
        asked = kernel.lists
        kernel.associate(4, B)
        kernel.leave(4, B)  # a wrong password
        kernel.associate(3, C, authorized=True)
        assert await take(out) == ("joined", C, "wlan0")
        assert kernel.lists <= asked + 3
        assert not source._asked, "nothing is asked while nobody waits to be let in"
        assert len(out) == 0


@pytest.mark.usefixtures("patient")
async def test_an_interface_becomes_an_access_point_later_and_goes(
    kernel: FakeKernel, source: Nl80211Source
) -> None:
    out = Events(64)
    kernel.interfaces = {3: ("wlan0", STATION)}
    async with running(source, out):
        await until(lambda: "no wireless interface wlan1" in source.health.detail)
        kernel.interfaces[4] = ("wlan1", ACCESS_POINT)
        kernel.send([fake.interface(4, "wlan1", ACCESS_POINT)])
        await until(lambda: "wlan0 is no access point" in source.health.detail)
        kernel.interfaces[3] = ("wlan0", ACCESS_POINT)  # the kernel does not tell that it became one
        kernel.associate(3, A, authorized=True)
        assert await take(out) == ("joined", A, "wlan0")
        await until(lambda: source.health.state == "ok")
        kernel.interfaces.pop(3)
        kernel.send([fake.interface(3, "wlan0", ACCESS_POINT, command=8)])
        assert await take(out) == ("left", A, "wlan0")


async def test_that_an_interface_became_an_access_point_no_event_tells(
    kernel: FakeKernel, source: Nl80211Source
) -> None:
    kernel.interfaces = {3: ("wlan0", STATION), 4: ("wlan1", ACCESS_POINT)}
    async with running(source, Events(1)):
        await until(lambda: "wlan0 is no access point" in source.health.detail)
        kernel.interfaces[3] = ("wlan0", ACCESS_POINT)
        await until(lambda: source.health.state == "ok")


@pytest.mark.usefixtures("patient")
async def test_after_a_lost_connection_everything_is_read_anew(
    kernel: FakeKernel, source: Nl80211Source
) -> None:
    out = Events(64)
    kernel.stations = {3: {A: True, B: True}}
    async with running(source, out):
        assert {(await take(out))[1], (await take(out))[1]} == {A, B}
        kernel.stations = {3: {B: True, C: True}}
        kernel.send([b"\x05\0\0\0 nonsense"])
        await until(lambda: source.health.counters["bad_input"] == 1)
        kernel.close()
        assert {await take(out), await take(out)} == {("left", A, "wlan0"), ("joined", C, "wlan0")}


async def test_a_kernel_without_wifi_and_one_that_is_mute(kernel: FakeKernel, source: Nl80211Source) -> None:
    kernel.has_wifi = False
    async with running(source, Events(1)):
        await until(lambda: "driver loaded" in source.health.detail)
        kernel.mute = True
        await until(lambda: "no reply" in source.health.detail)


async def test_this_machines_own_kernel() -> None:
    """The real socket: whatever Wi-Fi there is, it has no such interface."""
    source = Nl80211Source(["vad-none0"])
    async with running(source, Events(1)):
        told = ("driver loaded", "no wireless interface")
        await until(lambda: any(words in source.health.detail for words in told))
        assert source.health.state == "degraded"
