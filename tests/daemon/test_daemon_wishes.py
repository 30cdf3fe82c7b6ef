"""`vad device`: what people want of a device, through a real bus to the registry and its store."""

from __future__ import annotations

import asyncio
import contextlib
import json
import resource
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from functools import partial
from pathlib import Path

import pytest
from daemon_world import ASK_S, settings_for
from typer.testing import CliRunner
from waiting import free_port

from vad.bus import messages as m
from vad.bus.node import Bus
from vad.bus.session import BusSettings
from vad.client import QueryError, VadClient
from vad.commands import device as device_command
from vad.commands.device import device_app
from vad.daemon.registry import Registry
from vad.daemon.wishes import MAX_BYTES, WAITING_AT_MOST, Wishes
from vad.sim.home import floor_plan
from vad.sim.scenario import make_home
from vad.store.worker import StoreWorker

LAMP, TV, PHONE = (f"f4:f5:d8:00:00:0{k}" for k in (1, 2, 3))
PLAN = floor_plan(make_home(1))
KEPT_S = 20.0
"""How long a wish may take to be kept on a busy disk; on one that is full it is in vain."""

pytestmark = pytest.mark.timeout(200)

PatientClient = partial(VadClient, timeout_s=ASK_S)


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command waits for a busy machine longer than people would."""
    monkeypatch.setattr(device_command, "VadClient", PatientClient)


class Home:
    """A hub with a lamp and a TV; the settings name the TV and ignore the phone."""

    def __init__(
        self, endpoint: str, wishes: Wishes | None = None, answering: asyncio.Task[None] | None = None
    ) -> None:
        self._endpoint = endpoint
        self._answering = answering
        self.wishes = wishes

    async def end(self) -> None:
        """Grant no more wishes, as a daemon that stops."""
        if self._answering is not None:
            self._answering.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._answering

    async def vad_device(self, *arguments: str, code: int = 0) -> str:
        """What the command says."""
        command = [*arguments, "--endpoint", self._endpoint]
        result = await asyncio.to_thread(CliRunner().invoke, device_app, command)
        assert result.exit_code == code, (result.output, result.exception)
        return " ".join((result.stdout + result.stderr).split())

    async def devices(self) -> dict[str, str | None]:
        """MAC -> name of all that are published."""

        def ask() -> list[m.DeviceMessage]:
            with PatientClient(self._endpoint) as client:
                return client.devices()

        return {device.mac: device.name for device in await asyncio.to_thread(ask)}

    async def wish_raw(self, payload: bytes) -> str:
        """What the daemon says to any bytes as a wish."""

        def ask() -> str:
            with PatientClient(self._endpoint) as client:
                question = client._questions.wish(m.DeviceWish())
                with pytest.raises(QueryError) as caught:
                    client._ask(type(question)("vad/home/wishes", question.read, payload))
                assert caught.value.code == "bad_wish"
                return str(caught.value)

        return await asyncio.to_thread(ask)


@asynccontextmanager
async def home(folder: Path, *, patience_s: float = KEPT_S) -> AsyncIterator[Home]:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    devices = {"ignore": [PHONE], "static": [{"mac": TV, "name": "the big one"}]}
    settings = settings_for(folder, devices=devices)
    async with StoreWorker(folder / "vad.sqlite") as store, Bus(BusSettings(listen=(endpoint,))) as bus:
        registry = Registry(settings, PLAN, bus, store)
        await registry.load()
        for mac, name in ((LAMP, "ESP_1234"), (TV, None), (PHONE, "phone")):
            await registry.joined(mac, name)
        wish = Wishes(bus.keys, registry, "simulated", patience_s=patience_s)
        there = Home(endpoint, wish, asyncio.create_task(wish.run(bus.session)))
        await asyncio.sleep(0)  # its first step: from then on wishes are heard
        try:
            yield there
        finally:
            await there.end()


async def test_a_device_is_ignored_and_shown_again(tmp_path: Path) -> None:
    async with home(tmp_path) as there:
        assert await there.vad_device("ignore", LAMP.upper()) == f"{LAMP} is left alone from now on"
        assert await there.devices() == {TV: "the big one"}
        said = await there.vad_device("ignored")
        assert f"{LAMP} ESP_1234" in said
        assert said.endswith("vad device ignore") or f"{PHONE} phone" in said
    async with home(tmp_path) as there:
        listed = json.loads(await there.vad_device("ignored", "--json"))
        assert {(one["mac"], one["by_settings"]) for one in listed} == {(LAMP, False), (PHONE, True)}
        assert await there.vad_device("show", LAMP) == f"{LAMP} is a device again"
        assert await there.devices() == {LAMP: "ESP_1234", TV: "the big one"}
        assert "the settings ignore" in await there.vad_device("show", PHONE, code=2)


async def test_a_device_is_renamed_and_forgotten(tmp_path: Path) -> None:
    async with home(tmp_path) as there:
        assert await there.vad_device("rename", LAMP, " lamp ") == f"{LAMP} is called 'lamp'"
        assert (await there.devices())[LAMP] == "lamp"
        assert await there.vad_device("rename", LAMP, "") == f"{LAMP} has no given name"
        assert (await there.devices())[LAMP] == "ESP_1234"
        assert "in the settings" in await there.vad_device("rename", TV, "small", code=2)
        assert "forgotten" in await there.vad_device("forget", LAMP)
        assert await there.devices() == {TV: "the big one"}
        assert "no device with the address" in await there.vad_device("forget", LAMP, code=2)
        assert "not a MAC address" in await there.vad_device("forget", "lamp", code=2)


@contextmanager
def disk_full(folder: Path) -> Iterator[None]:
    """The database grows no more: what a disk does that has no room left."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, ((folder / "vad.sqlite-wal").stat().st_size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


