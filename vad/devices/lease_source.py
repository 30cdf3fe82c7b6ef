"""Names and addresses of stations, from dnsmasq's lease file as it changes."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Literal

from vad.devices import inotify
from vad.devices.inotify import Inotify
from vad.devices.leases import Lease, parse_leases
from vad.devices.station import StationEvent
from vad.errors import SourceError
from vad.health import Health
from vad.streams import DropOldestQueue

SETTLE_S = 0.03
"""dnsmasq writes the file anew in pieces: it is read when nothing was written for so long ..."""
SETTLE_MAX_S = 0.3
"""... but no later than this after the first piece."""
RETRY_FIRST_S = 0.5
RETRY_FACTOR = 2.0
RETRY_MAX_S = 10.0
MAX_BYTES = 4 << 20

_FILE = inotify.MODIFY | inotify.CLOSE_WRITE | inotify.ATTRIB | inotify.DELETE_SELF | inotify.MOVE_SELF
_FOLDER = inotify.CREATE | inotify.MOVED_TO | inotify.DELETE_SELF | inotify.MOVE_SELF

_log = logging.getLogger(__name__)


class LeaseSource:
    """A JoinSource that reads dnsmasq's leases when they change, and sleeps in between.

    Args:
        path: dnsmasq's dhcp-leasefile.
        joins: a lease lets its station join, and its end lets it leave: for networks whose access point
            tells nothing. Else leases only tell of stations.
    """

    def __init__(self, path: Path, *, joins: bool = False) -> None:
        self.health = Health(f"leases {path.name}")
        self._path = path
        self._joins = joins
        self._known: dict[str, Lease] = {}

    async def run(self, out: DropOldestQueue[StationEvent]) -> None:
        """Emit events into `out` until cancelled; trouble goes into `health`, never out of here."""
        retry_s = RETRY_FIRST_S
        while True:
            try:
                async with _watched(self._path) as changed:
                    while True:
                        self._emit(await asyncio.to_thread(_read, self._path), out)
                        retry_s = RETRY_FIRST_S
                        await _settled(changed)
            except (OSError, SourceError) as error:
                self._trouble(_reason(error))
            await asyncio.sleep(retry_s)
            retry_s = min(retry_s * RETRY_FACTOR, RETRY_MAX_S)

    def _emit(self, text: str | None, out: DropOldestQueue[StationEvent]) -> None:
        if text is None:
            self._trouble("the lease file is not there. Does dnsmasq run, and is this its dhcp-leasefile?")
            return
        leases, bad = parse_leases(text)
        if bad:
            self._bad_input(bad)
        for mac, lease in leases.items():
            if self._known.get(mac) != lease:
                self._put("joined" if self._joins and mac not in self._known else "told", lease, out)
        for mac in self._known.keys() - leases.keys() if self._joins else ():
            self._put("left", self._known[mac], out)
        self._known = leases
        self.health.ok(f"{len(leases)} leases")

    def _put(
        self, kind: Literal["joined", "left", "told"], lease: Lease, out: DropOldestQueue[StationEvent]
    ) -> None:
        self.health.counters[kind] += 1
        event = StationEvent(
            time.monotonic_ns(), kind, lease.mac, "dhcp", lease.host_name, lease.client_id, lease.ip
        )
        out.put(event)

    def _bad_input(self, lines: int) -> None:
        level = logging.DEBUG if self.health.counters["bad_input"] else logging.WARNING
        self.health.counters["bad_input"] += lines
        _log.log(level, "%s: %d lines are no leases", self._path, lines)

    def _trouble(self, reason: str) -> None:
        level = logging.WARNING if self.health.trouble(reason) else logging.DEBUG
        _log.log(level, "%s: %s", self._path, reason)


class _Changed:
    """Set when the file changed; watches the file anew when another took its place."""

    def __init__(self, watcher: Inotify, path: Path) -> None:
        self.event = asyncio.Event()
        self.gone = False
        self._watcher = watcher
        self._path = path
        self._folder = watcher.watch(path.parent, _FOLDER)
        self._watch_file()

    def readable(self) -> None:
        """Take what has happened (reader callback)."""
        for event in self._watcher.read():
            if event.watch == self._folder and event.mask & (inotify.DELETE_SELF | inotify.MOVE_SELF):
                self.gone = True
            elif event.watch == self._folder and event.name == self._path.name:
                self._watch_file()
            elif event.watch == self._folder and not event.mask & inotify.OVERFLOW:
                continue
            self.event.set()

    def _watch_file(self) -> None:
        with contextlib.suppress(FileNotFoundError):  # the folder tells when it comes
            self._watcher.watch(self._path, _FILE)


@contextlib.asynccontextmanager
async def _watched(path: Path) -> AsyncIterator[_Changed]:
    loop = asyncio.get_running_loop()
    watcher = Inotify()
    try:
        changed = _Changed(watcher, path)
        loop.add_reader(watcher.fileno(), changed.readable)
        yield changed
    finally:
        loop.remove_reader(watcher.fileno())
        watcher.close()


async def _settled(changed: _Changed) -> None:
    """Wait for a change and for the end of it; SourceError where the folder itself went."""
    await changed.event.wait()
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(SETTLE_MAX_S):
            while changed.event.is_set():
                changed.event.clear()
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(changed.event.wait(), SETTLE_S)
    changed.event.clear()
    if changed.gone:
        raise SourceError("the folder of the lease file was removed")


def _read(path: Path) -> str | None:
    """The file's text; None where there is none."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        return None
    if len(data) > MAX_BYTES:
        raise SourceError(f"larger than {MAX_BYTES >> 20} MiB: is this dnsmasq's lease file?")
    return data.decode("utf-8", "replace")


def _reason(error: OSError | SourceError) -> str:
    match error:
        case FileNotFoundError():
            return f"there is no folder {Path(error.filename)}. Is this the dhcp-leasefile of dnsmasq?"
        case PermissionError():
            return "the lease file may not be read. Let our user read it"
        case OSError():
            return f"the lease file cannot be watched: {error.strerror}"
        case _:
            return str(error)
