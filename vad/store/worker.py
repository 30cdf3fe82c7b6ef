"""The store for the event loop: every call runs on one thread of its own, in the order it was made."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Self, TypeVar

from vad.store.records import CameraRecord, DeviceRecord, EpochRecord, HistoryRecord, PosteriorRecord
from vad.store.store import Store

T = TypeVar("T")


class StoreWorker:
    """An asynchronous Store; `async with StoreWorker(path) as store`. Raises what Store raises.

    Whoever is cancelled while his call waits for its turn withdraws it; a call that has begun is finished,
    and leaving waits for it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="vad-store")
        self._store: Store | None = None

    async def open(self) -> None:
        """Open the file; StoreError where it cannot be used."""
        opening = self._pool.submit(Store, self._path)
        try:
            self._store = await asyncio.wrap_future(opening)
        except BaseException:
            self._pool.shutdown(wait=True)
            if not opening.cancelled() and opening.exception() is None:
                opening.result().close()
            raise

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
        await self._call(partial(self._opened().save_device, device, posterior))

    async def forget_device(self, mac: str) -> bool:
        """See Store.forget_device."""
        return await self._call(partial(self._opened().forget_device, mac))

    async def posterior(self, mac: str) -> PosteriorRecord | None:
        """See Store.posterior."""
        return await self._call(partial(self._opened().posterior, mac))

    async def history(self, mac: str, limit: int = 100) -> list[HistoryRecord]:
        """See Store.history."""
        return await self._call(partial(self._opened().history, mac, limit))

    async def save_camera(self, camera: CameraRecord) -> None:
        """See Store.save_camera."""
        await self._call(partial(self._opened().save_camera, camera))

    async def cameras(self, epoch: int) -> list[CameraRecord]:
        """See Store.cameras."""
        return await self._call(partial(self._opened().cameras, epoch))

    async def save_epoch(self, epoch: EpochRecord) -> None:
        """See Store.save_epoch."""
        await self._call(partial(self._opened().save_epoch, epoch))

    async def last_epoch(self) -> EpochRecord | None:
        """See Store.last_epoch."""
        return await self._call(self._opened().last_epoch)

    def _opened(self) -> Store:
        if self._store is None:
            raise RuntimeError("the store is not open")
        return self._store

    async def _call(self, work: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._pool, work)
