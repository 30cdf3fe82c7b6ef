"""How a hub comes up, who may reach it, and how it goes away."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
import threading
import time

import pytest
from bus_world import ROOT, device, mac, settings

from vad.bus.node import Bus
from vad.bus.session import BusSettings, check_endpoint, open_session
from vad.client import VadClient
from vad.errors import VadError


async def test_two_hubs_are_told_apart(endpoint: str) -> None:
    def ask() -> None:
        with VadClient(endpoint) as client:
            assert client.hubs() == ["attic", "cellar"]
            assert [(d.mac, d.hub) for d in client.devices()] == [(mac(0), "attic"), (mac(0), "cellar")]
            with pytest.raises(VadError, match="2 hubs answer"):
                client.device(mac(0))
        with VadClient(endpoint, "cellar") as client:
            found = client.device(mac(0))
            assert found is not None
            assert found.hub == "cellar"

    client_mode = BusSettings(hub="cellar", mode="client", connect=(endpoint,))
    async with Bus(settings(endpoint, "attic")) as attic, Bus(client_mode) as cellar:
        attic.publish_device(device(0))
        cellar.publish_device(device(0))
        await asyncio.to_thread(ask)


async def test_closing_is_quick_and_leaves_no_thread(endpoint: str) -> None:
    def ask() -> None:
        with VadClient(endpoint) as client:
            client.devices()

    bus = Bus(settings(endpoint))
    await bus.open()
    bus.publish_device(device())
    await asyncio.to_thread(ask)
    start = time.monotonic()
    await bus.close()
    await bus.close()
    assert time.monotonic() - start < 1.0
    left = [t.name for t in threading.enumerate() if not t.daemon and t is not threading.main_thread()]
    assert [name for name in left if not name.startswith("asyncio_")] == []
    bus.publish_device(device(1))  # after the end: no error, nobody hears
    async with Bus(settings(endpoint)):
        pass  # the port is free again


async def test_a_reader_that_stopped_reading_holds_up_nobody(endpoint: str) -> None:
    reader = (
        "import sys, time, zenoh\nfrom vad.bus.session import BusSettings, open_session\n"
        "session = open_session(BusSettings(mode='client', connect=(sys.argv[1],)))\n"
        "full = [zenoh.handlers.FifoChannel(1) for _ in range(30)]\n"
        "asked = [session.get('vad/home/devices/*', f, target=zenoh.QueryTarget.ALL,\n"
        "                     consolidation=zenoh.ConsolidationMode.NONE, timeout=60) for f in full]\n"
        "print('asked', flush=True)\ntime.sleep(60)\n"
    )
    bus = Bus(settings(endpoint))
    await bus.open()
    for i in range(500):
        bus.publish_device(device(i, region90=tuple((0.1 * k, 0.2 * k) for k in range(400))))
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", reader, endpoint, stdout=subprocess.PIPE, cwd=ROOT
    )
    assert process.stdout is not None
    assert await process.stdout.readline() == b"asked\n"
    process.send_signal(signal.SIGSTOP)
    try:
        client = VadClient(endpoint)
        await asyncio.to_thread(client.open)
        start = time.monotonic()
        assert await asyncio.to_thread(client.device, mac(7)) is not None
        assert time.monotonic() - start < 0.5
        await asyncio.to_thread(client.close)
        start = time.monotonic()
        await bus.close()
        assert time.monotonic() - start < 1.0
    finally:
        process.kill()
        await process.wait()


async def test_a_taken_port_is_explained(endpoint: str) -> None:
    async with Bus(settings(endpoint)):
        with pytest.raises(VadError, match="the port is taken"):
            await Bus(settings(endpoint)).open()


def test_a_daemon_needs_a_name(endpoint: str) -> None:
    with pytest.raises(VadError, match="hub name"):
        Bus(settings(endpoint, "*"))


@pytest.mark.parametrize(
    "good",
    [
        "tcp/127.0.0.1:7447",
        "tcp/localhost:1",
        "tcp/[::1]:7447",
        "tcp/127.9.9.9:7447",
        "tls/0.0.0.0:7448",
        "tls/[::]:7448",
        "tls/hub.local:7448",
    ],
)
def test_loopback_is_accepted_and_tls_anywhere(good: str) -> None:
    check_endpoint(good)


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        ("tcp/0.0.0.0:7447", "vad pki init"),
        ("tcp/192.168.1.5:7447", "vad pki init"),
        ("tcp/[::]:7447", "vad pki init"),
        ("tcp/hub.local:7447", "vad pki init"),
        ("udp/127.0.0.1:7447", "not supported"),
        ("ws/127.0.0.1:7447", "not supported"),
        ("tcp/127.0.0.1", "not an endpoint"),
        ("tcp/127.0.0.1:99999", "not an endpoint"),
        ("127.0.0.1:7447", "not an endpoint"),
        ("tcp/127.0.0.1:7447, tls/0.0.0.0:7448", "not an endpoint"),
        ("tcp/127.0.0.1:7447#iface=eth0", "not an endpoint"),
        ("tls/0.0.0.0:7448;prio=1", "not an endpoint"),
        ("", "not an endpoint"),
    ],
)
def test_anything_else_is_refused(bad: str, reason: str) -> None:
    with pytest.raises(VadError, match=reason):
        open_session(BusSettings(listen=(bad,)))
    with pytest.raises(VadError, match=reason):
        VadClient(bad).open()
