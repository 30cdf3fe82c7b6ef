"""Real hostapd, dnsmasq and stations: who joins is in the table within a second.

The times are from when an observer of its own at hostapd's control socket has the event (or the test sees the
lease in its file) until the table has it and the store keeps it; they are printed (`pytest -s`).
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import statistics
import time
from collections.abc import AsyncIterator, Callable, Iterator
from functools import partial
from pathlib import Path

import pytest
from real_network import RealNetwork, why_not
from waiting import until

from vad.config import parse_settings
from vad.daemon.adapters import join_sources
from vad.daemon.roster import Roster
from vad.devices.device import Device
from vad.devices.station import StationEvent
from vad.store.worker import StoreWorker
from vad.streams import DropOldestQueue

pytestmark = [pytest.mark.slow, pytest.mark.timeout(240)]

LAMP, TV = "f4:f5:d8:00:00:01", "f4:f5:d8:00:00:02"
PHONE, PHONE_LATER = "02:00:00:00:00:0a", "06:00:00:00:00:0b"
SOON_S = 1.0
TIMES = 5


@pytest.fixture(scope="module")
def real() -> None:
    if reason := why_not():
        pytest.skip(reason)


@pytest.fixture
def network(real: None, tmp_path: Path) -> Iterator[RealNetwork]:
    with RealNetwork(tmp_path) as network:
        yield network
        print(network.said())  # noqa: T201 - pytest shows it where a test failed


class OwnTime:
    """Seconds of a clock that goes no faster than this machine works.

    For each tick something is handed to a thread and written to the disk, as the daemon does with an event.
    Where the machine is busy that takes longer than a tick, and the clock waits for it.
    """

    TICK_S = 0.01

    def __init__(self, folder: Path) -> None:
        self._file = folder / "own_time"
        self._ticks = 0
        self._ticked_s = time.monotonic()

    def now_s(self) -> float:
        return self._ticks * self.TICK_S + min(time.monotonic() - self._ticked_s, self.TICK_S)

    async def run(self) -> None:
        while True:
            await asyncio.to_thread(self._work)
            await asyncio.sleep(max(0.0, self._ticked_s + self.TICK_S - time.monotonic()))
            self._ticks += 1
            self._ticked_s = time.monotonic()

    def _work(self) -> None:
        with self._file.open("wb") as file:
            file.write(b"x")
            file.flush()
            os.fsync(file.fileno())


class Observer:
    """Stands beside the daemon at hostapd's control socket and notes when each event came."""

    def __init__(self, path: Path, own: Path, clock: OwnTime) -> None:
        self.events: list[tuple[float, str]] = []
        self._clock = clock
        self._own = own
        self._sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._sock.setblocking(False)
        self._sock.bind(str(own))
        self._sock.connect(str(path))
        self._sock.send(b"ATTACH")
        asyncio.get_running_loop().add_reader(self._sock, self._readable)

    def _readable(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                self.events.append((self._clock.now_s(), self._sock.recv(4096).decode()))

    async def hears(self, text: str) -> float:
        """When the last event with this text came; waits for one."""
        found: list[float] = []

        def heard() -> bool:
            found[:] = [at_s for at_s, said in self.events if text in said]
            return bool(found)

        await until(heard, f"the observer hears {text}")
        return found[-1]

    def close(self) -> None:
        asyncio.get_running_loop().remove_reader(self._sock)
        self._sock.close()
        self._own.unlink(missing_ok=True)


class Hub:
    """The daemon's own join sources, its roster and store; when each change was in the table and kept."""

    def __init__(self, roster: Roster, clock: OwnTime) -> None:
        self.roster = roster
        self.clock = clock
        self.changed_s: dict[str, float] = {}

    def kept(self, mac: str, since_s: float) -> bool:
        """Whether a change of this device was kept since then."""
        return self.changed_s.get(mac, -1.0) >= since_s

    def device(self, mac: str) -> Device | None:
        return self.roster.table.find(mac)

    def here(self, mac: str) -> bool:
        device = self.device(mac)
        return device is not None and self.roster.table.in_network(device) and device.current_mac == mac

    async def follow(self, stations: DropOldestQueue[StationEvent]) -> None:
        while True:
            events = [await stations.get(), *stations.drain()]
            for change in await self.roster.take(events):
                self.changed_s[change.device.current_mac] = self.clock.now_s()


@contextlib.asynccontextmanager
async def hub(network: RealNetwork) -> AsyncIterator[Hub]:
    text = f"""
map: {{file: floor.yaml}}
robot: {{type: neato, port: a}}
camera: {{source: {{type: v4l2, device: /dev/video0}}}}
radio: {{}}
devices:
  hostapd: [{network.socket(0)}, {network.socket(1)}]
  leases: [{network.leases}]
  agents: false
"""
    settings = parse_settings(text, where="vad.yaml")
    stations: DropOldestQueue[StationEvent] = DropOldestQueue(1024)
    async with StoreWorker(network.folder / "vad.sqlite") as store:
        roster = Roster(settings.devices, store, lambda _mac: False)
        await roster.load()
        clock = OwnTime(network.folder)
        there = Hub(roster, clock)
        # no zenoh session: it is for agents alone
        sources = join_sources(settings, network.folder, None)  # type: ignore[arg-type]
        tasks = [asyncio.create_task(source.run(stations)) for source in sources]
        tasks += [asyncio.create_task(there.follow(stations)), asyncio.create_task(clock.run())]
        try:
            yield there
        finally:
            assert not any(task.done() for task in tasks)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)


