"""Server-sent events over real sockets: everything, then changes; breaks, slow readers, limits, the end."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import AsyncIterator
from pathlib import Path

import aiohttp
import msgspec
import pytest
from waiting import free_port, until
from web_world import Event, Serving, World, device, events, mac, status, world

from vad.bus import messages as m
from vad.web import server as server_module
from vad.web import stream as stream_module
from vad.web.home import Robot
from vad.web.stream import MAX_STREAMS

QUIET = aiohttp.ClientTimeout(total=None)


async def take(source: AsyncIterator[Event], count: int) -> list[Event]:
    async with asyncio.timeout(40):
        return [await anext(source) for _ in range(count)]


async def find(source: AsyncIterator[Event], key: str) -> Event:
    async with asyncio.timeout(40):
        async for event in source:
            if event.kind == "message" and event.key == key:
                return event
    raise AssertionError(f"the stream ended without {key}")


def streaming(made: World, last: str | None = None) -> aiohttp.client._RequestContextManager:
    headers = {} if last is None else {"Last-Event-ID": last}
    return made.http.get(made.url + "/api/stream", headers=headers, timeout=QUIET)


async def test_a_stream_tells_everything_and_then_what_changes(serving: Serving) -> None:
    async with serving(devices=3) as made, streaming(made) as answer:
        assert answer.content_type == "text/event-stream"
        assert answer.headers["Cache-Control"] == "no-store"
        source = events(answer)
        reset, *all_there = await take(source, 9)
        assert reset.kind == "reset"
        told = {event.key: event.value for event in all_there}
        assert set(told) == {
            "map", "map/grid", "cameras/main", "status", *(f"devices/{mac(i)}" for i in range(3)),
            f"devices/{mac(0)}/heatmap",
        }  # fmt: skip
        assert told["map"]["source"] == "simulated"
        assert "probability" not in told[f"devices/{mac(0)}/heatmap"], "the picture is fetched apart"
        made.bus.publish_device(device(1, name='A "new"\nname</script>'))
        made.bus.publish_event(
            m.EventMessage(source="simulated", kind="mapped", mac=mac(1), text="it is mapped")
        )
        changed, happened = await take(source, 2)
        assert changed.value["name"] == 'A "new"\nname</script>'
        assert happened.key.startswith("events/")
        made.bus.forget_device(mac(0))
        gone = await take(source, 2)
        assert {(event.key, event.value) for event in gone} == {
            (f"devices/{mac(0)}", None), (f"devices/{mac(0)}/heatmap", None)
        }  # fmt: skip
        numbers = [int(e.id.partition("-")[2]) for e in (*all_there, changed, happened, *gone)]
        assert numbers == sorted(set(numbers))


async def test_who_comes_back_hears_only_what_was_missed(serving: Serving) -> None:
    async with serving(devices=30) as made:
        async with streaming(made) as answer:
            last = (await take(events(answer), 1 + 30 + 5))[-1]
        made.bus.publish_device(device(3, name="changed"))
        made.bus.forget_device(mac(4))
        made.bus.publish_status(status("something new"))
        async with streaming(made, last.id) as answer:
            missed = await take(events(answer), 3)
            assert [(e.kind, e.key) for e in missed] == [
                ("message", f"devices/{mac(3)}"), ("message", f"devices/{mac(4)}"), ("message", "status")
            ]  # fmt: skip
            assert missed[1].value is None
        assert made.page.health.counters["resumed"] == 1
        async with streaming(made, "of-another-life-7") as answer:
            assert (await take(events(answer), 1))[0].kind == "reset"


async def deaf_reader(made: World) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """A browser that asks for the stream and then reads nothing."""
    small = socket.socket()
    small.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
    small.setblocking(False)
    await asyncio.get_running_loop().sock_connect(small, ("127.0.0.1", made.page.port))
    reader, writer = await asyncio.open_connection(sock=small, limit=2**20)
    reader._transport.pause_reading()  # type: ignore[attr-defined]
    writer.write(b"GET /api/stream HTTP/1.1\r\nHost: localhost\r\n\r\n")
    await until(lambda: made.page.streams.count == 1, "the stream begins")
    return reader, writer


async def test_a_slow_reader_gets_the_newest_and_costs_no_more_than_its_window(
    serving: Serving, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A browser that does not read while 4,000 changes of 20 devices happen, with its window full."""
    monkeypatch.setattr(stream_module, "SLOW_S", 600.0)
    monkeypatch.setattr(stream_module, "GAP_S", 0.0)
    async with serving(devices=20) as made:
        reader, writer = await deaf_reader(made)
        base = [device(i) for i in range(20)]

        async def told_of_changes() -> int:
            before = made.page.health.counters["told"]
            for turn in range(200):
                for one in base:
                    made.bus.publish_device(msgspec.structs.replace(one, walks=turn + 1))
                await asyncio.sleep(0)
            return int(made.page.health.counters["told"] - before)

        # What the sockets' buffers hold is the kernel's affair; when they are full nothing more goes out.
        while await told_of_changes():
            pass
        made.bus.publish_device(device(0, name="the last"))
        reader._transport.resume_reading()  # type: ignore[attr-defined]
        last: dict[str, str] = {}
        async with asyncio.timeout(40):
            while last.get(f"devices/{mac(0)}") != "the last":
                line = await reader.readline()
                if line.startswith(b'data: {"key":"devices'):
                    data = json.loads(line[6:])
                    last[data["key"]] = data["value"].get("name", "")
        assert len([key for key in last if not key.endswith("heatmap")]) == 20
        assert made.page.health.counters["coalesced"] > 3900
        writer.close()
        await writer.wait_closed()
        await until(lambda: made.page.streams.count == 0, "the stream ends with its browser")


