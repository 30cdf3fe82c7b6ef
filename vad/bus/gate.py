"""The way in from the network: TLS, a certificate for each client, a role for each certificate.

The daemon's router listens on the loopback interface only. The gate is a zenoh peer between it and the
network, in a process of its own (vad.bus.gate_process). When the list of certificates changes, the gate comes
up anew with it, within WATCH_S; clients reconnect by themselves, daemon and programs on the hub go on as
before. The hub's own certificate is renewed before it ends.
"""

from __future__ import annotations

import asyncio
import base64
import logging
import sys
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import msgspec

from vad.bus.access import Holder, access_control
from vad.bus.gate_process import GateOrder, GateReport
from vad.bus.session import TLS, Values, plain_config
from vad.child import end_child
from vad.errors import VadError
from vad.health import Health
from vad.pki.certificates import days_left, utc_now
from vad.pki.folder import HubFiles, PkiFolder
from vad.pki.register import SOON_DAYS, Certificate

_log = logging.getLogger(__name__)

WATCH_S = 1.0
"""How soon an issued, rotated or revoked certificate counts."""
RETRY_FIRST_S = 0.5
RETRY_FACTOR = 2.0
RETRY_MAX_S = 10.0
OPEN_S = 30.0
"""How long the gate's process may take to open: on a busy hub a program is slow to start."""
RENEW_EVERY_S = 3600.0

PUT_BYTES = 1024 * 1024
"""A message from the network; an agent's batch of CSI is a tenth of it."""
QUERY_BYTES = 4096
MAX_SESSIONS = 64
PENDING_SESSIONS = 32
REPORT_BYTES = 256 * 1024
TOLD_EACH, TOLD_NAMES = 10, 100
"""Warnings of one client, and clients that are warned of; further attempts are counted, and shown with -v."""

Fingerprint = tuple[tuple[int, int, int] | None, ...]


@dataclass(frozen=True, slots=True)
class GateSettings:
    """hub: its name. listen: tls endpoints. daemon: the daemon's own router, on the loopback interface."""

    hub: str
    listen: tuple[str, ...]
    daemon: str


def gate_config(settings: GateSettings, files: HubFiles, holders: Iterable[Certificate]) -> Values:
    """zenoh's settings of the gate: who is trusted, who may do what, and how much may come in."""
    in_force = tuple(holders)
    trusted = "".join(c.link for c in in_force).encode()
    tls = "transport/link/tls"
    # A second router would do, but zenoh 1.10 panics now and then where one of two routers goes away.
    return plain_config("peer", listen=settings.listen, connect=(settings.daemon,)) | {
        f"{tls}/root_ca_certificate_base64": base64.b64encode(trusted).decode(),
        f"{tls}/listen_certificate": str(files.listener),
        f"{tls}/listen_private_key": str(files.listener),
        f"{tls}/enable_mtls": True,
        f"{tls}/close_link_on_expiration": True,
        "access_control": access_control(
            settings.hub, (Holder(c.common_name, c.role, c.name) for c in in_force)
        ),
        "low_pass_filter": [
            _at_most("messages", ("put", "reply"), PUT_BYTES),
            _at_most("questions", ("query", "delete"), QUERY_BYTES),
        ],
        "transport/link/rx/max_message_size": 2 * PUT_BYTES,
        "transport/unicast/max_sessions": MAX_SESSIONS,
        "transport/unicast/accept_pending": PENDING_SESSIONS,
    }


def _at_most(name: str, messages: tuple[str, ...], size: int) -> dict[str, object]:
    return {
        "id": name,
        "link_protocols": [TLS],
        "flows": ["ingress"],
        "messages": list(messages),
        "key_exprs": ["**"],
        "size_limit": size,
    }


