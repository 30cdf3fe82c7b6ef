"""CSI live from the 5300's driver through NETLINK_CONNECTOR (formats.md 2)."""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
import struct
import time

from vad.csi import cn
from vad.csi.attribution import Attribution
from vad.csi.intake import Intake
from vad.csi.packets import CsiBatch
from vad.errors import ProtocolError
from vad.health import Health
from vad.streams import DropOldestQueue

log = logging.getLogger(__name__)

RETRY_S = 5.0
# A batch costs as much as some hundred of its packets; the clock map takes the wait out again.
COALESCE_S = 0.080
# An idle network's few packets are nobody's walk: they may gather for longer.
QUIET_MESSAGES = 20
QUIET_COALESCE_S = 0.150
RECEIVE_BUFFER_BYTES = 4 << 20
# One drain decodes at most this many messages before the event loop gets its turn.
DRAIN_MESSAGES = 2048
RECOVERED_S = 10.0
_MESSAGE_BYTES = cn.HEADER_BYTES + 0x10000
_SO_RCVBUFFORCE = 33
_SO_MEMINFO = 55
_SK_MEMINFO = struct.Struct("=9I")
_DROPS = 8


class Connector:
    """A CsiSource which joins the driver's multicast group. Joining needs CAP_NET_ADMIN.

    Args:
        group, value: the connector id of the driver.
        attribution: who the packets are from; pairs frames and CSI by default.
        allow_user_space: take messages that a process sent, not the kernel: tests and simulation only.
        receive_buffer_bytes: asked of the kernel, which doubles it; without CAP_NET_ADMIN it may give less.

    `health.counters`: messages, dropped (by the kernel, exact), overruns, user_space (refused senders),
    refused messages by reason, and those of vad.csi.intake.
    """

    def __init__(
        self,
        group: int = cn.IWLAGN_GROUP,
        value: int = cn.IWLAGN_VALUE,
        *,
        attribution: Attribution | None = None,
        allow_user_space: bool = False,
        receive_buffer_bytes: int = RECEIVE_BUFFER_BYTES,
    ) -> None:
        self.health = Health("csi.connector")
        self._group = group
        self._value = value
        self._allow_user_space = allow_user_space
        self._receive_buffer_bytes = receive_buffer_bytes
        self._intake = Intake(self.health, attribution)
        self._buffer = bytearray(_MESSAGE_BYTES)
        self._view = memoryview(self._buffer)
        self._drops_seen = 0
        self._loss_ahead = False
        self._warned: set[str] = set()
        self._trouble_ns = 0

    async def run(self, out: DropOldestQueue[CsiBatch]) -> None:
        """Emit batches until cancelled; opens the socket again after trouble."""
        while True:
            try:
                with self._open() as sock:
                    self._listening()
                    await self._receive(sock, out)
            except OSError as error:
                self._report(_remedy(error), failed=isinstance(error, PermissionError))
            await asyncio.sleep(RETRY_S)

    def _open(self) -> socket.socket:
        sock = socket.socket(
            socket.AF_NETLINK,
            socket.SOCK_DGRAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC,
            cn.NETLINK_CONNECTOR,
        )
        try:
            try:
                sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, self._receive_buffer_bytes)
            except PermissionError:
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, self._receive_buffer_bytes)
            # No groups in the address: they are a bit mask there, and group 26 as a mask is three others.
            sock.bind((0, 0))
            sock.setsockopt(cn.SOL_NETLINK, cn.NETLINK_ADD_MEMBERSHIP, self._group)
        except OSError:
            sock.close()
            raise
        self._drops_seen = 0
        self._intake.mark_loss()
        return sock

    async def _receive(self, sock: socket.socket, out: DropOldestQueue[CsiBatch]) -> None:
        loop = asyncio.get_running_loop()
        coalesce_s = COALESCE_S
        while True:
            woken: asyncio.Future[int] = loop.create_future()
            loop.add_reader(sock.fileno(), _wake, woken)
            try:
                woken_ns: int | None = await woken
            finally:
                loop.remove_reader(sock.fileno())
            await asyncio.sleep(coalesce_s)
            before = self.health.counters["messages"]
            while self._drain(sock, out, woken_ns):
                woken_ns = None
                await asyncio.sleep(0)
            quiet = self.health.counters["messages"] - before < QUIET_MESSAGES
            coalesce_s = QUIET_COALESCE_S if quiet else COALESCE_S

    def _drain(self, sock: socket.socket, out: DropOldestQueue[CsiBatch], woken_ns: int | None) -> bool:
        """Take what waits, at most DRAIN_MESSAGES; True when there may be more."""
        raw = bytearray()
        counters = self.health.counters
        buffer, view, receive = self._buffer, self._view, sock.recvfrom_into
        emptied, messages = False, 0
        for _ in range(DRAIN_MESSAGES):
            try:
                received, (sender, _groups) = receive(buffer)
            except BlockingIOError:
                emptied = True
                break
            except OSError as error:
                if error.errno != errno.ENOBUFS:
                    raise
                # It stands before the messages that were queued when the buffer overflowed.
                counters["overruns"] += 1
                self._loss_ahead = True
                continue
            messages += 1
            if sender != 0 and not self._allow_user_space:
                counters["user_space"] += 1
                self._report("A process, not the kernel, sends to the connector group: refused")
                continue
            try:
                size = cn.payload_bytes(buffer, received, self._group, self._value)
            except ProtocolError as error:
                counters[error.what] += 1
                self._report(f"Refused a connector message: {error.what}")
                continue
            raw += size.to_bytes(2, "big")
            raw += view[cn.HEADER_BYTES : cn.HEADER_BYTES + size]
        drained_ns = time.monotonic_ns()
        counters["messages"] += messages
        if raw:
            out.put(self._intake.feed(bytes(raw), drained_ns, woken_ns))
        self._count_drops(sock)
        if emptied and self._loss_ahead:
            # An overrun socket takes nothing until it is empty: what is missing would have come now.
            self._intake.mark_loss()
            self._loss_ahead = False
        if self.health.state == "degraded" and drained_ns - self._trouble_ns > RECOVERED_S * 1e9:
            self._listening()
        return not emptied

    def _count_drops(self, sock: socket.socket) -> None:
        memory = sock.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _SK_MEMINFO.size)
        drops = _SK_MEMINFO.unpack(memory)[_DROPS]
        missed = (drops - self._drops_seen) & 0xFFFF_FFFF
        self._drops_seen = drops
        if missed:
            self.health.counters["dropped"] += missed
            self._loss_ahead = True
            self._report("The receive buffer overflowed: CSI was lost")

    def _listening(self) -> None:
        self.health.ok(f"listening on connector group {self._group}")
        self._warned.clear()

    def _report(self, reason: str, *, failed: bool = False) -> None:
        """Note a trouble; each is logged as a warning once until all is well again."""
        self.health.trouble(reason, failed=failed)
        log.log(logging.DEBUG if reason in self._warned else logging.WARNING, "%s", reason)
        self._warned.add(reason)
        self._trouble_ns = time.monotonic_ns()


def _wake(woken: asyncio.Future[int]) -> None:
    if not woken.done():
        woken.set_result(time.monotonic_ns())


def _remedy(error: OSError) -> str:
    if isinstance(error, PermissionError):
        return "Joining the connector group is not permitted: run with CAP_NET_ADMIN"
    if error.errno == errno.EPROTONOSUPPORT:
        return "This kernel has no connector: load the 5300's CSI driver (CONFIG_CONNECTOR)"
    return f"The connector socket failed: {error}"
