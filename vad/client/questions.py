"""What can be asked, and how an answer is read: shared by both clients. No I/O."""

from __future__ import annotations

import gc
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from vad.bus import messages as m
from vad.bus.grid import npy_to_heatmap
from vad.bus.keys import HubKeys, parse_key
from vad.bus.selectors import Bbox, DeviceQuestion, HistoryQuestion, device_selector, time_of
from vad.bus.session import is_tls
from vad.errors import ProtocolError, VadError

QUERY_TIMEOUT_S = 5.0

T = TypeVar("T")
M = TypeVar("M", bound=msgspec.Struct)

Payloads = Mapping[str, bytes]
"""Key -> payload of all that answered."""


class UnreachableError(VadError):
    """No daemon answers."""

    code = "unreachable"


class QueryError(VadError):
    """The daemon refused a question; `code` is its machine code, e.g. `bad_selector`."""

    def __init__(self, what: str, *, code: str, where: str = "", remedy: str = "") -> None:
        super().__init__(what, where=where, remedy=remedy)
        self.code = code


@dataclass(frozen=True, slots=True)
class Question(Generic[T]):
    """selector: key and parameters; read: the payloads that came -> the answer; payload: goes with it."""

    selector: str
    read: Callable[[Payloads], T]
    payload: bytes | None = None


class Questions:
    """Every question, for one hub or any (`*`)."""

    def __init__(self, keys: HubKeys) -> None:
        self._keys = keys

    def devices(
        self,
        room: str | Iterable[str] = (),
        state: str | Iterable[str] = (),
        mac: str | Iterable[str] = (),
        max_sigma_m: float | None = None,
        since: str | None = None,
        bbox: Bbox | None = None,
        at: str | None = None,
    ) -> Question[list[m.DeviceMessage]]:
        """Devices by MAC."""

        def read(found: Payloads) -> list[m.DeviceMessage]:
            with _uncollected():
                answers = [decoded(payload, m.DevicesMessage, key) for key, payload in found.items()]
            together = [device for answer in answers for device in answer.devices]
            return sorted(together, key=lambda device: (device.mac, device.hub))

        question = _device_question(room, state, mac, max_sigma_m, since, bbox, at)
        return Question(_selector(self._keys.devices, question.to_parameters()), read)

    def geojson(
        self,
        room: str | Iterable[str] = (),
        state: str | Iterable[str] = (),
        mac: str | Iterable[str] = (),
        max_sigma_m: float | None = None,
        since: str | None = None,
        bbox: Bbox | None = None,
        at: str | None = None,
    ) -> Question[dict[str, Any]]:
        """The same as a GeoJSON FeatureCollection."""

        def read(found: Payloads) -> dict[str, Any]:
            with _uncollected():
                answers = [_object(payload, key) for key, payload in found.items()]
            features = [feature for answer in answers for feature in answer["features"]]
            return {"type": "FeatureCollection", "features": features}

        question = _device_question(room, state, mac, max_sigma_m, since, bbox, at, form="geojson")
        return Question(_selector(self._keys.devices, question.to_parameters()), read)

    def device(self, mac: str, at: str | None = None) -> Question[m.DeviceMessage | None]:
        """One device, now or then."""
        parameters = "" if at is None else f"at={time_of('at', at)}"
        return self._one(self._keys.device(mac), m.DeviceMessage, parameters)

    def history(
        self, mac: str, since: str | None, until: str | None, limit: int
    ) -> Question[m.HistoryMessage | None]:
        """What was said of a device."""
        question = HistoryQuestion(
            None if since is None else time_of("since", since),
            None if until is None else time_of("until", until),
            limit,
        )
        return self._one(self._keys.history(mac), m.HistoryMessage, question.to_parameters())

    def heatmap(self, mac: str) -> Question[m.HeatmapMessage | None]:
        """A posterior as a message."""
        return self._one(self._keys.heatmap(mac), m.HeatmapMessage)

    def heatmap_bytes(self, mac: str, form: str) -> Question[bytes | None]:
        """A posterior as it is sent in a form of HEATMAP_FORMATS."""
        return self._bytes(_selector(self._keys.heatmap(mac), f"format={form}"))

    def heatmap_array(self, mac: str) -> Question[NDArray[np.float32] | None]:
        """A posterior as an array."""
        raw = self.heatmap_bytes(mac, "npy")

        def read(found: Payloads) -> NDArray[np.float32] | None:
            payload = raw.read(found)
            return None if payload is None else npy_to_heatmap(payload)

        return Question(raw.selector, read)

    def cameras(self) -> Question[list[m.CameraMessage]]:
        """The cameras by id."""
        return self._several(self._keys.camera(), m.CameraMessage, lambda camera: (camera.id, camera.hub))

    def captures(self) -> Question[list[m.CaptureMessage]]:
        """The last capture sessions."""
        return self._several(self._keys.capture(), m.CaptureMessage, lambda one: (one.published_at, one.hub))

    def wish(self, wish: m.DeviceWish) -> Question[m.WishReply]:
        """What a person wants of a device."""
        key = self._keys.wishes

        def read(found: Payloads) -> m.WishReply:
            payload = _single(found, key)
            if payload is None:
                raise ProtocolError(
                    "this daemon takes no wishes",
                    where=key,
                    remedy="If it is still starting, ask again; else bring vad up to date there",
                )
            return decoded(payload, m.WishReply, key)

        return Question(key, read, m.encode(wish))

    def map(self) -> Question[m.MapMessage | None]:
        """The floor plan's frame."""
        return self._one(self._keys.map, m.MapMessage)

    def grid_png(self) -> Question[bytes | None]:
        """The floor plan's picture."""
        return self._bytes(self._keys.grid)

    def status(self) -> Question[m.StatusMessage | None]:
        """The daemon's health."""
        return self._one(self._keys.status, m.StatusMessage)

    def recent_events(self, since: str | None) -> Question[list[m.EventMessage]]:
        """The last events, the newest first."""

        def read(found: Payloads) -> list[m.EventMessage]:
            answers = (decoded(payload, m.EventsMessage, key) for key, payload in found.items())
            together = [event for answer in answers for event in answer.events]
            return sorted(together, key=lambda event: event.published_at, reverse=True)

        parameters = "" if since is None else f"since={time_of('since', since)}"
        return Question(_selector(self._keys.events, parameters), read)

    def schemas(self) -> Question[dict[str, dict[str, Any]]]:
        """Schema id -> JSON Schema."""

        def read(found: Payloads) -> dict[str, dict[str, Any]]:
            return {key.rpartition("/")[2]: _object(payload, key) for key, payload in sorted(found.items())}

        return Question(self._keys.schema(), read)

    def _one(self, key: str, kind: type[M], parameters: str = "") -> Question[M | None]:
        def read(found: Payloads) -> M | None:
            payload = _single(found, key)
            return None if payload is None else decoded(payload, kind, key)

        return Question(_selector(key, parameters), read)

    def _several(self, key: str, kind: type[M], order: Callable[[M], tuple[str, str]]) -> Question[list[M]]:
        def read(found: Payloads) -> list[M]:
            return sorted((decoded(payload, kind, at) for at, payload in found.items()), key=order)

        return Question(key, read)

    def _bytes(self, selector: str) -> Question[bytes | None]:
        return Question(selector, lambda found: _single(found, selector))