class Gate:
    """Keeps the gate's process running with the certificates in force; one owner, one event loop."""

    def __init__(self, settings: GateSettings, folder: PkiFolder) -> None:
        self.health = Health("bus tls")
        self._settings = settings
        self._folder = folder
        self._connected: list[str] = []
        self._renewal = ""
        self._renewed_at_s = -RENEW_EVERY_S
        self._refused = ""
        self._told: dict[str, set[str]] = {}

    async def run(self) -> None:
        """Let clients in until cancelled; what is wrong is in `health`, never raised out of here."""
        retry_s = RETRY_FIRST_S
        while True:
            seen = await asyncio.to_thread(self._fingerprint)
            try:
                values, detail = await asyncio.to_thread(self._prepared)
                lasted = await self._serve(values, detail, seen)
            except VadError as error:
                self._trouble(str(error))
                lasted = False
            if lasted:
                retry_s = RETRY_FIRST_S
                continue
            with suppress(TimeoutError):
                async with asyncio.timeout(retry_s):
                    await self._changed(seen)
            retry_s = min(retry_s * RETRY_FACTOR, RETRY_MAX_S)

    def _prepared(self) -> tuple[Values, str]:
        """zenoh's settings of now, and what to say of them."""
        now = utc_now()
        files = self._folder.hub_files()
        if files.register.hub != self._settings.hub:
            raise VadError(
                f"these certificates are for the hub {files.register.hub!r}, this one is "
                f"{self._settings.hub!r}",
                where=str(self._folder.path),
                remedy="Name the right folder in bus: pki:, or make one with `vad pki init`",
            )
        if days_left(files.ends_at, now) <= 0:
            raise VadError(
                "the hub's certificate has expired: nobody is let in",
                where=str(files.listener),
                remedy="Is the hub's clock right? If so: `vad pki rotate hub`",
            )
        in_force = files.register.in_force(now)
        if not in_force:
            raise VadError(
                "no certificate is in force: nobody is let in from the network",
                remedy="`vad pki issue viewer NAME` makes one",
            )
        told = "1 certificate" if len(in_force) == 1 else f"{len(in_force)} certificates"
        days = days_left(files.ends_at, now)
        detail = f"{', '.join(self._settings.listen)}: {told} in force; the hub's ends in {days:.0f} days"
        return gate_config(self._settings, files, in_force), detail

    async def _serve(self, values: Values, detail: str, seen: Fingerprint) -> bool:
        """Run one process until certificates change (True) or it ends by itself."""
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "vad.bus.gate_process",
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            limit=REPORT_BYTES,
        )
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            with suppress(ConnectionError):  # it ended at once: what it said is read below
                process.stdin.write(msgspec.json.encode(GateOrder(values)) + b"\n")
                await process.stdin.drain()
            if not await self._opened(process.stdout, detail):
                return False
            return await self._until_changed(process.stdout, detail, seen)
        finally:
            self._connected = []
            await end_child(process)

    async def _opened(self, reports: asyncio.StreamReader, detail: str) -> bool:
        try:
            async with asyncio.timeout(OPEN_S):
                report = await _next(reports)
        except TimeoutError:
            self._trouble(f"the gate did not open within {OPEN_S:g} s")
            return False
        if report is None or report.state != "listening":
            cause = report.error if report is not None else "its process ended"
            self._trouble(self._explain(cause))
            return False
        self.health.counters["opened"] += 1
        self._say(detail)
        _log.info("listening on %s", detail)
        return True

    async def _until_changed(self, reports: asyncio.StreamReader, detail: str, seen: Fingerprint) -> bool:
        async with asyncio.TaskGroup() as group:
            watching = group.create_task(self._changed(seen))
            while True:
                reading = group.create_task(_next(reports))
                await asyncio.wait((watching, reading), return_when=asyncio.FIRST_COMPLETED)
                if watching.done():
                    reading.cancel()
                    return True
                report = reading.result()
                if report is None:
                    watching.cancel()
                    self._trouble("the gate's process ended; it is started again")
                    return False
                self._take(report, detail)

    def _take(self, report: GateReport, detail: str) -> None:
        counters = self.health.counters
        for attempt in report.denied:
            counters["denied"] += attempt.count
            name = attempt.common_name
            self._tell(name, f"{name!r} may not {attempt.what} on {attempt.key!r}")
        counters["denied"] += report.denied_more
        for reason, count in report.refused.items():
            counters["refused"] += count
            self._refused = reason
            self._tell("", f"a connection was refused: {reason}")
        for warning in report.warnings:
            _log.debug("zenoh: %r", warning)
        if report.connected is not None:
            self._connected = report.connected
        if report.connected is not None or report.refused:
            self._say(detail)

    def _tell(self, name: str, sentence: str) -> None:
        """Warn of something once, and not of everything: who floods must not fill the log."""
        if name not in self._told and len(self._told) >= TOLD_NAMES:
            name = ""  # ids that change with each connection
        told = self._told.setdefault(name, set())
        new = sentence not in told and len(told) < TOLD_EACH
        if new:
            told.add(sentence)
        _log.log(logging.WARNING if new else logging.DEBUG, "%s", sentence)
        if new and len(told) == TOLD_EACH:
            _log.warning("%s: further attempts are only counted", name or "others")

    def _say(self, detail: str) -> None:
        if self._connected:
            detail += f"; connected: {', '.join(self._connected)}"
        if self._refused:
            detail += f"; last refused: {self._refused}"
        if self._renewal:
            self._trouble(f"{self._renewal}. {detail}")
        else:
            self.health.ok(detail)

    async def _changed(self, seen: Fingerprint) -> None:
        """Wait until another certificate is in force; renews the hub's own in time."""
        while True:
            await self._renew()
            if await asyncio.to_thread(self._fingerprint) != seen:
                return
            await asyncio.sleep(WATCH_S)

    def _fingerprint(self) -> Fingerprint:
        return tuple(_stamp(path) for path in (self._folder.register_file, self._folder.hub_file))

    async def _renew(self) -> None:
        now_s = asyncio.get_running_loop().time()
        if now_s - self._renewed_at_s < RENEW_EVERY_S:
            return
        self._renewed_at_s = now_s
        try:
            self._renewal = await asyncio.to_thread(renew_hub, self._folder, utc_now())
        except VadError as error:
            self._renewal = f"the hub's certificate cannot be renewed: {error}"

    def _explain(self, cause: str) -> str:
        listen = ", ".join(self._settings.listen)
        if "Address already in use" in cause:
            return (
                f"{listen}: the port is taken. Listen on another one than {self._settings.daemon} and "
                "other programs do, e.g. 7448"
            )
        return f"{listen}: zenoh cannot open: {cause}"

    def _trouble(self, reason: str) -> None:
        if self.health.trouble(reason):
            _log.warning("%s", reason)


def renew_hub(folder: PkiFolder, now: datetime) -> str:
    """Renew the hub's certificate where it ends soon; what somebody has to do where that cannot be done."""
    left = days_left(folder.hub_files().ends_at, now)
    if left > SOON_DAYS:
        return ""
    if not folder.can_sign:
        return (
            f"the hub's certificate ends in {left:.0f} days and the authority's key is not here: "
            "`vad pki rotate hub` where it is"
        )
    folder.rotate_hub(folder.hub_addresses(), now)
    _log.info("the hub's certificate ended in %.0f days and was renewed", left)
    return ""


async def _next(reports: asyncio.StreamReader) -> GateReport | None:
    """The next report; None when the process has ended, or writes what is none."""
    try:
        line = await reports.readline()
        return msgspec.json.decode(line, type=GateReport) if line else None
    except (ValueError, msgspec.DecodeError):
        return None


def _stamp(path: Path) -> tuple[int, int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_ino, found.st_size
