"""The status of parts with rates and latencies, as Prometheus reads it; and how the past is told."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families
from waiting import until

from vad.bus import messages as m
from vad.bus.answers import HistoryError
from vad.bus.selectors import HistoryQuestion
from vad.daemon import metrics
from vad.daemon.metrics import MAX_CONNECTIONS, MetricsServer, StatusCollector
from vad.daemon.parts import Parts
from vad.daemon.past import StoredPast
from vad.health import Health
from vad.store.records import DeviceRecord, Estimate
from vad.store.worker import StoreWorker

MAC = "aa:bb:cc:dd:ee:01"


def test_rates_are_told_over_the_last_seconds() -> None:
    health, parts = Health("csi"), Parts()
    rates = []
    for second in range(30):
        (told,) = parts.tell([health], 100.0 + second)
        rates.append(told.rates_per_s.get("packets", 0.0))
        health.counters["packets"] += 400 if second < 15 else 0
    assert rates[0] == 0.0, "one look tells no rate"
    assert rates[1:15] == [400.0] * 14
    assert rates[20] == pytest.approx(200.0, abs=45)
    assert rates[29] == 0.0, "what stopped is not told for ever"


def test_parts_of_one_name_are_told_apart() -> None:
    told = Parts().tell([Health("hostapd"), Health("hostapd"), Health("csi")], 0.0)
    assert [part.part for part in told] == ["hostapd", "hostapd 2", "csi"]


def test_a_part_tells_its_trouble_with_its_time_and_how_long_things_took() -> None:
    health = Health("store")
    for took_ms in range(1, 101):
        health.took("write", took_ms / 1e3)
    health.trouble("disk full")
    begun_at = health.last_error_at
    health.trouble("disk full")
    assert health.last_error_at == begun_at, "the same trouble still"
    (told,) = Parts().tell([health], 0.0)
    assert (told.state, told.last_error, told.last_error_at) == ("degraded", "disk full", begun_at)
    assert begun_at is not None
    write = told.latencies["write"]
    assert (write.count, write.p50_ms, write.p99_ms, write.max_ms) == (100, 51.0, 100.0, 100.0)
    assert write.total_s == pytest.approx(5.05)


STATUS = m.StatusMessage(
    source="simulated",
    version="0.1.0",
    hub="home",
    uptime_s=12.5,
    parts=(
        m.Part(part="csi", state="ok", counters={"packets": 812, "lost": 3}),
        m.Part(
            part='odd "name"\n',
            state="failed",
            last_error="unplugged",
            last_error_at="2026-01-31T12:00:00.000Z",
            latencies={"write": m.Latency(count=4, total_s=0.5, p50_ms=2.0, p99_ms=9.0, max_ms=10.0)},
        ),
    ),
)


@asynccontextmanager
async def served(status: m.StatusMessage | None) -> AsyncIterator[MetricsServer]:
    server = MetricsServer(0, StatusCollector(lambda: status, lambda: {"mapped": 2}))
    task = asyncio.create_task(server.run())
    try:
        await until(lambda: server.health.state == "ok", "it listens")
        yield server
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def fetch(port: int, request: bytes) -> bytes:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    try:
        writer.write(request)
        return await asyncio.wait_for(reader.read(), 40)
    finally:
        writer.close()
        with contextlib.suppress(ConnectionError):
            await writer.wait_closed()


def get(path: str = "/metrics", host: str = "127.0.0.1") -> bytes:
    return f"GET {path} HTTP/1.1\r\nHost: {host}\r\n\r\n".encode()


async def test_prometheus_reads_the_status() -> None:
    async with served(STATUS) as server:
        answer = await fetch(server.port, get())
        head, _, body = answer.partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 200 OK\r\nContent-Type: text/plain")
        assert f"Content-Length: {len(body)}".encode() in head
        found = {
            (sample.name, tuple(sorted(sample.labels.values()))): sample.value
            for family in text_string_to_metric_families(body.decode())
            for sample in family.samples
        }
        assert found["vad_devices", ("mapped",)] == 2
        assert found["vad_uptime_seconds", ()] == 12.5
        assert found["vad_info", ("0.1.0", "home", "simulated")] == 1
        assert found["vad_part_events_total", ("csi", "packets")] == 812
        assert (found["vad_part_state", ("csi", "ok")], found["vad_part_state", ("csi", "failed")]) == (1, 0)
        odd = 'odd "name"\n'
        assert found["vad_part_last_error_timestamp_seconds", (odd,)] == 1769860800
        assert found["vad_latency_seconds", ("0.99", odd, "write")] == 0.009
        assert found["vad_latency_seconds_count", (odd, "write")] == 4
        assert found["vad_latency_seconds_sum", (odd, "write")] == 0.5
        assert found["process_resident_memory_bytes", ()] > 1e6


async def test_a_daemon_that_has_said_nothing_has_metrics_all_the_same() -> None:
    async with served(None) as server:
        assert b'vad_devices{state="mapped"} 2.0' in await fetch(server.port, get())


@pytest.mark.parametrize(
    ("request_", "status"),
    [
        (get("/"), b"404"),
        (get("/metrics?x=1"), b"200"),
        (get(host="localhost:9747"), b"200"),
        (get(host="evil.example:9747"), b"403"),
        (get().replace(b"GET", b"POST"), b"405"),
        (b"\xff\xfe\r\n\r\n", b"405"),
    ],
)
async def test_what_is_asked_otherwise_is_refused(request_: bytes, status: bytes) -> None:
    async with served(STATUS) as server:
        assert (await fetch(server.port, request_)).split()[1] == status
        assert b"\r\n\r\n" in await fetch(server.port, get().replace(b"GET", b"HEAD"))


async def test_an_endless_head_and_askers_who_say_nothing_do_no_harm(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics, "TIMEOUT_S", 1000.0)  # none of them is given up before all are there
    async with served(STATUS) as server:
        with contextlib.suppress(ConnectionResetError):
            assert await fetch(server.port, b"GET " + b"x" * 20000) == b""
        assert server.health.counters["broken_requests"] == 1
        silent = [await asyncio.open_connection("127.0.0.1", server.port) for _ in range(MAX_CONNECTIONS)]
        await until(lambda: server._open == MAX_CONNECTIONS, "all are taken")
        with contextlib.suppress(ConnectionResetError):
            assert await fetch(server.port, get()) == b""
        assert server.health.counters["turned_away"] == 1
        for _, writer in silent:
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()
        await until(lambda: server._open == 0, "all are free")
        assert b"200 OK" in await fetch(server.port, get())


async def test_a_taken_port_is_trouble_and_no_end() -> None:
    async with served(STATUS) as first:
        second = MetricsServer(first.port, StatusCollector(lambda: None, dict))
        task = asyncio.create_task(second.run())
        await until(lambda: second.health.state == "degraded", "it says so")
        assert f"port {first.port} cannot be used" in second.health.detail
        assert not task.done()
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task


async def test_the_past_is_told_from_the_store(tmp_path: Path) -> None:
    place = Estimate(1.0, 2.0, ((0.04, 0.0), (0.0, 0.09)), 0.6, (), "Hall", "doppler")
    early = "2020-01-01T00:00:00.000Z"
    async with StoreWorker(tmp_path / "vad.sqlite") as store:
        past = StoredPast(store, "simulated")
        await store.save_device(DeviceRecord(MAC, "waiting", early, early, name="lamp"))
        await store.save_device(DeviceRecord(MAC, "mapped", early, early, "lamp", walks=2, estimate=place))
        history = await past.history(MAC, HistoryQuestion())
        assert history is not None
        assert [entry.state for entry in history.entries] == ["mapped", "waiting"]
        newest = history.entries[0]
        assert (newest.x_m, newest.room, newest.walks, newest.covariance_m2) == (
            1.0,
            "Hall",
            2,
            ((0.04, 0.0), (0.0, 0.09)),
        )
        (then,) = await past.devices_at(newest.at, MAC)
        assert (then.state, then.name, then.x_m, then.updated_at) == ("mapped", "lamp", 1.0, newest.at)
        assert json.loads(m.encode(then))["source"] == "simulated"
        assert await past.history("aa:bb:cc:dd:ee:99", HistoryQuestion()) is None
        assert await past.devices_at(newest.at, "aa:bb:cc:dd:ee:99") == []
        with pytest.raises(HistoryError, match=f"history of {MAC} that is kept begins at 20"):
            await past.devices_at("2020-01-02T00:00:00.000Z", MAC)
        (all_then,) = await past.devices_at("2020-01-02T00:00:00.000Z", None)
        assert (all_then.state, all_then.x_m) == ("stale", None)
        assert "that is kept begins at" in all_then.reason
