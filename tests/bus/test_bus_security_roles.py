"""Role x key x operation, each cell against a live mTLS router: a hub, its gate, and a client a role."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
import zenoh
from bus_world import PATIENCE_S
from security_world import Network, answer, ask, gate_pid, memory_kib, network, on
from waiting import until, wait_until

from vad.bus.gate import TOLD_EACH
from vad.client import VadClient
from vad.errors import VadError
from vad.pki.certificates import Role

MAC = "aa:bb:cc:dd:ee:01"
TABLE = f"""
vad/home/alive                    read   read  all
vad/home/status                   read   -     all
vad/home/map                      read   -     all
vad/home/map/grid                 read   -     all
vad/home/devices/{MAC}            read   -     all
vad/home/devices/{MAC}/heatmap    read   -     all
vad/home/devices/*                read   -     all
vad/*/devices/*                   read   -     all
vad/home/devices/{MAC}/history    read   -     all
vad/home/wishes                   -      -     all
vad/home/cameras/main             read   -     all
vad/home/cameras/main/frame       -      -     all
vad/home/capture/s1               read   read  all
vad/home/events                   read   -     all
vad/home/schema/vad.device.v1     read   read  all
vad/home/frames/main              -      -     all
vad/home/agents/a1/alive          -      all   all
vad/home/agents/a1/clock          -      all   all
vad/home/agents/a1/cmd            -      all   all
vad/home/agents/a1/csi            -      all   all
vad/home/agents/a2/alive          -      -     all
vad/home/agents/a2/cmd            -      -     all
vad/home/agents/a2/csi            -      -     all
vad/home/agents/*/csi             -      -     all
vad/home/**                       -      -     all
vad/**                            -      -     all
vad/other/agents/a1/csi           -      -     all
robot/pose                        -      -     all
"""
ROWS = [line.split() for line in TABLE.strip().splitlines()]
ROLES: tuple[Role, ...] = ("viewer", "agent", "admin")
READING = ("subscribe", "query", "liveliness query", "liveliness subscribe")
WRITING = ("put", "delete", "answer", "liveliness token")
SENTINEL = "vad/home/capture/s1"
"""A key that every role may ask for: what was sent before on the same links has been dealt with then."""

Cells = dict[tuple[str, str], bool]


def expected(role: Role) -> Cells:
    """(key, operation) -> whether it passes."""
    cells = {}
    for key, *words in ROWS:
        word = words[ROLES.index(role)]
        allowed = {"all": READING + WRITING, "read": READING, "-": ()}[word]
        for operation in READING + (() if "*" in key else WRITING):
            cells[key, operation] = operation in allowed
    return cells


KEYS = [row[0] for row in ROWS]
PLAIN_KEYS = [key for key in KEYS if "*" not in key]


class Hub:
    """The router's side: hears everything, answers everything, has a token on every key."""

    def __init__(self, router: zenoh.Session) -> None:
        self.router = router
        self.heard: set[tuple[str, str]] = set()
        on(router, "**", self._hear)
        answer(router, "**", b"hub")
        self._tokens = [router.liveliness().declare_token(key) for key in PLAIN_KEYS]

    def _hear(self, sample: zenoh.Sample) -> None:
        operation = "put" if sample.kind == zenoh.SampleKind.PUT else "delete"
        self.heard.add((str(sample.key_expr), operation))

    def forget_own_tokens(self) -> None:
        for token in self._tokens:
            token.undeclare()


def try_everything(hub: Hub, connect: Callable[[], zenoh.Session]) -> Cells:
    """What of all operations on all keys gets through."""
    cells: Cells = {}
    client = connect()

    def settled(session: zenoh.Session = client) -> None:
        assert ask(session, SENTINEL), "the link works"

    wait_until(lambda: ask(client, SENTINEL), "the way from the client to the hub", PATIENCE_S)
    for key in KEYS:
        cells[key, "query"] = b"hub" in ask(client, key)
        found = client.liveliness().get(key, timeout=PATIENCE_S)
        cells[key, "liveliness query"] = any(reply.ok is not None for reply in found)
    hub.heard.clear()
    for key in PLAIN_KEYS:
        client.put(key, b"client")
        client.delete(key)
    settled()
    for key in PLAIN_KEYS:
        for operation in ("put", "delete"):
            cells[key, operation] = (key, operation) in hub.heard

    for key in KEYS:  # a session each: a wide subscription hears what comes for a narrow one
        heard: list[str] = []
        alive: list[str] = []
        alone = connect()
        on(alone, key, collect(heard))
        alone.liveliness().declare_subscriber(
            key, zenoh.handlers.Callback(collect(alive), None, indirect=False), history=True
        )
        settled(alone)
        for plain in PLAIN_KEYS:
            hub.router.put(plain, b"hub")
        settled(alone)  # the answer comes on the same link, after the puts
        cells[key, "subscribe"] = bool(heard)
        cells[key, "liveliness subscribe"] = bool(alive)
        alone.close()

    hub.forget_own_tokens()
    tokens = [client.liveliness().declare_token(key) for key in PLAIN_KEYS]
    for key in PLAIN_KEYS:
        answer(client, key, b"client")
    settled()
    found = hub.router.liveliness().get("**", timeout=PATIENCE_S)
    seen = {str(reply.ok.key_expr) for reply in found if reply.ok is not None}
    for key in PLAIN_KEYS:
        cells[key, "liveliness token"] = key in seen
        cells[key, "answer"] = b"client" in ask(hub.router, key)
    del tokens
    return cells


def collect(into: list[str]) -> Callable[[zenoh.Sample], None]:
    return lambda sample: into.append(str(sample.key_expr))


@pytest.mark.parametrize("role", ROLES)
async def test_each_cell_of_the_table(tmp_path: Path, role: Role) -> None:
    async with network(tmp_path, (role, "a1"), ("agent", "a2"), ("viewer", "x")) as (world, credentials):

        def run() -> Cells:
            return try_everything(Hub(world.router), lambda: world.connect(credentials[0]))

        assert await asyncio.to_thread(run) == expected(role)


def test_the_table_says_something_of_every_operation() -> None:
    cells = expected("viewer")
    assert len(cells) == len(READING) * len(KEYS) + len(WRITING) * len(PLAIN_KEYS)
    assert not any(allowed for (_, operation), allowed in cells.items() if operation in WRITING)
    assert not any(allowed for (key, _), allowed in cells.items() if "csi" in key or "frame" in key)


@pytest.mark.parametrize("mode", ["peer", "router"])
async def test_a_viewer_that_calls_itself_more_is_no_more(tmp_path: Path, mode: str) -> None:
    """A router is told what passes through; with a viewer's certificate no more than a viewer is."""
    async with network(tmp_path, ("viewer", "tablet"), ("viewer", "phone"), ("agent", "a2")) as (
        world,
        (tablet, phone, _),
    ):
        arrived: list[bytes] = []
        on(world.router, "vad/home/agents/a2/csi", lambda s: arrived.append(s.payload.to_bytes()))
        answer(world.router, "vad/home/agents/a2/csi", b"raw")
        answer(world.router, "vad/home/devices/x", b"device")
        plain = await asyncio.to_thread(world.connect, phone)
        events: list[str] = []
        on(plain, "vad/home/events", collect(events))
        session = await asyncio.to_thread(open_as, mode, world, tablet)
        heard: set[tuple[str, bytes]] = set()
        for key in ("**", "vad/home/events"):
            on(session, key, lambda sample: heard.add((str(sample.key_expr), sample.payload.to_bytes())))
        await until(lambda: "viewer.tablet." in world.gate.health.detail, "the gate knows it")

        def hear() -> bool:
            world.router.put("vad/home/agents/a2/csi", b"raw")
            world.router.put("vad/home/cameras/main/frame", b"picture")
            world.router.put("vad/home/events", b"event")
            return len(events) >= 10

        await until(hear, "what comes after raw data and pictures is heard")
        assert await asyncio.to_thread(ask, session, "vad/home/agents/a2/csi") == []
        session.put("vad/home/agents/a2/csi", b"forged")
        await asyncio.to_thread(session.close)
        # What it sent came before its goodbye, and what the gate had passed on came before this answer.
        await until(lambda: "viewer.tablet." not in world.gate.health.detail, "the gate has seen it go")
        assert await asyncio.to_thread(ask, plain, "vad/home/devices/x") == [b"device"]
        own = {("vad/home/agents/a2/csi", b"forged")}  # what a session puts, it hears itself
        assert heard - own <= {("vad/home/events", b"event")}
        assert set(arrived) == {b"raw"}


def open_as(mode: str, world: Network, credentials: Path) -> zenoh.Session:
    from vad.bus.session import BusSettings, _client_tls, open_config, plain_config

    settings = BusSettings(mode="client", connect=(world.tls,), credentials=credentials)
    values = plain_config("client", connect=(world.tls,)) | _client_tls(settings, (world.tls,))
    return open_config(values | {"mode": mode, "scouting/gossip/enabled": True})


async def test_the_client_finds_the_home_and_an_agents_does_not(tmp_path: Path) -> None:
    async with network(tmp_path, ("viewer", "tablet"), ("agent", "a1")) as (world, (tablet, agent)):
        token = world.router.liveliness().declare_token("vad/home/alive")

        def ask_as(credentials: Path) -> list[str]:
            with VadClient(world.tls, credentials=credentials) as client:
                return client.hubs()

        probe = await asyncio.to_thread(world.connect, tablet)
        alive = probe.liveliness().get
        await until(lambda: len(list(alive("vad/*/alive"))) == 1, "the gate has heard of the daemon")
        assert await asyncio.to_thread(ask_as, tablet) == ["home"]
        with pytest.raises(VadError, match="vad pki list"):
            await asyncio.to_thread(ask_as, agent)
        del token