async def test_what_cannot_be_kept_now_waits_and_says_so(tmp_path: Path) -> None:
    async with home(tmp_path, patience_s=1.0) as there:
        with disk_full(tmp_path):
            assert "waits to be kept" in await there.vad_device("rename", LAMP, "lamp", code=2)
            assert (await there.devices())[LAMP] == "ESP_1234"
        async with asyncio.timeout(40.0):
            while (await there.devices())[LAMP] != "lamp":  # noqa: ASYNC110 - asked as a client asks
                await asyncio.sleep(0.05)


async def test_no_more_wishes_wait_than_the_memory_takes(tmp_path: Path) -> None:
    async with home(tmp_path, patience_s=1.0) as there:
        assert there.wishes is not None
        wish = m.encode(m.DeviceWish(mac=LAMP, name="lamp"))
        with disk_full(tmp_path):
            waiting = await asyncio.gather(*(there.wishes.answer(wish) for _ in range(WAITING_AT_MOST)))
            codes = [one.code for one in waiting if isinstance(one, m.ErrorMessage)]
            assert codes == ["waiting"] * WAITING_AT_MOST
            refused = await there.wishes.answer(wish)
            assert isinstance(refused, m.ErrorMessage)
            assert refused.code == "busy"
        async with asyncio.timeout(120.0):
            while True:
                said = await there.wishes.answer(wish)
                if not isinstance(said, m.ErrorMessage) or said.code != "busy":
                    break  # one of those that waited has been granted: the slowest disk keeps all in turn
                await asyncio.sleep(0.05)
        assert (await there.devices())[LAMP] == "lamp"


async def test_a_wish_that_waits_does_not_keep_the_daemon(tmp_path: Path) -> None:
    with contextlib.ExitStack() as until_the_end:
        async with home(tmp_path, patience_s=1.0) as there:
            until_the_end.enter_context(disk_full(tmp_path))
            assert "waits to be kept" in await there.vad_device("rename", LAMP, "lamp", code=2)
    async with home(tmp_path) as there:
        assert (await there.devices())[LAMP] == "ESP_1234"


async def test_what_is_no_wish_is_refused(tmp_path: Path) -> None:
    async with home(tmp_path) as there:
        for payload in (b"", b"\xff", b"[]", b'{"mac": 1}', b'{"schema": "vad.wish.v9"}', b'{"wish": 1}'):
            assert "Not a wish" in await there.wish_raw(payload)
        assert "too long" in await there.wish_raw(b" " * (MAX_BYTES + 1))
        assert "needs the address" in await there.wish_raw(b'{"ignore": true}')
        assert "printed" in await there.wish_raw(json.dumps({"mac": LAMP, "name": "a\x1b[2J"}).encode())
        assert await there.devices() == {LAMP: "ESP_1234", TV: "the big one"}


async def test_no_daemon_answers() -> None:
    there = Home(f"tcp/127.0.0.1:{free_port()}")
    assert "vad run" in await there.vad_device("ignore", LAMP, code=3)
