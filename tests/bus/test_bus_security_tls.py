"""Who is not let in: other authorities, ended, revoked and missing certificates, impostors, noise."""

from __future__ import annotations

import asyncio
import random
import socket
import ssl
import time
from contextlib import ExitStack
from datetime import timedelta
from pathlib import Path

import pytest
import zenoh
from bus_world import PATIENCE_S
from security_world import HUB, Network, linked, network
from waiting import free_port, until

from vad.bus.session import BusSettings, _client_tls, open_config, open_session, plain_config
from vad.errors import VadError
from vad.pki.certificates import ends_at, utc_now
from vad.pki.credentials import ENVIRONMENT, write_credentials
from vad.pki.folder import PkiFolder

DAY_S = 86_400


def address(endpoint: str) -> tuple[str, int]:
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    return host, int(port)


async def refused(world: Network, reason: str) -> None:
    """Wait until the gate says that it refused somebody for this reason."""
    await until(lambda: f"last refused: {reason}" in world.gate.health.detail, f"refused: {reason}")


async def test_another_authoritys_certificate(tmp_path: Path) -> None:
    async with network(tmp_path, ("viewer", "tablet")) as (world, (tablet,)):
        other = PkiFolder(tmp_path / "other")
        other.init(HUB, ["localhost"], utc_now())
        issued = other.issue("admin", "tablet", 1, utc_now())
        write_credentials(
            tmp_path / "forged", issued, world.pki.authority_certificate(), "tls/127.0.0.1:7448"
        )
        assert await world.lets_in(tablet)
        assert not await world.lets_in(tmp_path / "forged")
        await refused(world, "a certificate of another authority, or one that was revoked")
        assert world.gate.health.counters["refused"] == 1


async def test_no_certificate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(ENVIRONMENT, raising=False)  # of whoever runs this

    def knock(world: Network) -> str:
        context = ssl.create_default_context(cafile=str(world.pki.authority_file))
        plain = socket.create_connection(address(world.tls), timeout=PATIENCE_S)
        with context.wrap_socket(plain, server_hostname="localhost") as link:
            # With TLS 1.3 the server's refusal comes after the client's part of the handshake.
            with pytest.raises(ssl.SSLError) as caught:
                link.recv(1)
            return str(caught.value)

    async with network(tmp_path, ("viewer", "tablet")) as (world, _):
        assert "certificate required" in await asyncio.to_thread(knock, world)
        await refused(world, "no certificate")
        with pytest.raises(VadError, match="asks for a certificate"):
            await asyncio.to_thread(
                open_session, BusSettings(mode="client", connect=(world.tls,), credentials=None)
            )


async def test_the_hubs_own_certificate_is_none_for_clients(tmp_path: Path) -> None:
    async with network(tmp_path, ("viewer", "tablet")) as (world, (tablet,)):
        hub = world.pki.hub_file.read_bytes()
        (tablet / "client.pem").write_bytes(hub)
        (tablet / "client.key").write_bytes(hub)
        assert not await world.lets_in(tablet)


async def test_a_client_does_not_take_another_client_for_the_hub(tmp_path: Path) -> None:
    """The hub's name is not checked, for its address may change: what is checked must be enough."""

    def impostor(world: Network, viewer: Path, endpoint: str) -> zenoh.Session:
        tls = "transport/link/tls"
        return open_config(
            plain_config("router", listen=(endpoint,))
            | {
                f"{tls}/listen_certificate": str(viewer / "client.pem"),
                f"{tls}/listen_private_key": str(viewer / "client.key"),
                f"{tls}/root_ca_certificate": str(viewer / "ca.pem"),
            }
        )

    async with network(tmp_path, ("viewer", "mallory"), ("admin", "boss")) as (world, (mallory, boss)):
        endpoint = f"tls/127.0.0.1:{free_port()}"
        router = await asyncio.to_thread(impostor, world, mallory, endpoint)
        with pytest.raises(VadError, match="no hub answers"):
            await asyncio.to_thread(world.connect, boss, endpoint)
        await asyncio.to_thread(router.close)


@pytest.mark.slow
async def test_revoked_while_connected(tmp_path: Path) -> None:
    async with network(tmp_path, ("viewer", "tablet"), ("viewer", "phone")) as (world, (tablet, phone)):
        lost = await asyncio.to_thread(world.connect, tablet)
        kept = await asyncio.to_thread(world.connect, phone)
        token = world.router.liveliness().declare_token("vad/home/alive")

        def sees(session: zenoh.Session) -> bool:
            return bool(list(session.liveliness().get("vad/home/alive", timeout=1.0)))

        await until(lambda: sees(lost) and sees(kept), "both are in")
        world.pki.revoke("tablet", utc_now())
        await until(lambda: not linked(lost), "its link is cut")
        await world.opened(2)
        await until(lambda: sees(kept), "the other one is back without help")
        assert not sees(lost)
        assert not await world.lets_in(tablet)
        await refused(world, "a certificate of another authority, or one that was revoked")
        del token


