"""tools/examples against a real bus: the Python ones run, and what the TypeScript one asks is answered so."""

from __future__ import annotations

import asyncio
import json
import re
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from waiting import free_port

from vad.bus import messages as m
from vad.bus.node import Bus
from vad.bus.schemas import json_schemas
from vad.bus.session import BusSettings
from vad.client import VadClient

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "tools" / "examples"
TYPESCRIPT = (EXAMPLES / "typescript" / "devices.ts").read_text(encoding="utf-8")
MAC = "aa:bb:cc:dd:ee:01"
STARTED_S = 60.0
"""A busy machine takes its time to load a program."""


@asynccontextmanager
async def hub() -> AsyncIterator[tuple[Bus, str]]:
    """A bus with a lamp on it."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with Bus(BusSettings(listen=(endpoint,)), source="simulated") as bus:
        bus.publish_device(
            m.DeviceMessage(
                source="simulated",
                mac=MAC,
                name="lamp",
                state="mapped",
                x_m=1.0,
                y_m=2.0,
                covariance_m2=((0.01, 0.0), (0.0, 0.01)),
                room="Hall",
            )
        )
        bus.publish_heatmap(
            m.heatmap_message(
                np.ones((2, 2)), source="simulated", mac=MAC, epoch=1, bounds_m=(0, 0, 2, 2), step_m=1
            )
        )
        bus.publish_event(m.EventMessage(source="simulated", kind="joined", mac=MAC, text="lamp joined"))
        yield bus, endpoint


@asynccontextmanager
async def example(name: str, endpoint: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """An example as a process, which goes with its test."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, EXAMPLES / name, endpoint, stdout=subprocess.PIPE, cwd=ROOT
    )
    try:
        yield process
    finally:
        assert process.stdout is not None
        with suppress(ProcessLookupError):
            process.kill()
        while await process.stdout.read(65536):
            pass
        await process.wait()


async def tell_until(bus: Bus, process: asyncio.subprocess.Process, words: str) -> str:
    """Let something new happen again and again until the example has said `words`; what it said."""
    assert process.stdout is not None
    said, number = "", 0
    reading = asyncio.create_task(process.stdout.readline())
    try:
        async with asyncio.timeout(STARTED_S):
            while words not in said:
                number += 1
                bus.publish_event(
                    m.EventMessage(source="simulated", kind="moved", mac=MAC, text="lamp moved")
                )
                bus.publish_device(
                    m.DeviceMessage(source="simulated", mac=MAC, state="waiting", reason=f"walk {number}")
                )
                done, _ = await asyncio.wait({reading}, timeout=0.1)
                if done:
                    line = (await reading).decode()
                    assert line, f"it ended: {said}"
                    said += line
                    reading = asyncio.create_task(process.stdout.readline())
    finally:
        reading.cancel()
        await asyncio.wait({reading})
    return said


@pytest.mark.parametrize(
    ("name", "last", "also"),
    [
        ("client.py", "lamp moved", ["lamp: Hall, x 1.00 m, y 2.00 m", "holds 25.0%", "lamp joined"]),
        ("plain_zenoh.py", "lamp moved", [f"{MAC} mapped Hall 1.0 2.0", "DeviceMessage"]),
    ],
)
async def test_a_python_example_runs(name: str, last: str, also: list[str]) -> None:
    async with hub() as (bus, endpoint), example(name, endpoint) as process:
        assert process.stdout is not None
        async with asyncio.timeout(STARTED_S):
            first = ""
            while "from now on" not in first:
                line = (await process.stdout.readline()).decode()
                assert line, f"it ended: {first}"
                first += line
        said = first + await tell_until(bus, process, last)
        for words in also:
            assert words in said


async def test_the_asyncio_example_runs() -> None:
    class Memory:
        async def devices_at(self, at: str, mac: str | None) -> list[m.DeviceMessage]:
            return []

        async def history(self, mac: str, question: object) -> m.HistoryMessage | None:
            entry = m.HistoryEntry(at="2026-01-31T12:00:00.000Z", state="mapped", epoch=1)
            return m.HistoryMessage(source="live", mac=mac, entries=(entry,))

    async with hub() as (bus, endpoint):
        bus.ask_past(Memory())
        async with example("client_asyncio.py", endpoint) as process:
            said = await tell_until(bus, process, f"{MAC} waiting walk")
        assert f"{MAC} mapped\n" in said


async def test_what_the_typescript_example_asks_is_answered_as_it_reads() -> None:
    """It needs zenohd's plugin to run: its keys, and the fields of its types, are held to ours."""
    (selector,) = re.findall(r'session\.get\("([^"]+)"\)', TYPESCRIPT)
    (events,) = re.findall(r'declareSubscriber\("([^"]+)"\)', TYPESCRIPT)
    key, _, parameters = selector.partition("?")
    async with hub() as (bus, endpoint):

        def ask() -> None:
            with VadClient(endpoint) as client:
                assert (client.keys.devices, client.keys.events) == (key, events)
                assert client._session is not None
                (reply,) = list(client._session.get(f"{key}?{parameters}", timeout=40.0))
                assert reply.ok is not None
                answer = json.loads(reply.ok.payload.to_string())
                assert answer["schema"] == "vad.devices.v1"
                assert [device["mac"] for device in answer["devices"]] == [MAC]

        await asyncio.to_thread(ask)
        assert bus.health.state == "ok"


@pytest.mark.parametrize(
    ("interface", "schema", "kind"),
    [
        ("Device", "vad.device.v1", "DeviceMessage"),
        ("Devices", "vad.devices.v1", "DevicesMessage"),
        ("Event", "vad.event.v1", "EventMessage"),
    ],
)
def test_the_typescript_types_are_the_schemas(interface: str, schema: str, kind: str) -> None:
    (body,) = re.findall(rf"interface {interface} {{\n(.*?)\n}}", TYPESCRIPT, re.DOTALL)
    fields = dict(re.findall(r"^  (\w+): (.+);$", body, re.MULTILINE))
    known = json.loads(json_schemas()[schema])["$defs"][kind]["properties"]
    assert len(fields) == body.count(";")
    for name, typed in fields.items():
        property_ = known[name]
        if "enum" in property_:
            assert sorted(re.findall(r'"([^"]+)"', typed)) == sorted(property_["enum"])
            continue
        kinds = {part.get("type") for part in property_.get("anyOf", [property_])}
        in_typescript = {"string", "number", "null"} & set(typed.replace("|", " ").split())
        assert in_typescript == kinds - {"array"}, (name, typed)
        assert ("[]" in typed) == ("array" in kinds)
