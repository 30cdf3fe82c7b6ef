"""How a hub comes up, who may reach it, and how it goes away."""

from __future__ import annotations

import asyncio
import signal
import sys
import threading
import time
from collections.abc import Iterator

import pytest
import zenoh
from bus_world import ROOT, device, mac, settings
from waiting import until

from vad.bus.answers import Reply
from vad.bus.closing import CLOSE_TIMEOUT_S
from vad.bus.keys import HubKeys
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
        alive = attic.session.liveliness().get
        await until(lambda: len(list(alive(HubKeys("*").alive))) == 2, "the router knows of the cellar")
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
    assert time.monotonic() - start < 9.0, "zenoh tries for 10 s to say goodbye to who does not read"
    left = [t.name for t in threading.enumerate() if not t.daemon and t is not threading.main_thread()]
    assert [name for name in left if not name.startswith("asyncio_")] == []
    bus.publish_device(device(1))  # after the end: no error, nobody hears
    async with Bus(settings(endpoint)):
        pass  # the port is free again


async def test_a_reader_that_stopped_reading_holds_up_nobody(
    endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its link is given much longer than otherwise: others are asked and answered, and the bus closes, within
    that time.
    """
    monkeypatch.setattr("vad.bus.session.BLOCK_WAIT_US", 15_000_000)
    monkeypatch.setattr("vad.bus.closing.CLOSE_TIMEOUT_S", CLOSE_TIMEOUT_S)
    reader = (
        "import sys, time, zenoh\nfrom vad.bus.session import BusSettings, open_session\n"
        "session = open_session(BusSettings(mode='client', connect=(sys.argv[1],)))\n"
        "full = zenoh.handlers.FifoChannel(1)\n"
        "asked = session.get('vad/home/devices/*', full, target=zenoh.QueryTarget.ALL,\n"
        "                    consolidation=zenoh.ConsolidationMode.NONE, timeout=60)\n"
        "time.sleep(60)\n"
    )
    bus = Bus(settings(endpoint))
    region = tuple((k / 3, k / 7) for k in range(3000))
    for i in range(500):  # its answer is more than all buffers on the way hold
        bus.publish_device(device(i, region90=region))
    sent, over = 0, threading.Event()
    send = bus._send

    def watched(query: zenoh.Query, replies: list[Reply]) -> str:
        def counted() -> Iterator[Reply]:
            nonlocal sent
            for reply in replies:
                sent += 1
                yield reply

        if len(replies) == 1:
            return send(query, replies)
        outcome = send(query, counted())  # type: ignore[arg-type]
        over.set()
        return outcome

    seen, since_s = 0, time.monotonic()

    def stuck() -> bool:
        nonlocal seen, since_s
        if sent != seen:
            seen, since_s = sent, time.monotonic()
        return sent > 0 and time.monotonic() - since_s > 0.3

    def closing() -> bool:
        return any(thread.name == "vad-bus-close" for thread in threading.enumerate())

    monkeypatch.setattr(bus, "_send", watched)
    await bus.open()
    client = VadClient(endpoint)
    await asyncio.to_thread(client.open)
    process = await asyncio.create_subprocess_exec(sys.executable, "-c", reader, endpoint, cwd=ROOT)
    try:
        await until(lambda: sent > 0, "its question has come")
        process.send_signal(signal.SIGSTOP)
        await until(stuck, "the answer gets no further")
        assert await asyncio.to_thread(client.device, mac(7)) is not None
        assert not over.is_set(), "the other one is answered meanwhile"
        await asyncio.to_thread(client.close)
        await bus.close()
        assert closing(), "zenoh goes on saying goodbye, and nobody waits for it"
    finally:
        process.kill()
        await process.wait()
    # Until then one of the threads that zenoh has for all sessions of a process is held up.
    await until(lambda: over.is_set() and not closing(), "its link is given up")


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
