"""What a query may ask for: `?room=Kitchen|Hall;state=mapped;max_sigma_m=0.5;mac=..;since=..;bbox=..`.

zenoh hands parameters over as they are; so that a room may have any name, a value is percent-decoded here and
percent-encoded by `to_parameters`. `|` separates alternatives. Names that start with `_` are zenoh's own.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, get_args
from urllib.parse import quote, unquote

from vad.bus.messages import DeviceState
from vad.errors import VadError
from vad.mac import normal_mac
from vad.wall import normal_rfc3339

STATES: tuple[str, ...] = get_args(DeviceState)
MAX_LENGTH = 16384
"""Characters of a parameter string that are looked at; a longer one is refused."""
MAX_HISTORY = 1000
"""Entries of history in one answer."""

Bbox = tuple[float, float, float, float]
DEVICE_FORMATS = ("json", "geojson")
HEATMAP_FORMATS = ("json", "png", "npy")

_NARROWING = ("room", "state", "max_sigma_m", "mac", "since", "bbox")
_EXAMPLES = {
    "max_sigma_m": "metres, e.g. max_sigma_m=0.5",
    "since": "a time, e.g. since=2026-01-31T12:00:00Z",
    "at": "a time, e.g. at=2026-01-31T12:00:00Z",
    "until": "a time, e.g. until=2026-01-31T12:00:00Z",
    "bbox": "x0,y0,x1,y1 in metres of the map, e.g. bbox=0,0,4.5,3",
    "limit": f"a number from 1 to {MAX_HISTORY}",
}


class SelectorError(VadError):
    """A selector that cannot be used."""

    code = "bad_selector"


@dataclass(frozen=True, slots=True)
class Facts:
    """What selectors look at in a device. changed_at: when the daemon last published something new of it."""

    mac: str
    state: str
    room: str | None
    sigma_m: float | None
    x_m: float | None
    y_m: float | None
    changed_at: str


@dataclass(frozen=True, slots=True)
class DeviceSelector:
    """Which devices are wanted; an empty part asks for all.

    max_sigma_m: only devices whose standard deviation along the worst direction is at most this. since: only
    those of which something new was published after this time (`now_rfc3339` form). bbox: only those placed
    within x0, y0, x1, y1, edges included.
    """

    rooms: frozenset[str] = frozenset()
    states: frozenset[str] = frozenset()
    macs: frozenset[str] = frozenset()
    max_sigma_m: float | None = None
    since: str | None = None
    bbox: Bbox | None = None

    def wants(self, device: Facts) -> bool:
        """True where `device` is asked for."""
        if self.macs and device.mac not in self.macs:
            return False
        if self.states and device.state not in self.states:
            return False
        if self.rooms and device.room not in self.rooms:
            return False
        if self.since is not None and device.changed_at <= self.since:
            return False
        if self.max_sigma_m is not None and not (
            device.sigma_m is not None and device.sigma_m <= self.max_sigma_m
        ):
            return False
        return self.bbox is None or _inside(device, self.bbox)

    def to_parameters(self) -> str:
        """The parameter string that `parse_device_question` reads back; empty where all are wanted."""
        parts = [
            f"{name}={'|'.join(quote(value, safe=':') for value in sorted(values))}"
            for name, values in (("room", self.rooms), ("state", self.states), ("mac", self.macs))
            if values
        ]
        if self.max_sigma_m is not None:
            parts.append(f"max_sigma_m={self.max_sigma_m!r}")
        if self.since is not None:
            parts.append(f"since={self.since}")
        if self.bbox is not None:
            parts.append("bbox=" + ",".join(repr(side) for side in self.bbox))
        return ";".join(parts)


@dataclass(frozen=True, slots=True)
class DeviceQuestion:
    """A query on devices. at: as they were at this time (`now_rfc3339` form); None is now."""

    selector: DeviceSelector = DeviceSelector()
    at: str | None = None
    format: Literal["json", "geojson"] = "json"

    def to_parameters(self) -> str:
        """The parameter string that `parse_device_question` reads back."""
        parts = [
            self.selector.to_parameters(),
            "" if self.at is None else f"at={self.at}",
            "" if self.format == "json" else f"format={self.format}",
        ]
        return ";".join(part for part in parts if part)


@dataclass(frozen=True, slots=True)
class HistoryQuestion:
    """A query on a device's history: entries after `since`, up to `until`, the newest `limit` of them."""

    since: str | None = None
    until: str | None = None
    limit: int = 100

    def to_parameters(self) -> str:
        """The parameter string that `parse_history_question` reads back."""
        parts = [f"limit={self.limit}"]
        parts += [] if self.since is None else [f"since={self.since}"]
        parts += [] if self.until is None else [f"until={self.until}"]
        return ";".join(parts)


