"""Robots on the network, found and tried."""

from __future__ import annotations

import asyncio
import json
import socket
import struct
import threading
import time
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from waiting import free_port

from vad.errors import ConfigError
from vad.setup import lan
from vad.setup.draft import channel_hz, robot_url, router_endpoint
from vad.setup.lan import find_valetudo, hear_router, hear_valetudo, is_mdns_answer, mdns_question
from vad.sim.valetudo import ValetudoServer

SERVICE = b"\x09_valetudo\x04_tcp\x05local\x00"


def answer_to(question: bytes) -> bytes:
    """A responder's answer (RFC 6762), built from the RFC and not from the code that is tested."""
    assert question[4:6] == b"\0\1", "one question"
    assert question[12 : 12 + len(SERVICE)] == SERVICE
    assert question[12 + len(SERVICE) :] == b"\0\x0c\x80\1", "PTR, IN, to me alone please"
    instance = b"\x0bRoborock S5\xc0\x0c"
    return (
        struct.pack(">6H", 0, 0x8400, 0, 1, 0, 0)
        + SERVICE
        + struct.pack(">HHIH", 12, 1, 120, len(instance))
        + instance
    )


def test_a_robot_that_answers_by_multicast_dns_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[bytes] = []

    def listened(data: bytes) -> bool:
        heard.append(data)
        return is_mdns_answer(data)

    # The search ends when all was heard, however long that takes.
    clock = SimpleNamespace(monotonic=lambda: time.monotonic() + (1000.0 if len(heard) == 3 else 0.0))
    monkeypatch.setattr(lan, "is_mdns_answer", listened)
    monkeypatch.setattr(lan, "time", clock)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as responder:
        responder.bind(("127.0.0.1", 0))

        def answer() -> None:
            data, who = responder.recvfrom(4096)
            responder.sendto(b"\0" * 5, who)
            responder.sendto(answer_to(data).replace(b"_valetudo", b"_printers"), who)
            responder.sendto(answer_to(data), who)

        thread = threading.Thread(target=answer)
        thread.start()
        found = find_valetudo(40.0, to=responder.getsockname())
        thread.join()
    assert found == ["127.0.0.1"]


@given(st.binary(max_size=64))
def test_whatever_comes_is_no_answer_unless_it_names_the_service(data: bytes) -> None:
    assert not is_mdns_answer(data) or SERVICE[:-1] in data


def test_a_question_is_no_answer() -> None:
    assert not is_mdns_answer(mdns_question())


async def test_a_robot_with_valetudo_is_heard_or_says_why_not() -> None:
    async with ValetudoServer(free_port(), password="me:secret") as robot:
        robot_map = {
            "__class": "ValetudoMap",
            "metaData": {"version": 2},
            "size": {"x": 1000, "y": 1000},
            "pixelSize": 5,
            "layers": [{"type": "floor", "pixels": [10, 10, 10, 11, 11, 10, 11, 11], "metaData": {}}],
            "entities": [
                {
                    "__class": "PointMapEntity",
                    "type": "robot_position",
                    "points": [52, 52],
                    "metaData": {"angle": 90},
                }
            ],
        }
        await robot.publish(json.dumps(robot_map).encode())
        good, told = await hear_valetudo(robot.url, 40.0)
        assert (good, told) == (True, "0 rooms, localised")
        good, told = await hear_valetudo(robot.url.replace("me:secret@", ""), 40.0)
        assert not good
        assert "password" in told
    good, told = await hear_valetudo(robot.url, 40.0)
    assert not good
    assert "cannot be reached" in told
    assert not (await hear_valetudo("ftp://robot", 1.0))[0]


async def test_a_router_answers_or_does_not() -> None:
    port = free_port()
    server = await asyncio.start_server(lambda _reader, writer: writer.close(), "127.0.0.1", port)
    assert await hear_router(f"tcp/127.0.0.1:{port}", 40.0) == (True, "it answers")
    server.close()
    await server.wait_closed()
    good, told = await hear_router(f"tcp/127.0.0.1:{port}", 40.0)
    assert not good
    assert str(port) in told


@pytest.mark.parametrize(
    ("typed", "endpoint"),
    [
        ("192.168.1.20", "tcp/192.168.1.20:7447"),
        ("robot.local:7448", "tcp/robot.local:7448"),
        ("tls/robot.local", "tls/robot.local:7447"),
        (" tcp/[fe80::1]:7447", "tcp/[fe80::1]:7447"),
        ("[fe80::1]", "tcp/[fe80::1]:7447"),
    ],
)
def test_what_people_type_for_a_router(typed: str, endpoint: str) -> None:
    assert router_endpoint(typed) == endpoint


def test_what_people_type_for_a_robot_and_a_channel() -> None:
    assert robot_url(" 192.168.1.30/") == "http://192.168.1.30"
    assert robot_url("https://me:x@robot") == "https://me:x@robot"
    assert channel_hz(36) == 5.18e9
    assert channel_hz(1) == 2.412e9
    for wrong in (0, 14, 35, 178):
        with pytest.raises(ConfigError):
            channel_hz(wrong)
    with pytest.raises(ConfigError):
        router_endpoint("tcp/")
