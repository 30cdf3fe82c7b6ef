"""Who the broker lets in: passwords, TLS, certificates of one's own; against a real Mosquitto."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from link_world import TOPICS, closed_bus, home_assistant
from mosquitto_world import Certificates, Mosquitto, Watcher, needs_mosquitto
from waiting import until

from vad.bus.node import Bus
from vad.homeassistant import link

pytestmark = needs_mosquitto


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """The next attempt comes soon."""
    monkeypatch.setattr(link, "FIRST_RETRY_S", 0.05)
    monkeypatch.setattr(link, "LAST_RETRY_S", 0.2)


@pytest.fixture
def bus() -> Bus:
    return closed_bus()


@pytest.fixture
def users(tmp_path: Path) -> Path:
    """Mosquitto's file of who may come in: vad, with the password sesame."""
    file = tmp_path / "users"
    subprocess.run(["mosquitto_passwd", "-c", "-b", str(file), "vad", "sesame"], check=True)
    file.chmod(0o644)
    return file


async def test_a_password_is_wanted_and_read_from_its_file(bus: Bus, tmp_path: Path, users: Path) -> None:
    secret = tmp_path / "mqtt.password"
    secret.write_text("wrong\n")
    with Mosquitto(tmp_path, "allow_anonymous false", f"password_file {users}") as broker:
        async with home_assistant(bus, tmp_path, broker.port) as running:
            await until(lambda: "does not let in us without a name" in running.health.detail)
        async with (
            Watcher(broker.port, username="vad", password="sesame") as watcher,
            home_assistant(
                bus, tmp_path, broker.port, username="vad", password_file="mqtt.password"
            ) as running,
        ):
            await until(lambda: "does not let in vad" in running.health.detail)
            secret.write_text("sesame\n")  # read anew at every attempt
            await watcher.until_says(TOPICS.availability, b"online")


async def test_tls_with_the_brokers_and_its_own_certificate(bus: Bus, tmp_path: Path) -> None:
    authority = Certificates(tmp_path)
    certificate, key = authority.issue("broker")
    authority.issue("hub")
    lines = (f"cafile {authority.ca}", f"certfile {certificate}", f"keyfile {key}")
    require = ("require_certificate true", "use_identity_as_username true", "allow_anonymous false")
    with Mosquitto(tmp_path, *lines, *require) as broker:
        context = authority.context()
        context.load_cert_chain(tmp_path / "hub.pem", tmp_path / "hub.key")
        async with home_assistant(bus, tmp_path, broker.port, tls=True) as running:
            await until(lambda: "its certificate does not count" in running.health.detail)
        async with (
            Watcher(broker.port, tls_context=context) as watcher,
            home_assistant(
                bus,
                tmp_path,
                broker.port,
                tls=True,
                ca_file="ca.pem",
                certificate_file="hub.pem",
                key_file="hub.key",
            ),
        ):
            await watcher.until_says(TOPICS.availability, b"online")
