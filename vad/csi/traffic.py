"""Traffic that provokes packets: ICMP echoes to the device under measurement."""

from __future__ import annotations

import asyncio
import errno
import ipaddress
import logging
import os
import socket
import struct
import time
from dataclasses import dataclass

from vad.csi.echo import EchoPacer, echo_request, reply_sequence
from vad.errors import ProtocolError, VadError
from vad.health import Health

log = logging.getLogger(__name__)

RETRY_S = 5.0
SAY_S = 1.0
POLL_S = 0.005
PAYLOAD = bytes(56)
_REPLIES_AT_ONCE = 64
_SOL_RAW = 255
_ICMP_FILTER = 1
_ALL_BUT_REPLIES = struct.pack("=I", 0xFFFF_FFFE)
_SILENT_SHARE = 0.02


@dataclass(frozen=True, slots=True)
class _Link:
    """An open socket; identifier: what our requests carry, None where the kernel chooses it."""

    sock: socket.socket
    identifier: int | None


class EchoTraffic:
    """Sends echo requests to one device until cancelled; each of its replies is a packet with CSI.

    An unprivileged ping socket where net.ipv4.ping_group_range allows it, else a raw one (CAP_NET_RAW).

    Args:
        address: the device's IPv4 address.
        packets_per_s: wanted; less is sent where replies are lost or come late (vad.csi.echo).
        health: counters sent, replies, lost, backed_off, refused (by the network stack) go on in it.

    Raises VadError where `address` is not IPv4.
    """

    def __init__(self, address: str, packets_per_s: float, health: Health | None = None) -> None:
        try:
            self._address = str(ipaddress.IPv4Address(address))
        except ValueError as error:
            raise VadError(f"{address!r} is not an IPv4 address") from error
        self._packets_per_s = packets_per_s
        self.health = health or Health("csi.traffic")

    async def run(self) -> None:
        """Send until cancelled; opens the socket again after trouble."""
        while True:
            try:
                link = self._open()
                with link.sock:
                    await self._pace(link)
            except OSError as error:
                self._report(_remedy(error), failed=isinstance(error, PermissionError))
            await asyncio.sleep(RETRY_S)

    def _open(self) -> _Link:
        flags = socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC
        try:
            sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | flags, socket.IPPROTO_ICMP)
            identifier = None
        except PermissionError:
            sock = socket.socket(socket.AF_INET, socket.SOCK_RAW | flags, socket.IPPROTO_ICMP)
            sock.setsockopt(_SOL_RAW, _ICMP_FILTER, _ALL_BUT_REPLIES)
            identifier = int.from_bytes(os.urandom(2), "big")
        try:
            sock.connect((self._address, 0))
        except OSError:
            sock.close()
            raise
        return _Link(sock, identifier)

    async def _pace(self, link: _Link) -> None:
        pacer = EchoPacer(self._packets_per_s, time.monotonic_ns())
        before = dict(self.health.counters)
        say_ns = time.monotonic_ns() + int(SAY_S * 1e9)
        while True:
            self._take_replies(link, pacer)
            for sequence in pacer.due(time.monotonic_ns()):
                self._send(link, sequence)
            now_ns = time.monotonic_ns()
            if now_ns >= say_ns:
                self._say(pacer, before)
                say_ns = now_ns + int(SAY_S * 1e9)
            # Replies are looked for when it is time to send, or soon: they need no wake-up of their own.
            pause_s = max(0.0, (pacer.next_ns - now_ns) / 1e9)
            await asyncio.sleep(min(pause_s, POLL_S) if pacer.waits else pause_s)

    def _send(self, link: _Link, sequence: int) -> None:
        try:
            link.sock.send(echo_request(link.identifier or 0, sequence, PAYLOAD))
        except OSError as error:
            # A full queue or a device that is away is a lost request; a network that is gone is not.
            if error.errno not in (errno.EAGAIN, errno.ENOBUFS, errno.EHOSTUNREACH, errno.ECONNREFUSED):
                raise
            self.health.counters["refused"] += 1

    def _take_replies(self, link: _Link, pacer: EchoPacer) -> None:
        for _ in range(_REPLIES_AT_ONCE):
            try:
                datagram = link.sock.recv(2048)
            except BlockingIOError:
                return
            except OSError as error:
                if error.errno not in (errno.EHOSTUNREACH, errno.ECONNREFUSED):
                    raise
                continue
            try:
                pacer.replied(reply_sequence(datagram, link.identifier), time.monotonic_ns())
            except ProtocolError:
                self.health.counters["foreign"] += 1

    def _say(self, pacer: EchoPacer, before: dict[str, int]) -> None:
        counters = self.health.counters
        for name, n in (
            ("sent", pacer.sent),
            ("replies", pacer.replies),
            ("lost", pacer.lost),
            ("backed_off", pacer.backed_off),
        ):
            counters[name] = before.get(name, 0) + n
        share = pacer.reply_share
        if share is not None and share < _SILENT_SHARE:
            self._report(f"{self._address} does not answer echo requests")
            return
        told = "" if share is None else f", {share:.0%} answered"
        self.health.ok(
            f"{pacer.rate_per_s:.0f} of {self._packets_per_s:.0f} packets/s to {self._address}{told}"
        )

    def _report(self, reason: str, *, failed: bool = False) -> None:
        fresh = self.health.trouble(reason, failed=failed)
        log.log(logging.WARNING if fresh else logging.DEBUG, "%s", reason)


def _remedy(error: OSError) -> str:
    if isinstance(error, PermissionError):
        return "Echo requests are not permitted: widen net.ipv4.ping_group_range, or run with CAP_NET_RAW"
    return f"Echo requests cannot be sent: {error.strerror}"
