"""What the daemon published last: immutable snapshots, prepared so that an answer is a look-up.

The event loop replaces a table and never changes one, so that zenoh's threads read without a lock. A form
that few ask for (GeoJSON, a picture) is made at the first question and then kept beside the message.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import msgspec
import zenoh

from vad.bus import messages as m
from vad.bus.grid import heatmap_to_npy, heatmap_to_png
from vad.bus.keys import HubKeys
from vad.bus.selectors import Facts
from vad.wall import now_rfc3339

PNG_ENCODING = "image/png"
NPY_ENCODING = "application/octet-stream;npy"
GEOJSON_ENCODING = "application/geo+json"
EVENTS_KEPT = 256


@dataclass(frozen=True, slots=True)
class Form:
    """One way to send a value."""

    payload: bytes
    encoding: str


@dataclass(frozen=True, slots=True)
class Entry:
    """The last value of one key.

    plain: what makes it equal to another, without the time of publishing; facts: what selectors look at,
    devices only. forms: other ways to send it, by name, made when first asked for.
    """

    key: zenoh.KeyExpr
    form: Form
    plain: bytes
    facts: Facts | None = None
    forms: dict[str, Form] = field(default_factory=dict, compare=False)

    def as_(self, name: str) -> Form:
        """The value in another form: geojson of a device, png or npy of a heatmap, json of any."""
        if name == "json":
            return self.form
        made = self.forms.get(name)
        if made is None:
            made = self.forms[name] = _FORMS[name](self)
        return made


Entries = Mapping[str, Entry]
NOTHING: Entries = MappingProxyType({})


def entry_of(key: str, message: m.Message, hub: str, now: str = "") -> Entry:
    """A message made ready to be sent. now: the time of publishing, RFC 3339; the present if left out."""
    now = now or now_rfc3339()
    plain = msgspec.structs.replace(message, hub=hub, published_at="")
    payload = m.encode(msgspec.structs.replace(plain, published_at=now))
    facts = None
    if isinstance(plain, m.DeviceMessage):
        facts = facts_of(plain, now)
    elif isinstance(plain, m.StatusMessage):
        plain = msgspec.structs.replace(plain, uptime_s=0.0)
    return Entry(zenoh.KeyExpr(key), Form(payload, m.encoding_of(type(message))), m.encode(plain), facts)


def raw_entry(key: str, payload: bytes, encoding: str) -> Entry:
    """A value that is no message: a picture, a schema."""
    return Entry(zenoh.KeyExpr(key), Form(payload, encoding), payload)


def facts_of(device: m.DeviceMessage, changed_at: str) -> Facts:
    """What selectors look at."""
    return Facts(device.mac, device.state, device.room, device.sigma_m, device.x_m, device.y_m, changed_at)


def collection(devices: Iterable[Entry], name: str, *, hub: str, source: m.Source) -> Form:
    """Devices in one answer, by MAC. name: `json` (DevicesMessage) or `geojson` (FeatureCollection)."""
    parts = b",".join(entry.as_(name).payload for entry in sorted(devices, key=lambda e: str(e.key)))
    if name == "geojson":
        return Form(b'{"type":"FeatureCollection","features":[' + parts + b"]}", GEOJSON_ENCODING)
    head = m.DevicesMessage(source=source, hub=hub, published_at=now_rfc3339(), devices=())
    empty = m.encode(head)
    assert empty.endswith(b'"devices":[]}')
    return Form(empty[:-2] + parts + b"]}", m.encoding_of(m.DevicesMessage))


def _geojson(entry: Entry) -> Form:
    """A Feature whose coordinates are metres of the map, not degrees; null where it has no place."""
    assert entry.facts is not None
    x_m, y_m = entry.facts.x_m, entry.facts.y_m
    place = None if x_m is None or y_m is None else {"type": "Point", "coordinates": [x_m, y_m]}
    head = json.dumps({"type": "Feature", "id": entry.facts.mac, "geometry": place})
    return Form(head[:-1].encode() + b',"properties":' + entry.form.payload + b"}", GEOJSON_ENCODING)


def _heatmap(entry: Entry) -> m.HeatmapMessage:
    return m.decode(entry.form.payload, m.HeatmapMessage)


_FORMS: dict[str, Callable[[Entry], Form]] = {
    "geojson": _geojson,
    "png": lambda entry: Form(heatmap_to_png(m.probabilities(_heatmap(entry))), PNG_ENCODING),
    "npy": lambda entry: Form(heatmap_to_npy(m.probabilities(_heatmap(entry))), NPY_ENCODING),
}


class Board:
    """All tables of one hub, by the key pattern that is asked with; changed on the event loop only."""

    def __init__(self, keys: HubKeys) -> None:
        self.keys = keys
        patterns = (keys.status, keys.map, keys.grid, keys.camera(), keys.device(), keys.heatmap())
        self.tables: dict[str, Entries] = dict.fromkeys((*patterns, keys.capture(), keys.schema()), NOTHING)
        self.events: tuple[tuple[str, bytes], ...] = ()
        self._together: tuple[Entries, dict[str, Form]] = (NOTHING, {})

    def put(self, pattern: str, entry: Entry) -> bool:
        """Replace a value; False where it says nothing new."""
        old = self.tables[pattern].get(str(entry.key))
        news = old is None or old.plain != entry.plain
        if news or pattern == self.keys.status:  # a question gets the uptime that was not worth a put
            self.tables[pattern] = MappingProxyType({**self.tables[pattern], str(entry.key): entry})
        return news

    def drop(self, pattern: str, key: str) -> bool:
        """Forget a value; False where there was none."""
        table = self.tables[pattern]
        if key not in table:
            return False
        self.tables[pattern] = MappingProxyType({k: v for k, v in table.items() if k != key})
        return True

    def keep_last(self, pattern: str, count: int) -> None:
        """Forget the oldest of more than `count` values."""
        kept = list(self.tables[pattern].items())[-count:]
        self.tables[pattern] = MappingProxyType(dict(kept))

    def tell(self, event: Entry, at: str) -> None:
        """Remember an event, published at this time, among the last EVENTS_KEPT, the newest first."""
        self.events = ((at, event.form.payload), *self.events[: EVENTS_KEPT - 1])

    def all_devices(self, name: str, source: m.Source) -> Form:
        """Every device in one answer, prepared at the first question after a change."""
        table = self.tables[self.keys.device()]
        of, forms = self._together
        if of is not table:
            forms = {}
            self._together = (table, forms)
        made = forms.get(name)
        if made is None:
            made = forms[name] = collection(table.values(), name, hub=self.keys.hub, source=source)
        return made
