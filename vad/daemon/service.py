"""The daemon as a service: its core runs, is watched, and begins anew with other settings on SIGHUP.

What can change while it runs does (vad.daemon.live); for all else the core ends in an orderly way and starts
again in the same process, some seconds without answers. A file that cannot be used is refused with its
reason, and the settings that are in force stay.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from vad.config import Settings, load_settings
from vad.daemon.captures import Captures
from vad.daemon.checks import check_files
from vad.daemon.confinement import is_stale
from vad.daemon.live import Live
from vad.daemon.notify import notify
from vad.daemon.registry import Registry
from vad.daemon.solver import SOLVE_TIMEOUT_S
from vad.daemon.watchdog import Watchdog, feed, feed_every_s
from vad.devices.station import StationEvent
from vad.errors import VadError
from vad.health import Health
from vad.streams import DropOldestQueue

_log = logging.getLogger(__name__)

DROP_IN_FOLDER = Path("/etc/systemd/system/vad.service.d")
WRITE_S = 60.0
"""What a slow disk may take beside the solving of a walk."""


class Supervision:
    """What the core and the service around it tell each other.

    Attributes:
        opening: disk and port are being opened: what fails then may go another time.
        ready: the core has come so far that it answers.
        refused: why the settings file of the last reload is not in force; empty where it is.
        live: where settings go that change while the core runs; None until it can take them.
    """

    def __init__(self) -> None:
        self.watchdog = Watchdog(feed, every_s=feed_every_s())
        self.opening = self.ready = False
        self.refused = ""
        self.live: Live | None = None

    @property
    def may_go(self) -> bool:
        """Whether what has failed may go another time with the same settings."""
        return self.opening or self.ready

    def begin(self) -> None:
        """Another core begins."""
        self.watchdog.forget()
        self.opening = self.ready = False
        self.live = None

    def up(self, step: str = "") -> None:
        """The core answers; step: what it waits for."""
        self.ready = True
        notify(f"READY=1\nSTATUS={step}" if step else "READY=1")

    def attend(
        self,
        queues: Mapping[str, DropOldestQueue[Any]],
        stations: DropOldestQueue[StationEvent],
        captures: Captures,
        registry: Registry,
        store: Health,
    ) -> None:
        """The core is complete: watch its parts, and give it settings that change. queues: by their names.

        On a full disk all that writes waits until there is room again (vad.store.worker): that is no hanging.
        """
        self.live = Live(registry, captures, stations)

        def disk_refuses() -> bool:
            return store.state == "failed"

        for name, queue in queues.items():
            self.watchdog.add_queue(f"{name} wait and are not taken", queue)
        self.watchdog.add_queue("devices that join are not taken in", stations, disk_refuses)
        self.watchdog.add(
            "the capture loop does not go on",
            lambda: not disk_refuses(),
            lambda: captures.turns,
            SOLVE_TIMEOUT_S + WRITE_S,
        )


Core = Callable[[Settings, Path, Supervision], Awaitable[None]]


async def serve(settings: Settings, config_file: Path, core: Core, supervision: Supervision) -> None:
    """Run `core` until cancelled. Raises VadError where it cannot start, or breaks."""
    service = _Service(core, config_file, supervision)
    feeding = asyncio.create_task(supervision.watchdog.run(), name="watchdog")
    try:
        with _on_hangup(service.reload.set):
            await service.run(settings)
    finally:
        notify("STOPPING=1")
        feeding.cancel()
        await asyncio.wait({feeding})


class _Service:
    def __init__(self, core: Core, config_file: Path, supervision: Supervision) -> None:
        self.reload = asyncio.Event()
        self._core = core
        self._config_file = config_file
        self._supervision = supervision

    async def run(self, settings: Settings) -> None:
        """Run with these settings, and then with those that a reload brings."""
        before: Settings | None = None
        while True:
            if is_stale(settings, DROP_IN_FOLDER):
                _log.warning("systemd lets the daemon reach what earlier settings named: sudo vad install")
            try:
                fresh = await self._until_others(settings)
            except VadError as error:
                if before is None or self._supervision.ready:
                    raise
                self._refuse(f"with the new settings it cannot start: {error}")
                settings, before = before, None
                continue
            settings, before = fresh, settings
            _log.info("the settings have changed: beginning anew with them")

    async def _until_others(self, settings: Settings) -> Settings:
        """Run the core until the settings file holds others that it cannot take while it runs."""
        self._supervision.begin()
        core = asyncio.ensure_future(self._core(settings, self._config_file, self._supervision))
        try:
            while True:
                asked = asyncio.create_task(self.reload.wait(), name="reload")
                try:
                    await asyncio.wait({core, asked}, return_when=asyncio.FIRST_COMPLETED)
                finally:
                    asked.cancel()
                if core.done():
                    core.result()
                    raise VadError("the daemon's core ended by itself")
                self.reload.clear()
                notify(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")
                fresh = await self._read()
                if fresh is not None:
                    self._supervision.refused = ""
                    live = self._supervision.live
                    if live is None or not await live.use(settings, fresh):
                        return fresh
                    settings = fresh
                    notify("READY=1")
        finally:
            core.cancel()
            with contextlib.suppress(asyncio.CancelledError, VadError):
                await core

    async def _read(self) -> Settings | None:
        """What the settings file holds now; None where it cannot be used."""
        try:
            fresh = await asyncio.to_thread(load_settings, self._config_file)
            await asyncio.to_thread(check_files, fresh, self._config_file)
        except VadError as error:
            self._refuse(str(error))
            return None
        return fresh

    def _refuse(self, reason: str) -> None:
        self._supervision.refused = f"the settings file is not in force: {reason}"
        _log.error("%s. The settings of before go on", self._supervision.refused)
        notify(f"READY=1\nSTATUS={self._supervision.refused}")


@contextlib.contextmanager
def _on_hangup(reload: Callable[[], None]) -> Iterator[None]:
    """SIGHUP reloads, except in a terminal: there it means that the terminal has gone."""
    if os.isatty(0):
        yield
        return
    loop = asyncio.get_running_loop()
    loop.add_signal_handler(signal.SIGHUP, reload)
    try:
        yield
    finally:
        loop.remove_signal_handler(signal.SIGHUP)