async def test_issued_while_running(tmp_path: Path) -> None:
    async with network(tmp_path) as (world, _):
        await until(lambda: "nobody is let in" in world.gate.health.detail, "it says that nobody is")
        tablet = world.issue("viewer", "tablet")
        await world.opened(1)
        assert world.gate.health.state == "ok"
        assert await world.lets_in(tablet)


@pytest.mark.slow
async def test_a_certificate_that_ends_while_connected(tmp_path: Path) -> None:
    async with network(tmp_path, ("viewer", "phone")) as (world, _):
        begun_s = time.monotonic()
        tablet = world.issue("viewer", "tablet")
        await world.opened(2)
        assert await world.lets_in(tablet)
        # It is to be in before its end, however long this machine takes to let somebody in.
        lasts_s = 4 + 8 * (time.monotonic() - begun_s)
        guest = world.issue("viewer", "guest", days=lasts_s / DAY_S)
        await world.opened(3)
        session = await asyncio.to_thread(world.connect, guest)
        assert linked(session)
        end = ends_at((guest / "client.pem").read_bytes())
        await until(lambda: not linked(session), "the link is cut", lasts_s + PATIENCE_S)
        assert utc_now() > end - timedelta(seconds=1), "and not before"
        assert not await world.lets_in(guest)
        await refused(world, "an expired certificate")


async def test_an_expired_certificate(tmp_path: Path) -> None:
    async with network(tmp_path, ("viewer", "phone")) as (world, _):
        issued = world.pki.issue("viewer", "old", 1, utc_now() - timedelta(days=2))
        write_credentials(tmp_path / "old", issued, world.pki.authority_certificate(), world.tls)
        await world.opened(2)
        assert not await world.lets_in(tmp_path / "old")


@pytest.mark.slow
async def test_noise_and_silence_hold_up_nobody(tmp_path: Path) -> None:
    def make_noise(world: Network) -> None:
        source = random.Random(1)
        for size in (1, 5, 100, 5000):
            for _ in range(5):
                with socket.create_connection(address(world.tls)) as link:
                    link.sendall(source.randbytes(size))

    async with network(tmp_path, ("viewer", "tablet")) as (world, (tablet,)):
        with ExitStack() as silent:
            for _ in range(20):
                silent.enter_context(socket.create_connection(address(world.tls)))
            await asyncio.to_thread(make_noise, world)
            # One after the other the silent ones would take their time, 12 s each.
            assert await world.lets_in(tablet)
        assert world.gate.health.counters["opened"] == 1, "it never went down"


@pytest.mark.slow
@pytest.mark.usefixtures("nothing_is_cut")
async def test_too_large_a_message_from_the_network_is_stopped(tmp_path: Path) -> None:
    async with network(tmp_path, ("agent", "node")) as (world, (node,)):
        arrived: list[int] = []
        asked: list[zenoh.Query] = []
        subscriber = world.router.declare_subscriber(
            "vad/home/agents/*/csi",
            zenoh.handlers.Callback(lambda s: arrived.append(len(s.payload)), None, indirect=False),
        )
        queryable = world.router.declare_queryable(
            "vad/home/agents/*/cmd", zenoh.handlers.Callback(asked.append, None, indirect=False)
        )
        session = await asyncio.to_thread(world.connect, node)

        def small_arrives() -> bool:
            session.put("vad/home/agents/node/csi", b"1")
            return bool(arrived)

        await until(small_arrives, "the way is open")
        await asyncio.to_thread(send, session)
        await until(lambda: 10 in arrived, "the last one")
        assert [size for size in arrived if size > 1] == [900_000, 10]
        assert asked == []
        del subscriber, queryable


def send(session: zenoh.Session) -> None:
    def put(size: int) -> None:
        session.put("vad/home/agents/node/csi", bytes(size), congestion_control=zenoh.CongestionControl.BLOCK)

    for size in (3_000_000, 1_100_000, 900_000):
        put(size)
    list(session.get("vad/home/agents/node/cmd", payload=bytes(5000), timeout=0.2))
    put(10)  # comes the same way after all of them


async def test_a_zenoh_client_without_a_certificate(tmp_path: Path) -> None:
    def knock(world: Network, tablet: Path) -> None:
        settings = BusSettings(mode="client", connect=(world.tls,), credentials=tablet)
        values = plain_config("client", connect=(world.tls,)) | _client_tls(settings, (world.tls,))
        for name in ("connect_certificate", "connect_private_key", "enable_mtls"):
            del values[f"transport/link/tls/{name}"]
        with pytest.raises(zenoh.ZError):
            open_config(values)

    async with network(tmp_path, ("viewer", "tablet")) as (world, (tablet,)):
        await asyncio.to_thread(knock, world, tablet)
        await refused(world, "no certificate")