async def do(work: Callable[..., None], *arguments: object) -> None:
    await asyncio.to_thread(partial(work, *arguments))


def tell(what: str, delays_s: list[float]) -> None:
    print(  # noqa: T201 - the measured figure
        f"\n{what}: median {1e3 * statistics.median(delays_s):.0f} ms, worst {1e3 * max(delays_s):.0f} ms, "
        f"{len(delays_s)} times"
    )
    assert max(delays_s) < SOON_S


async def test_who_joins_is_in_the_table_within_a_second(network: RealNetwork) -> None:
    await do(network.start_hostapd, 0)
    await do(network.start_hostapd, 1)
    await do(network.start_dnsmasq)
    async with hub(network) as there:
        observer = Observer(network.socket(0), network.folder / "observer", there.clock)
        try:
            await until(lambda: bool(observer.events), "hostapd's answer")
            joining = []
            for number in range(TIMES):
                mac = f"f4:f5:d8:00:01:{number:02x}"
                await do(network.join, 0, mac)
                await until(lambda mac=mac: there.here(mac) and there.kept(mac, 0.0), f"{mac} in the table")
                heard_s = await observer.hears(f"AP-STA-CONNECTED {mac}")
                joining.append(there.changed_s[mac] - heard_s)
            tell("AP-STA-CONNECTED until in the table and in the store", joining)
            asked_s = there.clock.now_s()
            await do(network.logoff, 0)
            await until(lambda: not there.here(mac), "gone")
            left_s = await observer.hears(f"AP-STA-DISCONNECTED {mac}")
            await until(lambda: there.kept(mac, asked_s), "kept")
            tell("AP-STA-DISCONNECTED until gone", [there.changed_s[mac] - left_s])
        finally:
            observer.close()


async def test_names_and_addresses_come_from_dnsmasq(network: RealNetwork) -> None:
    await do(network.start_hostapd, 0)
    await do(network.start_hostapd, 1)
    await do(network.start_dnsmasq)
    async with hub(network) as there:
        leasing = []
        for number in range(TIMES):
            mac = f"f4:f5:d8:00:02:{number:02x}"
            await do(network.join, 0, mac)
            await until(lambda mac=mac: there.here(mac) and there.kept(mac, 0.0), f"{mac} in the table")
            asked_s = there.clock.now_s()
            asking = asyncio.create_task(do(network.ask_for_address, 0, f"lamp-{number}"))
            await until(lambda number=number: f"lamp-{number} " in network.leases.read_text(), "its lease")
            written_s = there.clock.now_s()
            await asking
            await until(lambda mac=mac: getattr(there.device(mac), "ip", None) is not None, "its address")
            await until(lambda mac=mac, asked_s=asked_s: there.kept(mac, asked_s), "kept")
            leasing.append(there.changed_s[mac] - written_s)
            device = there.device(mac)
            assert device is not None
            assert device.host_name == f"lamp-{number}"
            assert device.ip is not None
            assert device.ip.startswith("192.168.80.")
            assert await asyncio.to_thread(network.answers, 0, device.ip), "the address is the device's"
        tell("lease file written until in the table and in the store", leasing)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
async def test_hostapd_restarts_and_events_come_again(network: RealNetwork, number: signal.Signals) -> None:
    await do(network.start_hostapd, 0)
    await do(network.start_hostapd, 1)
    await do(network.start_dnsmasq)
    async with hub(network) as there:
        await do(network.join, 0, LAMP)
        await do(network.join, 1, TV)
        await until(lambda: there.here(LAMP) and there.here(TV), "both, on two interfaces")
        await do(network.stop, "hostapd0", number)
        await do(network.start_hostapd, 0)
        begun_s = there.clock.now_s()
        await until(lambda: not there.here(LAMP), "the new hostapd does not know it")
        assert there.here(TV), "the other interface goes on"
        tell("hostapd started again until its list is read", [there.clock.now_s() - begun_s])
        await do(network.logoff, 0)
        await do(network.logon, 0)
        await until(lambda: there.here(LAMP), "the lamp again")
        await do(network.leave, 1)
        await until(lambda: not there.here(TV), "the other one gone")


async def test_a_phone_takes_another_random_address_and_stays_one_device(network: RealNetwork) -> None:
    await do(network.start_hostapd, 0)
    await do(network.start_hostapd, 1)
    await do(network.start_dnsmasq)
    async with hub(network) as there:
        for mac in (PHONE, PHONE_LATER):
            await do(network.join, 0, mac)
            await until(lambda mac=mac: there.here(mac), f"{mac} in the table")
            await do(network.ask_for_address, 0, "Annas-Phone")
            await until(lambda mac=mac: getattr(there.device(mac), "ip", None) is not None, "its address")
        await until(lambda: len(there.roster.table) == 1, "one device")
        device = there.device(PHONE)
        assert device is not None
        assert device == there.device(PHONE_LATER)
        assert (device.mac, device.macs) == (PHONE, (PHONE, PHONE_LATER))
        assert await asyncio.to_thread(network.answers, 0, device.ip or ""), "the address is the present one"
    async with hub(network) as there:
        await until(lambda: there.here(PHONE_LATER), "after a restart of ours")
        assert there.roster.table.find(PHONE) == there.roster.table.find(PHONE_LATER)
        assert len(there.roster.table) == 1
