"""Echo requests over a veth pair into a network namespace, answered by the kernel or by a poor network."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import errno
import os
import secrets
import shutil
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from waiting import until, wait_until

from vad.csi.traffic import EchoTraffic
from vad.errors import VadError

_NET = "10.213.1"
_CLONE_NEWNET = 0x4000_0000
_PING_GROUPS = Path("/proc/sys/net/ipv4/ping_group_range")

# Answers every echo request but a part, as a network that loses packets does.
_POOR_ANSWERER = """
import random, socket, sys
rng = random.Random(1)
sock = socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_ICMP)
print("ready", flush=True)
while True:
    packet, sender = sock.recvfrom(2048)
    message = packet[20:]
    if message[0] == 8 and rng.random() >= float(sys.argv[1]):
        total = sum(int.from_bytes(message[i : i + 2], "big") for i in range(4, len(message), 2))
        total = (total & 0xFFFF) + (total >> 16)
        total = (total & 0xFFFF) + (total >> 16)
        sock.sendto(b"\\0\\0" + (~total & 0xFFFF).to_bytes(2, "big") + message[4:], sender)
"""


@dataclass(frozen=True)
class Peer:
    """A device at the other end of a cable."""

    namespace: str
    address: str
    interface: str

    def run(self, *command: str) -> list[str]:
        return ["ip", "netns", "exec", self.namespace, *command]


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)


@contextlib.contextmanager
def own_network() -> Iterator[None]:
    """This thread has a network to itself: nobody else's addresses and interfaces are in it.

    Who may send echo requests is taken over.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    groups = _PING_GROUPS.read_text()
    with Path("/proc/thread-self/ns/net").open() as before:
        if libc.unshare(_CLONE_NEWNET):
            pytest.skip(f"no network namespaces here: {os.strerror(ctypes.get_errno())}")
        try:
            with contextlib.suppress(OSError):  # where /proc may not be written the kernel's own must do
                _PING_GROUPS.write_text(groups)
            yield
        finally:
            assert libc.setns(before.fileno(), _CLONE_NEWNET) == 0, os.strerror(ctypes.get_errno())


def carries(address: str) -> bool:
    """Whether packets go there and back."""
    with socket.socket() as probe:
        probe.settimeout(1.0)
        try:
            return probe.connect_ex((address, 9)) == errno.ECONNREFUSED
        except OSError:
            return False


@pytest.fixture
def peer() -> Iterator[Peer]:
    if os.geteuid() != 0 or shutil.which("ip") is None:
        pytest.skip("network namespaces need root and iproute2")
    # Names of namespaces are for everybody on the machine.
    made = Peer(f"vadt{secrets.token_hex(4)}", f"{_NET}.2", "cable")
    with own_network():
        try:
            ip("netns", "add", made.namespace)
        except subprocess.CalledProcessError as error:
            pytest.skip(f"no network namespaces here: {error.stderr.decode().strip()}")
        try:
            try:
                ip("link", "add", made.interface, "type", "veth", "peer", "eth0", "netns", made.namespace)
            except subprocess.CalledProcessError as error:
                pytest.skip(f"no veth pairs here: {error.stderr.decode().strip()}")
            ip("addr", "add", f"{_NET}.1/24", "dev", made.interface)
            ip("link", "set", made.interface, "up")
            ip("-n", made.namespace, "addr", "add", f"{made.address}/24", "dev", "eth0")
            ip("-n", made.namespace, "link", "set", "eth0", "up")
            # The kernel turns a new cable's queues on when it has time, and asks a second later for the
            # hardware address of a device whose answer was dropped before that.
            wait_until(lambda: carries(made.address), f"the cable to {made.address} carries")
            yield made
        finally:
            ip("netns", "del", made.namespace)


@pytest.fixture
def poor_peer(peer: Peer) -> Iterator[Peer]:
    """The same, where three requests in ten go unanswered."""
    silent = peer.run("sysctl", "-qw", "net.ipv4.icmp_echo_ignore_all=1")
    subprocess.run(silent, check=True, capture_output=True)
    answer = peer.run(sys.executable, "-c", _POOR_ANSWERER, "0.3")
    with subprocess.Popen(answer, stdout=subprocess.PIPE, text=True) as answerer:
        try:
            assert answerer.stdout is not None
            assert answerer.stdout.readline() == "ready\n"
            yield peer
        finally:
            answerer.kill()


@contextlib.asynccontextmanager
async def sending(traffic: EchoTraffic) -> AsyncIterator[None]:
    task = asyncio.create_task(traffic.run())
    try:
        yield
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


@pytest.mark.timeout(180)
async def test_a_device_that_answers(peer: Peer) -> None:
    traffic = EchoTraffic(peer.address, 400)
    counters = traffic.health.counters
    async with sending(traffic):
        await until(lambda: counters["replies"] >= 300, "replies, be they slow", timeout_s=120)
        # A busy machine may be late for some; in half a second when it is not, every request has its reply.
        await until(lambda: ", 100% answered" in traffic.health.detail, "nothing is lost")
        assert traffic.health.state == "ok"
    assert counters["sent"] >= counters["replies"] + counters["lost"]
    stopped_at = counters["sent"]
    await asyncio.sleep(0)
    assert counters["sent"] == stopped_at


async def test_thirty_percent_loss_brings_the_rate_down(poor_peer: Peer) -> None:
    traffic = EchoTraffic(poor_peer.address, 400)
    counters = traffic.health.counters
    async with sending(traffic):
        await until(lambda: counters["backed_off"] >= 4 and counters["replies"] > 0)
        # What was sent last is not given up yet.
        await until(lambda: counters["lost"] > 0.15 * counters["sent"])


async def test_a_device_that_is_silent_is_told_once(peer: Peer, caplog: pytest.LogCaptureFixture) -> None:
    traffic = EchoTraffic(f"{_NET}.77", 200)
    async with sending(traffic):
        await until(lambda: traffic.health.state == "degraded")
        await until(lambda: traffic.health.counters["backed_off"] >= 3)
    assert "does not answer" in traffic.health.detail
    assert [r.levelname for r in caplog.records].count("WARNING") == 1


async def test_no_route_is_trouble_not_the_end() -> None:
    traffic = EchoTraffic("255.255.255.255", 100)
    async with sending(traffic):
        await until(lambda: traffic.health.state in ("degraded", "failed"))
    assert "Echo requests" in traffic.health.detail


@pytest.mark.parametrize("address", ["lamp", "fe80::1", "10.0.0.256", ""])
def test_only_ipv4(address: str) -> None:
    with pytest.raises(VadError, match="IPv4"):
        EchoTraffic(address, 100)
