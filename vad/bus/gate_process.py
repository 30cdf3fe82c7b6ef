"""The gate's own process: TLS and access rules between the network and the daemon's router.

What strangers can reach runs apart from the daemon, with a bound on its memory; the daemon starts it anew
when the list of certificates changes, because zenoh reads certificates and rules only once. It takes one
GateOrder as a line of JSON on standard input and ends when that closes; it writes one GateReport a line.
"""

from __future__ import annotations

import os
import resource
import sys
import threading
import time
from collections import Counter

import msgspec
import zenoh
from zenoh import handlers

from vad.bus.audit import LOG_FILTER, AuditReader, Denied, Other, Refused
from vad.bus.session import Values, open_config

REPORT_EVERY_S = 0.25
LINK_S = 5.0
"""How long the link to the daemon is waited for; it comes later, too, when the daemon's router does."""
MAX_TOLD = 32
"""Different denied attempts in one report; further ones are counted together."""
MEMORY_BYTES = 512 * 1024 * 1024
"""Of data, stacks included; beyond it the process ends and the daemon starts another."""


class GateOrder(msgspec.Struct, frozen=True):
    """zenoh's settings."""

    values: Values


class Attempt(msgspec.Struct, frozen=True):
    """So many messages of one kind that an access rule stopped."""

    common_name: str
    what: str
    key: str
    count: int


class GateReport(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What happened since the last report.

    state: `listening` once it is; `failed` with the reason in `error`. connected: common names, where they
    changed. denied: attempts, the most frequent first; denied_more: those beyond MAX_TOLD. refused: reasons
    why connections were not let in. warnings: what else zenoh complained of.
    """

    state: str = ""
    error: str = ""
    connected: list[str] | None = None
    denied: list[Attempt] = []
    denied_more: int = 0
    refused: dict[str, int] = {}
    warnings: list[str] = []


class Tally:
    """What the log and the links told since the last report; written by two threads, read by a third."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._reader = AuditReader()
        self._names: dict[str, str] = {}  # zenoh id -> common name, while connected
        self._denied: Counter[tuple[str, str, str]] = Counter()
        self._refused: Counter[str] = Counter()
        self._warnings: list[str] = []
        self._more = 0
        self._changed = False

    def line(self, line: str) -> None:
        """A line of zenoh's log."""
        found = self._reader.read(line)
        if found is None:
            return
        with self._lock:
            if isinstance(found, Denied):
                self._deny(found)
            elif isinstance(found, Refused):
                if found.reason in self._refused or len(self._refused) < MAX_TOLD:
                    self._refused[found.reason] += 1
            elif isinstance(found, Other) and len(self._warnings) < MAX_TOLD:
                self._warnings.append(found.text)

    def _deny(self, found: Denied) -> None:
        who = found.common_name or self._names.get(found.zid, found.zid)
        attempt = (who, found.what, found.key[:200])
        if attempt in self._denied or len(self._denied) < MAX_TOLD:
            self._denied[attempt] += 1
        else:
            self._more += 1

    def link(self, event: zenoh.LinkEvent) -> None:
        """A client came or went."""
        name = event.link.auth_identifier
        if name is None:
            return  # the link to the daemon
        with self._lock:
            if event.kind == zenoh.SampleKind.PUT:
                self._names[str(event.link.zid)] = name
            else:
                self._names.pop(str(event.link.zid), None)
            self._changed = True

    def report(self) -> GateReport | None:
        """What is new; None where nothing is."""
        with self._lock:
            if not (self._denied or self._refused or self._warnings or self._changed):
                return None
            found = GateReport(
                connected=sorted(self._names.values()) if self._changed else None,
                denied=[Attempt(*attempt, count) for attempt, count in self._denied.most_common()],
                denied_more=self._more,
                refused=dict(self._refused),
                warnings=self._warnings,
            )
            self._denied.clear()
            self._refused.clear()
            self._warnings, self._more, self._changed = [], 0, False
            return found


def main() -> None:
    """Run until standard input closes."""
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
    out = os.dup(1)
    tally, ended = Tally(), threading.Event()
    threading.Thread(target=_follow_log, args=(tally,), daemon=True).start()
    order = msgspec.json.decode(sys.stdin.buffer.readline(), type=GateOrder)
    try:
        session = open_config(order.values)
    except zenoh.ZError as error:
        _say(out, GateReport(state="failed", error=str(error)))
        sys.exit(1)
    # Never dropped: a listener that is collected stops listening.
    listener = session.info.declare_link_events_listener(
        handlers.Callback(tally.link, indirect=False), history=True
    )
    _wait_for_the_daemon(session)
    _say(out, GateReport(state="listening"))
    threading.Thread(target=_wait_for_the_end, args=(ended,), daemon=True).start()
    while not ended.wait(REPORT_EVERY_S):
        report = tally.report()
        if report is not None:
            _say(out, report)
    # No goodbye: zenoh would wait for clients that do not read, and the daemon may be gone.
    del listener
    os._exit(0)


def _follow_log(tally: Tally) -> None:
    """zenoh logs to standard output: read that here, and pass on what counts."""
    reading, writing = os.pipe()
    os.dup2(writing, 1)
    os.close(writing)
    os.environ["NO_COLOR"] = "1"
    os.environ["RUST_LOG"] = LOG_FILTER
    zenoh.init_log_from_env_or(LOG_FILTER)
    with os.fdopen(reading, encoding="utf-8", errors="replace") as lines:
        for line in lines:
            tally.line(line)


def _wait_for_the_daemon(session: zenoh.Session) -> None:
    """zenoh links to the daemon's router in the background; until then a client meets an empty home."""
    until_s = time.monotonic() + LINK_S
    while not list(session.info.routers_zid()) and time.monotonic() < until_s:
        time.sleep(0.005)


def _wait_for_the_end(ended: threading.Event) -> None:
    while sys.stdin.buffer.read(4096):
        pass
    ended.set()


def _say(out: int, report: GateReport) -> None:
    try:
        os.write(out, msgspec.json.encode(report) + b"\n")
    except OSError:
        os._exit(0)  # the daemon is gone


if __name__ == "__main__":
    main()
