"""Agents that appear on zenoh: real sessions over loopback, the hub's own kind of router."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Iterator

import pytest
import source_world
import zenoh
from waiting import free_port, until

from vad.agent.info import AgentInfo, decode_info, encode_info
from vad.bus.keys import HubKeys
from vad.bus.session import BusSettings, open_session
from vad.devices.agents import AgentSaid, AgentSource
from vad.devices.station import StationEvent
from vad.streams import DropOldestQueue

Events = DropOldestQueue[StationEvent]

KEYS = HubKeys("home")
CARD = "00:16:ea:00:00:01"


def said(payload: bytes) -> AgentSaid:
    info = decode_info(payload)
    return AgentSaid(info.mac, info.name)


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def router(endpoint: str) -> Iterator[zenoh.Session]:
    session = open_session(BusSettings(hub="home", listen=(endpoint,)))
    yield session
    session.close()  # type: ignore[no-untyped-call]


class Node:
    """An agent as far as discovery sees it: a token, and an answer on its key where it gives one."""

    def __init__(self, endpoint: str, agent: str, answer: bytes | None) -> None:
        self._session = open_session(BusSettings(hub="home", mode="client", connect=(endpoint,)))
        self._key = KEYS.agent_alive(agent)
        if answer is not None:
            self.say(answer)
        self._token = self._session.liveliness().declare_token(self._key)

    def say(self, answer: bytes) -> None:
        def reply(query: zenoh.Query) -> None:
            with query:
                query.reply(query.key_expr, answer)

        handler = zenoh.handlers.Callback(reply, None, indirect=False)
        self._session.declare_queryable(self._key, handler)

    def close(self) -> None:
        self._session.close()  # type: ignore[no-untyped-call]


@contextlib.asynccontextmanager
async def node(endpoint: str, agent: str, answer: bytes | None) -> AsyncIterator[Node]:
    there = await asyncio.to_thread(Node, endpoint, agent, answer)
    try:
        yield there
    finally:
        await asyncio.to_thread(there.close)


@contextlib.asynccontextmanager
async def running(router: zenoh.Session, out: Events) -> AsyncIterator[AgentSource]:
    source = AgentSource(router, KEYS.agent_alive(), said)
    async with source_world.running(source, out):
        yield source


async def take(out: Events) -> tuple[str, str, str | None, str | None, str]:
    async with asyncio.timeout(40.0):
        event = await out.get()
    return event.kind, event.mac, event.agent, event.host_name, event.interface


def info(agent: str, mac: str = CARD, name: str | None = None) -> bytes:
    return encode_info(AgentInfo(id=agent, mac=mac.upper(), name=name))


async def test_agents_come_and_go(router: zenoh.Session, endpoint: str) -> None:
    out = Events(16)
    early = info("early", "00:16:ea:00:00:02")
    async with node(endpoint, "early", early), running(router, out) as source:
        assert await take(out) == ("joined", "00:16:ea:00:00:02", "early", None, "agent early")
        async with node(endpoint, "lab", info("lab", name="the lab")):
            assert await take(out) == ("joined", CARD, "lab", "the lab", "agent lab")
            assert source.health.detail == "2 agents"
        assert (await take(out))[:3] == ("left", CARD, "lab")
        async with node(endpoint, "lab", info("lab")):
            assert (await take(out))[:3] == ("joined", CARD, "lab")
        assert (await take(out))[0] == "left"
        assert source.health.state == "ok"
        assert len(out) == 0


async def test_an_agent_that_says_who_it_is_later(router: zenoh.Session, endpoint: str) -> None:
    out = Events(16)
    async with running(router, out) as source, node(endpoint, "slow", None) as slow:
        await until(lambda: "does not say who it is" in source.health.detail)
        assert len(out) == 0
        await asyncio.to_thread(slow.say, info("slow"))
        assert (await take(out))[:3] == ("joined", CARD, "slow")
        assert source.health.state == "ok"


async def test_an_agent_that_talks_nonsense_is_trouble(router: zenoh.Session, endpoint: str) -> None:
    out = Events(16)
    async with running(router, out) as source:
        async with node(endpoint, "odd", b'{"id": "odd"}'):
            await until(lambda: source.health.counters["bad_input"] == 1)
            assert "odd" in source.health.detail
        async with node(endpoint, "good", info("good")):
            assert (await take(out))[:3] == ("joined", CARD, "good")
