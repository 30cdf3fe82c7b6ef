"""Echo requests to several devices: the rate is shared, what was sent is counted once."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator

import pytest
from waiting import until

from vad.daemon.traffic import Traffic

LAMP, TV, PLUG = "lamp", "tv", "plug"
ADDRESSES = {LAMP: "127.0.0.2", TV: "127.0.0.3"}  # the kernel answers for all of 127.0.0.0/8


@pytest.fixture
async def traffic() -> AsyncIterator[Traffic]:
    for kind in (socket.SOCK_DGRAM, socket.SOCK_RAW):
        try:
            socket.socket(socket.AF_INET, kind, socket.IPPROTO_ICMP).close()
            break
        except PermissionError:
            continue
    else:
        pytest.skip("echo requests are not permitted here")
    made = Traffic(400.0, ADDRESSES.get)
    yield made
    await made.stop()


def flows() -> int:
    return sum(task.get_name().startswith("echo traffic") for task in asyncio.all_tasks())


async def test_several_devices_share_the_rate_and_the_count(traffic: Traffic) -> None:
    assert traffic.reaches(LAMP)
    assert not traffic.reaches(PLUG)
    await traffic.towards((LAMP, TV, PLUG))
    await until(lambda: (traffic.sent(), traffic.health.counters["replies"])[1] > 20, "replies")
    assert flows() == 2

    def told() -> int:
        return traffic.health.detail.count(" of 200 packets/s")

    await until(lambda: (traffic.sent(), told())[1] == 2, "both are told of")
    before = traffic.health.counters["sent"]
    await traffic.towards((TV,))
    assert flows() == 1
    await until(lambda: traffic.sent() > 0, "it goes on")
    await traffic.stop()
    assert flows() == 0
    rest = traffic.sent()
    assert traffic.sent() == 0
    assert traffic.health.counters["sent"] >= before + rest
    assert traffic.health.detail == "nobody is measured"


async def test_the_same_devices_again_change_nothing(traffic: Traffic) -> None:
    await traffic.towards((LAMP,))
    (task,) = (t for t in asyncio.all_tasks() if t.get_name().startswith("echo traffic"))
    await traffic.towards((LAMP,))
    assert not task.cancelled()
    assert flows() == 1


async def test_no_rate_reaches_nobody() -> None:
    traffic = Traffic(0.0, ADDRESSES.get)
    assert not traffic.reaches(LAMP)
    await traffic.towards((LAMP,))
    assert flows() == 0
