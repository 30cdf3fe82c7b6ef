"""The status as Prometheus text, served over HTTP on the loopback interface."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Iterator, Mapping
from datetime import datetime

from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from vad.bus import messages as m
from vad.health import Health

log = logging.getLogger(__name__)

HOST = "127.0.0.1"
_ITS_NAMES = ("127.0.0.1", "localhost")
MAX_HEAD_BYTES = 8192
MAX_CONNECTIONS = 8
TIMEOUT_S = 5.0
_STATES = ("starting", "ok", "degraded", "failed")


class StatusCollector(Collector):
    """What was published last, as metrics. status, devices: what to ask at each scrape."""

    def __init__(
        self, status: Callable[[], m.StatusMessage | None], devices: Callable[[], Mapping[str, int]]
    ) -> None:
        self._status = status
        self._devices = devices

    def collect(self) -> Iterator[Metric]:
        """Every metric; nothing of the parts before the daemon has said something."""
        known = GaugeMetricFamily("vad_devices", "Devices by state", labels=["state"])
        for state, count in self._devices().items():
            known.add_metric([state], count)
        yield known
        status = self._status()
        if status is None:
            return
        about = InfoMetricFamily("vad", "Version, hub, and whether the home is real")
        about.add_metric([], {"version": status.version, "hub": status.hub, "source": status.source})
        yield about
        yield GaugeMetricFamily("vad_uptime_seconds", "Since the daemon started", status.uptime_s)
        yield from _parts(status.parts)


def _parts(parts: tuple[m.Part, ...]) -> Iterator[Metric]:
    state = GaugeMetricFamily("vad_part_state", "1 for the state a part is in", labels=["part", "state"])
    counts = CounterMetricFamily("vad_part_events", "A part's counters", labels=["part", "event"])
    trouble = GaugeMetricFamily(
        "vad_part_last_error_timestamp_seconds",
        "When a part's last trouble began; `vad status` says why",
        labels=["part"],
    )
    latency = Metric("vad_latency_seconds", "How long a part's work took", "summary")
    for part in parts:
        for one in _STATES:
            state.add_metric([part.part, one], part.state == one)
        for event, count in part.counters.items():
            counts.add_metric([part.part, event], count)
        if part.last_error_at is not None:
            trouble.add_metric([part.part], datetime.fromisoformat(part.last_error_at).timestamp())
        for work, took in part.latencies.items():
            labels = {"part": part.part, "work": work}
            for quantile, value_ms in (("0.5", took.p50_ms), ("0.99", took.p99_ms)):
                latency.add_sample("vad_latency_seconds", labels | {"quantile": quantile}, value_ms / 1e3)
            latency.add_sample("vad_latency_seconds_count", labels, took.count)
            latency.add_sample("vad_latency_seconds_sum", labels, took.total_s)
    yield from (state, counts, trouble, latency)


class MetricsServer:
    """`GET /metrics` on 127.0.0.1, on the event loop; a port that is taken is trouble, no more."""

    def __init__(self, port: int, collector: Collector) -> None:
        self.health = Health("metrics")
        self.port = port
        self._registry = CollectorRegistry()
        self._registry.register(collector)
        ProcessCollector(registry=self._registry)
        self._open = 0

    async def run(self) -> None:
        """Serve until cancelled."""
        async with asyncio.TaskGroup() as askers:
            await self._listen(askers)

    async def _listen(self, askers: asyncio.TaskGroup) -> None:
        def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            if self._open >= MAX_CONNECTIONS:
                self.health.counters["turned_away"] += 1
                writer.transport.abort()
            else:
                self._open += 1
                askers.create_task(self._serve(reader, writer))

        try:
            server = await asyncio.start_server(accept, HOST, self.port, limit=MAX_HEAD_BYTES)
        except OSError as error:
            self.health.trouble(f"port {self.port} cannot be used ({error.strerror}); change metrics.port")
            log.warning("metrics: %s", self.health.last_error)
            await asyncio.Event().wait()
            return
        self.port = server.sockets[0].getsockname()[1]
        self.health.ok(f"http://{HOST}:{self.port}/metrics")
        async with server:
            await server.serve_forever()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            async with asyncio.timeout(TIMEOUT_S):
                status, kind, body = self._answer(await reader.readuntil(b"\r\n\r\n"))
                head = f"HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {len(body)}\r\n"
                writer.write(head.encode() + b"Connection: close\r\n\r\n" + body)
                await writer.drain()
        except (TimeoutError, ConnectionError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            self.health.counters["broken_requests"] += 1
        finally:
            self._open -= 1
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()

    def _answer(self, head: bytes) -> tuple[str, str, bytes]:
        """Status line, content type and body for a request's head."""
        first, *fields = head.decode("latin-1").split("\r\n")
        method, _, rest = first.partition(" ")
        path = rest.partition(" ")[0].partition("?")[0]
        hosts = [
            value.strip() for name, _, value in (f.partition(":") for f in fields) if name.lower() == "host"
        ]
        if any(host.rpartition(":")[0] not in _ITS_NAMES and host not in _ITS_NAMES for host in hosts):
            # a page in a browser on the hub that had its own name point here
            return "403 Forbidden", "text/plain", b"ask for 127.0.0.1\n"
        if method not in ("GET", "HEAD"):
            return "405 Method Not Allowed", "text/plain", b"GET /metrics\n"
        if path != "/metrics":
            return "404 Not Found", "text/plain", b"GET /metrics\n"
        self.health.counters["scrapes"] += 1
        body = generate_latest(self._registry)
        return "200 OK", CONTENT_TYPE_LATEST, b"" if method == "HEAD" else body
