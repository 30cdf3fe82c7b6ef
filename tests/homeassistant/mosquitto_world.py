"""A real Mosquitto on the loopback interface, and a client that sees what Home Assistant would see."""

from __future__ import annotations

import asyncio
import datetime
import ipaddress
import shutil
import signal
import socket
import ssl
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import aiomqtt
import msgspec
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from waiting import free_port

MOSQUITTO = shutil.which("mosquitto", path="/usr/sbin:/usr/bin:/usr/local/sbin:/usr/local/bin")
needs_mosquitto = pytest.mark.skipif(MOSQUITTO is None, reason="no mosquitto here: apt-get install mosquitto")


START_S = 40.0
"""How long a broker on a busy machine may take for anything."""


class Mosquitto:
    """A broker that keeps what is retained over a restart; `lines` go into its settings."""

    def __init__(self, folder: Path, *lines: str) -> None:
        self.port = free_port()
        self._file = folder / "mosquitto.conf"
        self._process: subprocess.Popen[bytes] | None = None
        store = folder / "broker"
        store.mkdir()
        store.chmod(0o777)
        settings = [
            "user root",
            f"listener {self.port} 127.0.0.1",
            "persistence true",
            f"persistence_location {store}/",
            "autosave_interval 1",
            "autosave_on_changes true",
            *(lines or ("allow_anonymous true",)),
        ]
        self._file.write_text("\n".join(settings) + "\n")
        self._log = folder / "mosquitto.log"

    def start(self) -> None:
        """Start; returns when it listens."""
        assert MOSQUITTO is not None
        with self._log.open("ab") as log:
            self._process = subprocess.Popen([MOSQUITTO, "-c", str(self._file)], stdout=log, stderr=log)
        until = time.monotonic() + START_S
        while time.monotonic() < until:
            assert self._process.poll() is None, self._log.read_text()
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self.port)) == 0:
                    return
            time.sleep(0.02)
        raise AssertionError("mosquitto does not listen")

    def freeze(self) -> None:
        """It takes and says nothing more, and its connections stay."""
        assert self._process is not None
        self._process.send_signal(signal.SIGSTOP)

    def kill(self) -> None:
        """kill -9."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()


class Watcher:
    """A client that keeps the last payload of every topic, and counts what came."""

    def __init__(self, port: int, **options: Any) -> None:
        self._client = aiomqtt.Client("127.0.0.1", port, timeout=START_S, **options)
        self.payloads: dict[str, bytes] = {}
        self.retained: dict[str, bytes] = {}
        self.came: list[tuple[str, bytes]] = []
        self._news = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        await self._client.__aenter__()
        await self._client.subscribe("#", 1)
        self._task = asyncio.create_task(self._listen())
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._task is not None
        self._task.cancel()
        await asyncio.wait({self._task})
        await self._client.__aexit__(kind, error, trace)

    async def _listen(self) -> None:
        async for message in self._client.messages:
            assert isinstance(message.payload, bytes)
            topic = str(message.topic)
            self.came.append((topic, message.payload))
            self.payloads[topic] = message.payload
            if message.retain:
                self.retained[topic] = message.payload
            self._news.set()

    async def put(self, topic: str, payload: bytes, *, retain: bool = False) -> None:
        await self._client.publish(topic, payload, qos=1, retain=retain)

    async def until(self, condition: Callable[[], bool], what: str, timeout_s: float = 40.0) -> None:
        try:
            async with asyncio.timeout(timeout_s):
                while not condition():
                    self._news.clear()
                    await self._news.wait()
        except TimeoutError:
            raise AssertionError(
                f"not in {timeout_s:.0f} s: {what}; topics: {sorted(self.payloads)}"
            ) from None

    async def until_says(self, topic: str, payload: bytes, timeout_s: float = 40.0) -> None:
        said = f"{topic} {payload[:60]!r}"
        await self.until(lambda: self.payloads.get(topic) == payload, said, timeout_s)

    def json(self, topic: str) -> dict[str, Any]:
        value = msgspec.json.decode(self.payloads[topic])
        assert isinstance(value, dict)
        return value


async def retained_at(port: int, timeout_s: float = 40.0) -> dict[str, bytes]:
    """What the broker retains now: what a client that comes now is sent first."""
    marker = "watcher/marker"
    async with Watcher(port) as watcher:
        await watcher.put(marker, b"all that is retained came before this")
        await watcher.until(lambda: marker in watcher.payloads, "the marker", timeout_s)
        return {topic: payload for topic, payload in watcher.retained.items() if payload}


class Certificates:
    """A certificate authority and certificates it signed, as PEM files in a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._key = ec.generate_private_key(ec.SECP256R1())
        self._name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "test authority")])
        self.ca = folder / "ca.pem"
        self._write(self.ca, self._sign(self._name, self._key.public_key(), ca=True))

    def issue(self, name: str) -> tuple[Path, Path]:
        """Certificate and key files for 127.0.0.1 by this name."""
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        certificate, key_file = self._folder / f"{name}.pem", self._folder / f"{name}.key"
        self._write(certificate, self._sign(subject, key.public_key(), ca=False))
        key_file.write_bytes(
            key.private_bytes(
                serialization.Encoding.PEM,
                serialization.PrivateFormat.PKCS8,
                serialization.NoEncryption(),
            )
        )
        return certificate, key_file

    def context(self) -> ssl.SSLContext:
        return ssl.create_default_context(cafile=str(self.ca))

    def _sign(self, subject: x509.Name, public: Any, *, ca: bool) -> x509.Certificate:
        now = datetime.datetime.now(datetime.UTC)
        builder = (
            x509.CertificateBuilder()
            .subject_name(subject)
            .issuer_name(self._name)
            .public_key(public)
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - datetime.timedelta(minutes=5))
            .not_valid_after(now + datetime.timedelta(hours=1))
            .add_extension(x509.BasicConstraints(ca=ca, path_length=None), critical=True)
        )
        if not ca:
            address = x509.IPAddress(ipaddress.ip_address("127.0.0.1"))
            builder = builder.add_extension(x509.SubjectAlternativeName([address]), critical=False)
        return builder.sign(self._key, hashes.SHA256())

    @staticmethod
    def _write(file: Path, certificate: x509.Certificate) -> None:
        file.write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