@contextmanager
def _uncollected() -> Iterator[None]:
    """No garbage collection while thousands of small values are read: it finds none and takes longest."""
    wanted = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if wanted:
            gc.enable()


def decoded(payload: bytes, kind: type[M], where: str) -> M:
    """A message; ProtocolError where it is not of this kind."""
    try:
        return m.decode(payload, kind)
    except msgspec.DecodeError as error:
        raise ProtocolError(
            f"the answer is not {m.schema_id(kind)}: {error}",
            where=where,
            remedy="Daemon and client are of different versions: update both",
        ) from error


def refusal(payload: bytes, endpoint: str, timeout_s: float) -> VadError:
    """What an error reply says."""
    if payload == b"Timeout":
        return UnreachableError(
            f"the vad daemon at {endpoint} did not answer within {timeout_s:g} s",
            remedy="See what it is doing: `journalctl -u vad`",
        )
    try:
        refused = m.decode(payload, m.ErrorMessage)
    except msgspec.DecodeError:
        return ProtocolError(f"the daemon refused with {payload[:80]!r}", where=endpoint)
    return QueryError(refused.text, code=refused.code)


def unreachable(endpoint: str, hub: str) -> UnreachableError:
    """Nobody is there."""
    which = "" if hub == "*" else f" as hub {hub!r}"
    remedy = "Start it (`vad run`, or `systemctl start vad`), or name its address with --endpoint"
    if is_tls(endpoint):
        remedy = (
            "It may not run, or not let this certificate in, or not let it see the map: on the hub, "
            "`vad status` and `vad pki list` tell"
        )
    return UnreachableError(f"no vad daemon answers at {endpoint}{which}", remedy=remedy)


def hub_names(keys: Iterable[str]) -> list[str]:
    """The hubs that these keys belong to."""
    return sorted({parsed.hub for key in keys if (parsed := parse_key(key)) is not None})


def _device_question(
    room: str | Iterable[str],
    state: str | Iterable[str],
    mac: str | Iterable[str],
    max_sigma_m: float | None,
    since: str | None,
    bbox: Bbox | None,
    at: str | None,
    form: str = "json",
) -> DeviceQuestion:
    selector = device_selector(
        rooms=_each(room),
        states=_each(state),
        macs=_each(mac),
        max_sigma_m=max_sigma_m,
        since=since,
        bbox=bbox,
    )
    then = None if at is None else time_of("at", at)
    return DeviceQuestion(selector, then, "geojson" if form == "geojson" else "json")


def _each(value: str | Iterable[str]) -> Iterable[str]:
    return (value,) if isinstance(value, str) else value


def _selector(key: str, parameters: str) -> str:
    return f"{key}?{parameters}" if parameters else key


def _single(found: Payloads, where: str) -> bytes | None:
    if len(found) > 1:
        raise VadError(
            f"{len(found)} hubs answer ({', '.join(hub_names(found))})",
            where=where,
            remedy="Choose one with --hub",
        )
    return next(iter(found.values()), None)


def _object(payload: bytes, where: str) -> dict[str, Any]:
    try:
        found: dict[str, Any] = json.loads(payload)
    except ValueError as error:
        raise ProtocolError(f"the answer is not JSON: {error}", where=where) from error
    return found