def device_selector(
    *,
    rooms: Iterable[str] = (),
    states: Iterable[str] = (),
    macs: Iterable[str] = (),
    max_sigma_m: float | None = None,
    since: str | None = None,
    bbox: Bbox | None = None,
) -> DeviceSelector:
    """A checked selector; SelectorError for an unknown state, a wrong MAC, time, box or a negative limit."""
    wanted = frozenset(states)
    if unknown := sorted(wanted - set(STATES)):
        raise SelectorError(
            f"{unknown[0]!r} is not a device state", where="state", remedy=f"Use one of {', '.join(STATES)}"
        )
    try:
        normal = frozenset(normal_mac(mac) for mac in macs)
    except VadError as error:
        raise SelectorError(error.what, where="mac", remedy=error.remedy) from error
    if max_sigma_m is not None and not (math.isfinite(max_sigma_m) and max_sigma_m >= 0):
        raise SelectorError(f"{max_sigma_m!r} is not a length in metres", where="max_sigma_m")
    if bbox is not None and not (all(map(math.isfinite, bbox)) and bbox[0] <= bbox[2] and bbox[1] <= bbox[3]):
        raise SelectorError("not a box: x0 <= x1 and y0 <= y1 are wanted", where="bbox")
    moment = None if since is None else time_of("since", since)
    return DeviceSelector(frozenset(rooms), wanted, normal, max_sigma_m, moment, bbox)


def time_of(name: str, text: str) -> str:
    """The time of selector `name` in the form of `now_rfc3339`; SelectorError where it is none."""
    try:
        return normal_rfc3339(text)
    except ValueError as error:
        raise SelectorError(str(error), where=name, remedy=f"Write {_EXAMPLES[name]}") from None


def parse_device_question(parameters: str) -> DeviceQuestion:
    """What a query on devices asks for; SelectorError for anything unknown or malformed."""
    given = _split(parameters, (*_NARROWING, "at", "format"))
    if "at" in given and "since" in given:
        raise SelectorError("at and since exclude each other", where="at")
    sigma_text, box_text = given.get("max_sigma_m"), given.get("bbox")
    box = None if box_text is None else [_number("bbox", side) for side in unquote(box_text).split(",")]
    if box is not None and len(box) != 4:
        raise SelectorError(f"{len(box)} numbers", where="bbox", remedy=f"Write {_EXAMPLES['bbox']}")
    selector = device_selector(
        rooms=_alternatives(given, "room"),
        states=_alternatives(given, "state"),
        macs=_alternatives(given, "mac"),
        max_sigma_m=None if sigma_text is None else _number("max_sigma_m", sigma_text),
        since=_time(given, "since"),
        bbox=None if box is None else (box[0], box[1], box[2], box[3]),
    )
    form = _format(given, DEVICE_FORMATS)
    return DeviceQuestion(selector, _time(given, "at"), "geojson" if form == "geojson" else "json")


def parse_heatmap_format(parameters: str) -> str:
    """The form in which a posterior is wanted, of HEATMAP_FORMATS; SelectorError for another one."""
    return _format(_split(parameters, ("format",)), HEATMAP_FORMATS)


def parse_event_question(parameters: str) -> str | None:
    """Events after which time are asked for (`now_rfc3339` form); None for all that are kept."""
    return _time(_split(parameters, ("since",)), "since")


def parse_history_question(parameters: str) -> HistoryQuestion:
    """What a query on a device's history asks for; SelectorError for anything unknown or malformed."""
    given = _split(parameters, ("since", "until", "limit"))
    limit = given.get("limit", "100")
    if not (limit.isdecimal() and len(limit) <= 4 and 1 <= int(limit) <= MAX_HISTORY):
        raise SelectorError(f"{limit[:40]!r} cannot be", where="limit", remedy=f"Give {_EXAMPLES['limit']}")
    return HistoryQuestion(_time(given, "since"), _time(given, "until"), int(limit))


def require_no_selector(parameters: str) -> None:
    """SelectorError where a key that takes no selectors is asked with one."""
    _split(parameters, ())


def _split(parameters: str, known: tuple[str, ...]) -> dict[str, str]:
    """`a=b;c=d` as a dict of still encoded values, zenoh's own names left out."""
    if len(parameters) > MAX_LENGTH:
        raise SelectorError(f"the selector is longer than {MAX_LENGTH} characters")
    found: dict[str, str] = {}
    for part in parameters.split(";"):
        name, equals, value = part.partition("=")
        if (not name and not equals) or name.startswith("_"):
            continue
        if name not in known:
            hint = f"This key knows {', '.join(known)}" if known else "This key takes no selectors"
            raise SelectorError(f"{name[:40]!r} is not a selector", remedy=hint)
        if not value:
            raise SelectorError("the selector has no value", where=name, remedy=f"Write {name}=...")
        if name in found:
            raise SelectorError("given twice", where=name, remedy="Separate alternatives with |")
        found[name] = value
    return found


def _alternatives(given: dict[str, str], name: str) -> list[str]:
    return [unquote(value) for value in given.get(name, "").split("|") if value]


def _time(given: dict[str, str], name: str) -> str | None:
    return time_of(name, unquote(given[name])) if name in given else None


def _number(name: str, text: str) -> float:
    try:
        return float(unquote(text))
    except ValueError:
        raise SelectorError(
            f"{text[:40]!r} is not a number", where=name, remedy=f"Write {_EXAMPLES[name]}"
        ) from None


def _format(given: dict[str, str], known: tuple[str, ...]) -> str:
    form = given.get("format", known[0])
    if form not in known:
        raise SelectorError(
            f"{form[:40]!r} is no form of this key", where="format", remedy=f"Use one of {', '.join(known)}"
        )
    return form


def _inside(device: Facts, bbox: Bbox) -> bool:
    if device.x_m is None or device.y_m is None:
        return False
    return bbox[0] <= device.x_m <= bbox[2] and bbox[1] <= device.y_m <= bbox[3]
