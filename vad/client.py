"""Asking a vad daemon: plain and typed, for the commands and for other programs.

with VadClient() as client:
    for device in client.devices(state="mapped"):
        print(device.mac, device.x_m, device.y_m, device.radius90_m)
"""

from __future__ import annotations

import queue
from collections.abc import Iterable, Iterator
from types import TracebackType
from typing import Self, TypeVar

import msgspec
import zenoh
from zenoh import handlers

from vad.bus import messages as m
from vad.bus.keys import HubKeys, parse_key
from vad.bus.selectors import device_selector
from vad.bus.session import DEFAULT_ENDPOINT, BusSettings, open_session
from vad.errors import ProtocolError, VadError

QUERY_TIMEOUT_S = 5.0
EVENT_POLL_S = 0.2
"""How soon a loop over events notices Ctrl-C."""
EVENT_BACKLOG = 1000

M = TypeVar("M", bound=m.Message)


class UnreachableError(VadError):
    """No daemon answers."""

    code = "unreachable"


class QueryError(VadError):
    """The daemon refused a question; `code` is its machine code, e.g. `bad_selector`."""

    def __init__(self, what: str, *, code: str, where: str = "", remedy: str = "") -> None:
        super().__init__(what, where=where, remedy=remedy)
        self.code = code