async def test_denied_attempts_are_counted_and_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def misbehave(world: Network, credentials: Path) -> None:
        session = world.connect(credentials)
        for _ in range(3):
            session.put("vad/home/agents/a2/csi", b"forged")
        session.declare_subscriber("vad/home/agents/a2/cmd", lambda _: None)
        assert ask(session, "vad/**") == []

    async with network(tmp_path, ("agent", "a1")) as (world, (a1,)):
        await asyncio.to_thread(misbehave, world, a1)
        health = world.gate.health
        await until(lambda: health.counters["denied"] >= 5, "five attempts are counted")
        await until(lambda: "connected: agent.a1." in health.detail, "the status names who is there")
        assert health.counters["denied"] == 5
    said = [record.getMessage() for record in caplog.records if "may not" in record.getMessage()]
    assert [sentence.partition(" may not ")[2] for sentence in sorted(said)] == [
        "Declare Subscriber on 'vad/home/agents/a2/cmd'",
        "Put on 'vad/home/agents/a2/csi'",
        "Query on 'vad/**'",
    ]
    assert all(sentence.startswith("'agent.a1.") for sentence in said)


@pytest.mark.slow
@pytest.mark.usefixtures("nothing_is_cut")
async def test_a_flood_of_denied_attempts_is_counted_and_fills_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """50,000 puts on as many keys: all counted, a few told, and another client is answered meanwhile."""

    under_way = threading.Event()

    def flood(world: Network, credentials: Path) -> None:
        session = world.connect(credentials)
        for i in range(50_000):
            if i == 1000:
                under_way.set()
            session.put(f"vad/home/devices/x{i}", b"x", congestion_control=zenoh.CongestionControl.BLOCK)

    async with network(tmp_path, ("viewer", "bad"), ("viewer", "good")) as (world, (bad, good)):
        answer(world.router, "vad/home/status", b"fine")
        session = await asyncio.to_thread(world.connect, good)
        await until(lambda: ask(session, "vad/home/status") == [b"fine"], "the way is open")
        before_kib = memory_kib(gate_pid())
        counters, meanwhile = world.gate.health.counters, 0
        flooding = asyncio.create_task(asyncio.to_thread(flood, world, bad))
        await until(under_way.is_set, "the flood is under way")
        while counters["denied"] < 50_000:
            assert await asyncio.to_thread(ask, session, "vad/home/status") == [b"fine"]
            meanwhile += counters["denied"] < 50_000
        await flooding
        assert meanwhile > 0, "nobody had to wait until the flood was over"
        assert counters["denied"] == 50_000, "every one is counted"
        assert memory_kib(gate_pid()) - before_kib < 30_000
    assert len([record for record in caplog.records if record.levelname == "WARNING"]) <= TOLD_EACH + 1
