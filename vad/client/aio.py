"""The same client for asyncio: a question waits without holding up the loop, many may wait at once."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import numpy as np
import zenoh
from numpy.typing import NDArray
from zenoh import handlers

from vad.bus import messages as m
from vad.bus.keys import HubKeys
from vad.bus.selectors import Bbox
from vad.bus.session import DEFAULT_ENDPOINT, BusSettings, open_session
from vad.client import questions as q
from vad.client.subscriptions import Arrived, Change, change_of, event_of
from vad.errors import VadError
from vad.streams import DropOldestQueue

EVENT_BACKLOG = 1000

T = TypeVar("T")


class AsyncVadClient:
    """A connection to a daemon on one event loop; reconnects by itself after a daemon's restart.

    Arguments and errors are VadClient's.
    """

    def __init__(
        self,
        endpoint: str = DEFAULT_ENDPOINT,
        hub: str = "*",
        *,
        timeout_s: float = q.QUERY_TIMEOUT_S,
        credentials: Path | None = None,
    ) -> None:
        self.endpoint = endpoint
        self.keys = HubKeys(hub)
        self._questions = q.Questions(self.keys)
        self._timeout_s = timeout_s
        self._credentials = credentials
        self._session: zenoh.Session | None = None

    async def open(self) -> None:
        """Connect; UnreachableError where no router or no daemon is."""
        settings = BusSettings(
            hub=self.keys.hub, mode="client", connect=(self.endpoint,), credentials=self._credentials
        )
        opening = asyncio.get_running_loop().run_in_executor(None, open_session, settings)
        try:
            self._session = await asyncio.shield(opening)
        except asyncio.CancelledError:
            await asyncio.wait({opening})
            if opening.exception() is None:
                await asyncio.to_thread(opening.result().close)
            raise
        except VadError as error:
            if isinstance(error.__cause__, zenoh.ZError):
                raise self._unreachable() from error
            raise
        if not await self.hubs():
            await self.close()
            raise self._unreachable()

    async def close(self) -> None:
        """Disconnect; safe to call twice."""
        session, self._session = self._session, None
        if session is not None:
            with suppress(zenoh.ZError):  # it could not say goodbye in time
                await asyncio.to_thread(session.close)

    async def __aenter__(self) -> Self:
        await self.open()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def hubs(self) -> list[str]:
        """The hubs whose daemon is alive, by name."""
        token = self._connected().liveliness()

        def get(handler: handlers.Callback[zenoh.Reply]) -> None:
            token.get(self.keys.alive, handler, timeout=self._timeout_s)

        found, _ = await _gathered(get)
        return q.hub_names(found)

    async def devices(
        self,
        *,
        room: str | Iterable[str] = (),
        state: str | Iterable[str] = (),
        mac: str | Iterable[str] = (),
        max_sigma_m: float | None = None,
        since: str | None = None,
        bbox: Bbox | None = None,
        at: str | None = None,
    ) -> list[m.DeviceMessage]:
        """Devices by MAC; see VadClient.devices."""
        return await self._ask(self._questions.devices(room, state, mac, max_sigma_m, since, bbox, at))

    async def devices_geojson(
        self,
        *,
        room: str | Iterable[str] = (),
        state: str | Iterable[str] = (),
        mac: str | Iterable[str] = (),
        max_sigma_m: float | None = None,
        since: str | None = None,
        bbox: Bbox | None = None,
        at: str | None = None,
    ) -> dict[str, Any]:
        """The same as a GeoJSON FeatureCollection; coordinates are metres of the map, not degrees."""
        return await self._ask(self._questions.geojson(room, state, mac, max_sigma_m, since, bbox, at))

    async def device(self, mac: str, *, at: str | None = None) -> m.DeviceMessage | None:
        """One device, as it is or as it was at a time; None where the daemon does (did) not know it."""
        return await self._ask(self._questions.device(mac, at))

    async def history(
        self, mac: str, *, since: str | None = None, until: str | None = None, limit: int = 100
    ) -> m.HistoryMessage | None:
        """What was said of a device, the newest first; None where the daemon does not know it."""
        return await self._ask(self._questions.history(mac, since, until, limit))

    async def heatmap(self, mac: str) -> m.HeatmapMessage | None:
        """A device's posterior with its bounds; None where there is none yet."""
        return await self._ask(self._questions.heatmap(mac))

    async def heatmap_png(self, mac: str) -> bytes | None:
        """A device's posterior as a picture, one pixel a cell, to lay over the map; None: none yet."""
        return await self.heatmap_bytes(mac, "png")

    async def heatmap_bytes(self, mac: str, form: str) -> bytes | None:
        """A device's posterior as it is sent: `png`, `npy` or `json`; None: none yet."""
        return await self._ask(self._questions.heatmap_bytes(mac, form))

    async def heatmap_array(self, mac: str) -> NDArray[np.float32] | None:
        """A device's posterior: (height, width), row 0 at the lowest y, sums to 1; None: none yet."""
        return await self._ask(self._questions.heatmap_array(mac))

    async def cameras(self) -> list[m.CameraMessage]:
        """The cameras by id."""
        return await self._ask(self._questions.cameras())

    async def captures(self) -> list[m.CaptureMessage]:
        """The last capture sessions, the one that changed last at the end."""
        return await self._ask(self._questions.captures())

    async def map(self) -> m.MapMessage | None:
        """The floor plan's frame and rooms; None where the daemon has no map yet."""
        return await self._ask(self._questions.map())

    async def grid_png(self) -> bytes | None:
        """The occupancy grid as PNG; None where there is none."""
        return await self._ask(self._questions.grid_png())

    async def status(self) -> m.StatusMessage | None:
        """The daemon's health; None where it has just started and said nothing yet."""
        return await self._ask(self._questions.status())

    async def recent_events(self, *, since: str | None = None) -> list[m.EventMessage]:
        """What happened since the daemon started, or after a time; the newest first, the last 256 at most."""
        return await self._ask(self._questions.recent_events(since))

    async def schemas(self) -> dict[str, dict[str, Any]]:
        """JSON Schemas of everything the daemon sends, by schema id."""
        return await self._ask(self._questions.schemas())

    def events(self) -> AsyncIterator[m.EventMessage]:
        """What happens from the first step of the loop on; UnreachableError when the daemon goes away."""
        return self._arriving(self.keys.events, event_of)

    def changes(self) -> AsyncIterator[Change]:
        """Every change of a device; else as `events`."""
        return self._arriving(self.keys.device(), change_of)

    async def _arriving(self, key: str, read: Callable[[Arrived], T | None]) -> AsyncIterator[T]:
        session, loop = self._connected(), asyncio.get_running_loop()
        arrived: DropOldestQueue[Arrived] = DropOldestQueue(EVENT_BACKLOG)

        def put(item: Arrived) -> None:
            with suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(arrived.put, item)

        def hand_over(sample: zenoh.Sample) -> None:
            deleted = sample.kind == zenoh.SampleKind.DELETE
            put(Arrived(str(sample.key_expr), None if deleted else sample.payload.to_bytes()))

        def alive_changed(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.DELETE:
                put(Arrived(gone=True))

        subscriptions = (
            session.declare_subscriber(key, handlers.Callback(hand_over, indirect=False)),
            session.liveliness().declare_subscriber(
                self.keys.alive, handlers.Callback(alive_changed, indirect=False)
            ),
        )
        try:
            if not await self.hubs():
                raise self._unreachable()
            while True:
                item = await arrived.get()
                if item.gone:
                    raise self._unreachable()
                value = read(item)
                if value is not None:
                    yield value
        finally:
            for subscription in subscriptions:
                subscription.undeclare()  # type: ignore[no-untyped-call]

    def _connected(self) -> zenoh.Session:
        if self._session is None:
            raise VadError("the client is not open", remedy="Use it in an async with statement")
        return self._session

    def _unreachable(self) -> q.UnreachableError:
        return q.unreachable(self.endpoint, self.keys.hub)

    async def _ask(self, question: q.Question[T]) -> T:
        """The answer; an empty one is believed only from a daemon that is alive."""
        session = self._connected()

        def get(handler: handlers.Callback[zenoh.Reply]) -> None:
            session.get(
                question.selector,
                handler,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=self._timeout_s,
            )

        try:
            found, refused = await _gathered(get)
        except zenoh.ZError as error:
            raise VadError(f"the question failed: {error}", where=question.selector) from error
        if refused is not None:
            raise q.refusal(refused, self.endpoint, self._timeout_s)
        if not found and not await self.hubs():
            raise self._unreachable()
        return question.read(found)


async def _gathered(
    get: Callable[[handlers.Callback[zenoh.Reply]], None],
) -> tuple[dict[str, bytes], bytes | None]:
    """Key -> payload of the replies to a question, and the first refusal; zenoh itself keeps the time."""
    loop = asyncio.get_running_loop()
    over = asyncio.Event()
    found: dict[str, bytes] = {}
    refused: list[bytes] = []

    def take(reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            found[str(reply.ok.key_expr)] = reply.ok.payload.to_bytes()
        elif reply.err is not None:
            refused.append(reply.err.payload.to_bytes())

    def end() -> None:
        with suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(over.set)

    get(handlers.Callback(take, end, indirect=False))
    await over.wait()
    return found, refused[0] if refused else None
