"""The plain client: every call waits for its answer. For commands, scripts, notebooks."""

from __future__ import annotations

import contextlib
import queue
from collections.abc import Callable, Iterable, Iterator
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

EVENT_POLL_S = 0.2
"""How soon a loop over events notices Ctrl-C."""
EVENT_BACKLOG = 1000

T = TypeVar("T")


class VadClient:
    """A connection to a daemon; usable from one thread, reconnects by itself after a daemon's restart.

    Args:
        endpoint: the daemon's zenoh endpoint: tcp on the loopback interface, tls from elsewhere.
        hub: the hub's name; `*` asks whichever answers (two that answer a question for one is an error).
        timeout_s: how long one question may take.
        credentials: the folder that `vad pki issue` made, for tls.

    Raises:
        UnreachableError: nobody listens at the endpoint, or the daemon behind it is gone.
        QueryError: the daemon refused the question.
        ProtocolError: the answer is not of a kind this version reads.
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

    def open(self) -> None:
        """Connect; UnreachableError where no router or no daemon is."""
        settings = BusSettings(
            hub=self.keys.hub, mode="client", connect=(self.endpoint,), credentials=self._credentials
        )
        try:
            self._session = open_session(settings)
        except VadError as error:
            if isinstance(error.__cause__, zenoh.ZError):
                raise self._unreachable() from error
            raise
        if not self.hubs():
            self.close()
            raise self._unreachable()

    def close(self) -> None:
        """Disconnect; safe to call twice."""
        session, self._session = self._session, None
        if session is not None:
            with contextlib.suppress(zenoh.ZError):  # it could not say goodbye in time
                session.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def hubs(self) -> list[str]:
        """The hubs whose daemon is alive, by name."""
        replies = self._connected().liveliness().get(self.keys.alive, timeout=self._timeout_s)
        return q.hub_names(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)

    def devices(
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
        """Devices by MAC; each argument narrows, several values of one are alternatives.

        since: only those that changed after this time (RFC 3339). bbox: only those placed within x0, y0, x1,
        y1, metres. at: as they were at this time.
        """
        return self._ask(self._questions.devices(room, state, mac, max_sigma_m, since, bbox, at))

    def devices_geojson(
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
        return self._ask(self._questions.geojson(room, state, mac, max_sigma_m, since, bbox, at))

    def device(self, mac: str, *, at: str | None = None) -> m.DeviceMessage | None:
        """One device, as it is or as it was at a time; None where the daemon does (did) not know it."""
        return self._ask(self._questions.device(mac, at))

    def history(
        self, mac: str, *, since: str | None = None, until: str | None = None, limit: int = 100
    ) -> m.HistoryMessage | None:
        """What was said of a device, the newest first; None where the daemon does not know it."""
        return self._ask(self._questions.history(mac, since, until, limit))

    def heatmap(self, mac: str) -> m.HeatmapMessage | None:
        """A device's posterior with its bounds (`vad.bus.messages.probabilities` reads it), or None."""
        return self._ask(self._questions.heatmap(mac))

    def heatmap_png(self, mac: str) -> bytes | None:
        """A device's posterior as a picture, one pixel a cell, to lay over the map; None: none yet."""
        return self.heatmap_bytes(mac, "png")

    def heatmap_bytes(self, mac: str, form: str) -> bytes | None:
        """A device's posterior as it is sent: `png`, `npy` or `json`; None: none yet."""
        return self._ask(self._questions.heatmap_bytes(mac, form))

    def heatmap_array(self, mac: str) -> NDArray[np.float32] | None:
        """A device's posterior: (height, width), row 0 at the lowest y, sums to 1; None: none yet."""
        return self._ask(self._questions.heatmap_array(mac))

    def cameras(self) -> list[m.CameraMessage]:
        """The cameras by id."""
        return self._ask(self._questions.cameras())

    def captures(self) -> list[m.CaptureMessage]:
        """The last capture sessions, the one that changed last at the end."""
        return self._ask(self._questions.captures())

    def map(self) -> m.MapMessage | None:
        """The floor plan's frame and rooms; None where the daemon has no map yet."""
        return self._ask(self._questions.map())

    def grid_png(self) -> bytes | None:
        """The occupancy grid as PNG (`vad.bus.grid.png_to_grid` reads it); None where there is none."""
        return self._ask(self._questions.grid_png())

    def status(self) -> m.StatusMessage | None:
        """The daemon's health; None where it has just started and said nothing yet."""
        return self._ask(self._questions.status())

    def recent_events(self, *, since: str | None = None) -> list[m.EventMessage]:
        """What happened since the daemon started, or after a time; the newest first, the last 256 at most."""
        return self._ask(self._questions.recent_events(since))

    def schemas(self) -> dict[str, dict[str, Any]]:
        """JSON Schemas of everything the daemon sends, by schema id."""
        return self._ask(self._questions.schemas())

    def wish(self, wish: m.DeviceWish) -> m.WishReply:
        """Have the daemon ignore, rename or forget a device; what became of it, and who is ignored now.

        Raises QueryError where the daemon refuses, VadError where it is not clear which hub is meant.
        """
        hubs = self.hubs()
        if len(hubs) > 1:
            raise VadError(f"several hubs answer: {', '.join(hubs)}", remedy="Name one with --hub")
        if not hubs:
            raise self._unreachable()
        return self._ask(q.Questions(HubKeys(hubs[0])).wish(wish))

    def events(self, timeout_s: float | None = None) -> Iterator[m.EventMessage]:
        """What happens from now on, until `timeout_s` passes without an event (None: for ever).

        The subscription stands when this returns. Raises UnreachableError when the daemon goes away.
        """
        return self._arriving(self.keys.events, event_of, timeout_s)

    def changes(self, timeout_s: float | None = None) -> Iterator[Change]:
        """Every change of a device from now on; else as `events`."""
        return self._arriving(self.keys.device(), change_of, timeout_s)

    def _arriving(
        self, key: str, read: Callable[[Arrived], T | None], timeout_s: float | None
    ) -> Iterator[T]:
        session = self._connected()
        arrived: queue.Queue[Arrived] = queue.Queue(EVENT_BACKLOG)

        def hand_over(sample: zenoh.Sample) -> None:
            deleted = sample.kind == zenoh.SampleKind.DELETE
            payload = None if deleted else sample.payload.to_bytes()
            _put_newest(arrived, Arrived(str(sample.key_expr), payload))

        def alive_changed(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.DELETE:
                _put_newest(arrived, Arrived(gone=True))

        subscriptions = (
            session.declare_subscriber(key, handlers.Callback(hand_over, indirect=False)),
            session.liveliness().declare_subscriber(
                self.keys.alive, handlers.Callback(alive_changed, indirect=False)
            ),
        )
        if not self.hubs():
            raise self._unreachable()
        return self._read(arrived, subscriptions, read, timeout_s)

    def _read(
        self,
        arrived: queue.Queue[Arrived],
        subscriptions: tuple[zenoh.Subscriber[None], ...],
        read: Callable[[Arrived], T | None],
        timeout_s: float | None,
    ) -> Iterator[T]:
        waited_s = 0.0
        try:
            while timeout_s is None or waited_s < timeout_s:
                wait_s = EVENT_POLL_S if timeout_s is None else min(EVENT_POLL_S, timeout_s - waited_s)
                try:
                    item = arrived.get(timeout=wait_s)
                except queue.Empty:
                    waited_s += wait_s
                    continue
                if item.gone:
                    raise self._unreachable()
                waited_s = 0.0
                value = read(item)
                if value is not None:
                    yield value
        finally:
            for subscription in subscriptions:
                subscription.undeclare()  # type: ignore[no-untyped-call]

    def _connected(self) -> zenoh.Session:
        if self._session is None:
            raise VadError("the client is not open", remedy="Use it in a with statement")
        return self._session

    def _unreachable(self) -> q.UnreachableError:
        return q.unreachable(self.endpoint, self.keys.hub)

    def _ask(self, question: q.Question[T]) -> T:
        """The answer; an empty one is believed only from a daemon that is alive."""
        try:
            replies = self._connected().get(
                question.selector,
                payload=question.payload,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=self._timeout_s,
            )
            found: dict[str, bytes] = {}
            for reply in replies:
                if reply.ok is not None:
                    found[str(reply.ok.key_expr)] = reply.ok.payload.to_bytes()
                elif reply.err is not None:
                    raise q.refusal(reply.err.payload.to_bytes(), self.endpoint, self._timeout_s)
            if not found and not self.hubs():
                raise self._unreachable()
        except zenoh.ZError as error:
            raise VadError(f"the question failed: {error}", where=question.selector) from error
        return question.read(found)


def _put_newest(arrived: queue.Queue[Arrived], item: Arrived) -> None:
    """Hand over from zenoh's thread without waiting: a reader that does not keep up loses the oldest."""
    while True:
        try:
            arrived.put_nowait(item)
        except queue.Full:
            try:
                arrived.get_nowait()
            except queue.Empty:
                continue
        else:
            return