class VadClient:
    """A connection to a daemon; usable from one thread, reconnects by itself after a daemon's restart.

    Args:
        endpoint: the daemon's zenoh endpoint, on the loopback interface.
        hub: the hub's name; `*` asks whichever answers (two that answer a question for one is an error).
        timeout_s: how long one question may take.

    Raises:
        UnreachableError: nobody listens at the endpoint, or the daemon behind it is gone.
        QueryError: the daemon refused the question.
        ProtocolError: the answer is not of a kind this version reads.
    """

    def __init__(
        self, endpoint: str = DEFAULT_ENDPOINT, hub: str = "*", *, timeout_s: float = QUERY_TIMEOUT_S
    ) -> None:
        self.endpoint = endpoint
        self.keys = HubKeys(hub)
        self._timeout_s = timeout_s
        self._session: zenoh.Session | None = None

    def open(self) -> None:
        """Connect; UnreachableError where no router or no daemon is."""
        try:
            self._session = open_session(
                BusSettings(hub=self.keys.hub, mode="client", connect=(self.endpoint,))
            )
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
        parsed = [parse_key(str(reply.ok.key_expr)) for reply in replies if reply.ok is not None]
        return sorted({key.hub for key in parsed if key is not None})

    def devices(
        self,
        *,
        room: str | Iterable[str] = (),
        state: str | Iterable[str] = (),
        mac: str | Iterable[str] = (),
        max_sigma_m: float | None = None,
    ) -> list[m.DeviceMessage]:
        """Devices by MAC; each argument narrows, several values of one are alternatives."""
        selector = device_selector(
            rooms=_several(room), states=_several(state), macs=_several(mac), max_sigma_m=max_sigma_m
        )
        found = self._messages(self.keys.device(), m.DeviceMessage, selector.to_parameters())
        return sorted(found, key=lambda device: (device.mac, device.hub))

    def device(self, mac: str) -> m.DeviceMessage | None:
        """One device; None where the daemon does not know it."""
        return self._one(self.keys.device(mac), m.DeviceMessage)

    def heatmap(self, mac: str) -> m.HeatmapMessage | None:
        """A device's posterior (`vad.bus.messages.probabilities` reads it); None where there is none yet."""
        return self._one(self.keys.heatmap(mac), m.HeatmapMessage)

    def cameras(self) -> list[m.CameraMessage]:
        """The cameras by id."""
        found = self._messages(self.keys.camera(), m.CameraMessage)
        return sorted(found, key=lambda camera: (camera.id, camera.hub))

    def captures(self) -> list[m.CaptureMessage]:
        """The last capture sessions, the one that changed last at the end."""
        return sorted(
            self._messages(self.keys.capture(), m.CaptureMessage), key=lambda capture: capture.published_at
        )

    def map(self) -> m.MapMessage | None:
        """The floor plan's frame and rooms; None where the daemon has no map yet."""
        return self._one(self.keys.map, m.MapMessage)

    def grid_png(self) -> bytes | None:
        """The occupancy grid as PNG (`vad.bus.grid.png_to_grid` reads it); None where there is none."""
        found = self._ask(self.keys.grid)
        return self._single(list(found.values()), self.keys.grid)

    def status(self) -> m.StatusMessage | None:
        """The daemon's health; None where it has just started and said nothing yet."""
        return self._one(self.keys.status, m.StatusMessage)

    def events(self, timeout_s: float | None = None) -> Iterator[m.EventMessage]:
        """What happens from now on, until `timeout_s` passes without an event (None: for ever).

        The subscription stands when this returns. Raises UnreachableError when the daemon goes away.
        """
        session = self._connected()
        arrived: queue.Queue[bytes | None] = queue.Queue(EVENT_BACKLOG)

        def hand_over(sample: zenoh.Sample) -> None:
            _put_newest(arrived, sample.payload.to_bytes())

        def alive_changed(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.DELETE:
                _put_newest(arrived, None)

        subscriptions = (
            session.declare_subscriber(self.keys.events, handlers.Callback(hand_over, indirect=False)),
            session.liveliness().declare_subscriber(
                self.keys.alive, handlers.Callback(alive_changed, indirect=False)
            ),
        )
        if not self.hubs():
            raise self._unreachable()
        return self._events(arrived, subscriptions, timeout_s)

    def _events(
        self,
        arrived: queue.Queue[bytes | None],
        subscriptions: tuple[zenoh.Subscriber[None], ...],
        timeout_s: float | None,
    ) -> Iterator[m.EventMessage]:
        waited_s = 0.0
        try:
            while timeout_s is None or waited_s < timeout_s:
                wait_s = EVENT_POLL_S if timeout_s is None else min(EVENT_POLL_S, timeout_s - waited_s)
                try:
                    payload = arrived.get(timeout=wait_s)
                except queue.Empty:
                    waited_s += wait_s
                    continue
                if payload is None:
                    raise self._unreachable()
                waited_s = 0.0
                yield _decoded(payload, m.EventMessage, self.keys.events)
        finally:
            for subscription in subscriptions:
                subscription.undeclare()  # type: ignore[no-untyped-call]

    def _connected(self) -> zenoh.Session:
        if self._session is None:
            raise VadError("the client is not open", remedy="Use it in a with statement")
        return self._session

    def _unreachable(self) -> UnreachableError:
        which = "" if self.keys.hub == "*" else f" as hub {self.keys.hub!r}"
        return UnreachableError(
            f"no vad daemon answers at {self.endpoint}{which}",
            remedy="Start it (`vad run`, or `systemctl start vad`), or name its address with --endpoint",
        )

    def _ask(self, key: str, parameters: str = "") -> dict[str, bytes]:
        """Key -> payload of all that answer; an empty answer is believed only from a daemon that is alive."""
        selector = f"{key}?{parameters}" if parameters else key
        try:
            replies = self._connected().get(
                selector,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=self._timeout_s,
            )
            found: dict[str, bytes] = {}
            for reply in replies:
                if reply.ok is not None:
                    found[str(reply.ok.key_expr)] = reply.ok.payload.to_bytes()
                elif reply.err is not None:
                    raise self._refusal(reply.err.payload.to_bytes())
            if not found and not self.hubs():
                raise self._unreachable()
        except zenoh.ZError as error:
            raise VadError(f"the question failed: {error}", where=selector) from error
        return found

    def _refusal(self, payload: bytes) -> VadError:
        if payload == b"Timeout":
            return UnreachableError(
                f"the vad daemon at {self.endpoint} did not answer within {self._timeout_s:g} s",
                remedy="See what it is doing: `journalctl -u vad`",
            )
        try:
            refused = m.decode(payload, m.ErrorMessage)
        except msgspec.DecodeError:
            return ProtocolError(f"the daemon refused with {payload[:80]!r}", where=self.endpoint)
        return QueryError(refused.text, code=refused.code)

    def _messages(self, key: str, kind: type[M], parameters: str = "") -> list[M]:
        return [_decoded(payload, kind, at) for at, payload in self._ask(key, parameters).items()]

    def _one(self, key: str, kind: type[M]) -> M | None:
        return self._single(self._messages(key, kind), key)

    def _single(self, found: list[T], key: str) -> T | None:
        if len(found) > 1:
            raise VadError(
                f"{len(found)} hubs answer ({', '.join(self.hubs())})",
                where=key,
                remedy="Choose one with --hub",
            )
        return found[0] if found else None


T = TypeVar("T")


def _decoded(payload: bytes, kind: type[M], where: str) -> M:
    try:
        return m.decode(payload, kind)
    except msgspec.DecodeError as error:
        raise ProtocolError(
            f"the answer is not {m.schema_id(kind)}: {error}",
            where=where,
            remedy="Daemon and client are of different versions: update both",
        ) from error


def _several(value: str | Iterable[str]) -> Iterable[str]:
    return (value,) if isinstance(value, str) else value


def _put_newest(arrived: queue.Queue[bytes | None], item: bytes | None) -> None:
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
