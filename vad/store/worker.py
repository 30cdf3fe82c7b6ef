"""The store for the event loop: every call runs on one thread of its own; writes in the order they were made.

Where the disk is full or does not write, a write waits until it does again: whoever awaits it has not been
told that it is kept, and nothing that is published was not kept. Questions go on being answered meanwhile.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Self, TypeVar

from vad.devices.device import Device
from vad.health import Health
from vad.store.records import (
    AgentRecord,
    CameraRecord,
    DeviceRecord,
    EpochRecord,
    HistoryRecord,
    PastRecord,
    PosteriorRecord,
)
from vad.store.store import Store, StoreError, damage_report

log = logging.getLogger(__name__)

T = TypeVar("T")

RETRY_S = 1.0
"""How often a disk that does not write is tried again."""


class StoreWorker:
    """An asynchronous Store; `async with StoreWorker(path) as store`. Raises what Store raises.

    Whoever is cancelled while his call waits for its turn withdraws it; a call that has begun is finished,
    and leaving waits for it. What a caller has written he reads again.
    """

    def __init__(self, path: Path, *, retry_s: float = RETRY_S) -> None:
        self.health = Health("store")
        self._path = path
        self._retry_s = retry_s
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="vad-store")
        self._store: Store | None = None
        self._turn = asyncio.Lock()
        self._known = 0

    async def open(self) -> None:
        """Open the file; StoreError where it cannot be used."""
        opening = self._pool.submit(Store, self._path)
        try:
            self._store = await asyncio.wrap_future(opening)
            self._known = len(await self.devices())
            self._say()
        except BaseException:
            self._pool.shutdown(wait=True)
            if not opening.cancelled() and opening.exception() is None:
                opening.result().close()
            raise

    def _say(self) -> None:
        """What `vad status` shows of a store that writes; damage stays to be seen until the next start."""
        store = self._opened()
        if store.set_aside is not None:
            self.health.trouble(damage_report(store.set_aside, store.saved))
            return
        backup = f"; brought up to date, as it was before is {store.backup.name}" if store.backup else ""
        self.health.ok(f"{self._known} devices known at the start{backup}")

    async def close(self) -> None:
        """Finish what was asked for, close the file, end the thread; safe to call twice."""
        store, self._store = self._store, None
        try:
            if store is not None:
                await self._call(store.close)
        finally:
            self._pool.shutdown(wait=True)

    async def __aenter__(self) -> Self:
        await self.open()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    @property
    def set_aside(self) -> Path | None:
        """Where a damaged file was moved to when this was opened."""
        return self._opened().set_aside

    async def devices(self) -> list[DeviceRecord]:
        """See Store.devices."""
        return await self._call(self._opened().devices)

    async def device(self, mac: str) -> DeviceRecord | None:
        """See Store.device."""
        return await self._call(partial(self._opened().device, mac))

    async def save_device(self, device: DeviceRecord, posterior: PosteriorRecord | None = None) -> None:
        """See Store.save_device."""
        await self._write(partial(self._opened().save_device, device, posterior))

    async def save_devices(self, devices: Sequence[DeviceRecord]) -> None:
        """See Store.save_devices."""
        await self._write(partial(self._opened().save_devices, devices))

    async def forget_device(self, mac: str) -> bool:
        """See Store.forget_device."""
        return await self._write(partial(self._opened().forget_device, mac))

    async def posterior(self, mac: str) -> PosteriorRecord | None:
        """See Store.posterior."""
        return await self._call(partial(self._opened().posterior, mac))

    async def history(
        self, mac: str, limit: int = 100, *, since: str | None = None, until: str | None = None
    ) -> list[HistoryRecord]:
        """See Store.history."""
        return await self._call(partial(self._opened().history, mac, limit, since=since, until=until))

    async def past(self, at: str, mac: str | None = None) -> list[PastRecord]:
        """See Store.past."""
        return await self._call(partial(self._opened().past, at, mac))

    async def save_camera(self, camera: CameraRecord) -> None:
        """See Store.save_camera."""
        await self._write(partial(self._opened().save_camera, camera))

    async def cameras(self, epoch: int) -> list[CameraRecord]:
        """See Store.cameras."""
        return await self._call(partial(self._opened().cameras, epoch))

    async def save_epoch(self, epoch: EpochRecord) -> None:
        """See Store.save_epoch."""
        await self._write(partial(self._opened().save_epoch, epoch))

    async def last_epoch(self) -> EpochRecord | None:
        """See Store.last_epoch."""
        return await self._call(self._opened().last_epoch)

    async def save_agent(self, agent: AgentRecord) -> None:
        """See Store.save_agent."""
        await self._write(partial(self._opened().save_agent, agent))

    async def agents(self) -> list[AgentRecord]:
        """See Store.agents."""
        return await self._call(self._opened().agents)

    async def save_identities(self, kept: Sequence[Device], gone: Sequence[str] = ()) -> None:
        """See Store.save_identities."""
        await self._write(partial(self._opened().save_identities, kept, gone))

    async def identities(self) -> list[Device]:
        """See Store.identities."""
        return await self._call(self._opened().identities)

    def _opened(self) -> Store:
        if self._store is None:
            raise RuntimeError("the store is not open")
        return self._store

    async def _write(self, work: Callable[[], T]) -> T:
        """Do it, again and again where the disk does not let; later writes wait behind."""
        async with self._turn:
            while True:
                begun_s = time.perf_counter()
                try:
                    done = await self._call(work)
                except StoreError as error:
                    if not error.passing:
                        raise
                    self.health.counters["writes_refused"] += 1
                    if self.health.trouble(f"{error}: what is learned now waits to be kept", failed=True):
                        log.warning("%s", self.health.last_error)
                    await asyncio.sleep(self._retry_s)
                    continue
                self.health.took("write", time.perf_counter() - begun_s)
                self.health.counters["writes"] += 1
                if self.health.state == "failed":
                    log.warning("the store writes again")
                    self._say()
                return done

    async def _call(self, work: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._pool, work)