async def test_a_reader_that_takes_nothing_is_let_go(
    serving: Serving, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream_module, "SLOW_S", 0.2)
    async with serving(devices=20) as made:
        _, writer = await deaf_reader(made)
        base, turn = [device(i) for i in range(20)], 0
        async with asyncio.timeout(40):
            while not made.page.health.counters["too_slow"]:
                turn += 1
                for one in base:
                    made.bus.publish_device(msgspec.structs.replace(one, walks=turn))
                await asyncio.sleep(0.001)
        await until(lambda: made.page.streams.count == 0, "it is closed")
        writer.close()


async def test_streams_are_limited_and_a_closed_one_makes_room(serving: Serving) -> None:
    async with serving() as made:
        first = await streaming(made)
        rest = [await streaming(made) for _ in range(MAX_STREAMS - 1)]
        async with streaming(made) as refused:
            assert refused.status == 503
            assert int(refused.headers["Retry-After"]) > 0
            assert "pages are open" in (await refused.json())["text"]
        first.close()
        await until(lambda: made.page.streams.count < MAX_STREAMS, "the closed one is noticed")
        async with streaming(made) as again:
            assert again.status == 200
        for answer in rest:
            answer.close()


async def test_a_hub_with_nothing_to_tell_says_that_it_is_alive(
    serving: Serving, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream_module, "ALIVE_S", 0.05)
    async with serving() as made, streaming(made) as answer:
        source = events(answer)
        kinds = [event.kind for event in await take(source, 12)]
        assert kinds[-2:] == ["alive", "alive"]


async def test_the_robot_is_asked_for_only_while_somebody_looks(serving: Serving) -> None:
    async with serving() as made:
        made.robot = Robot(status="localised", x_m=1.0, y_m=2.0, yaw_rad=0.5, epoch=1)
        await asyncio.sleep(0)
        assert made.asked == 0
        async with streaming(made) as answer:
            source = events(answer)
            assert (await find(source, "robot")).value["x_m"] == 1.0
            made.robot = Robot(status="lost")
            assert (await find(source, "robot")).value["status"] == "lost"
        await until(lambda: made.page.streams.count == 0, "the browser is gone")
        asked = made.asked
        with pytest.raises(AssertionError, match="not in"):
            await until(lambda: made.asked > asked + 1, "it is asked again", timeout_s=0.5)


async def test_the_page_ends_at_once_with_streams_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It waits neither for a stream to have something to tell nor for the time that answers get."""
    monkeypatch.setattr(stream_module, "ALIVE_S", 600.0)
    monkeypatch.setattr(server_module, "END_S", 600.0)
    async with world(tmp_path, port=free_port()) as made:
        task = asyncio.create_task(made.page.run())
        await until(lambda: made.page.health.state == "ok", "the page listens")
        answers = [await streaming(made) for _ in range(5)]
        task.cancel()
        await asyncio.wait({task}, timeout=40)
        assert task.cancelled()
        for answer in answers:
            async with asyncio.timeout(40):
                await answer.content.read()
            answer.close()
        with pytest.raises(aiohttp.ClientConnectionError):
            await streaming(made)
    # that no task is left behind is seen to by tests/conftest.py
