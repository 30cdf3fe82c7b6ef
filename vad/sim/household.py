"""A simulated household: one home with many devices, and everybody's comings and goings for some days.

Everything follows from the seed. Times are seconds since the first midnight (`t_s`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vad.csi.attribution import Attribution
from vad.csi.logfile import LogReader
from vad.csi.packets import CsiBatch
from vad.mac import mac_from_text
from vad.robot.floor_plan import FloorPlan, Room
from vad.sim.home import floor_plan
from vad.sim.radio import Radio, RadioBatch
from vad.sim.scenario import Scenario, Walk, make_home

FloatArray = NDArray[np.float64]

DAY_S = 86_400.0
_PACKET = (
    "t_s",
    "csi",
    "rssi",
    "noise_dbm",
    "agc",
    "antenna_sel",
    "rate",
    "bfee_count",
    "nic_us",
    "mac",
)
_NAMES = (
    "lamp",
    "tv",
    "speaker",
    "printer",
    "thermostat",
    "doorbell",
    "heater",
    "kettle",
    "laptop",
    "plug",
    "scale",
    "frame",
)
_HOURS = (
    (6.8, 7.6, 12.4, 17.9, 19.2, 21.8),
    (8.1, 13.3, 16.9, 18.6, 20.6, 22.6),
)
"""When each of the two people usually crosses the room, hours of the day."""
_JITTER_H = 0.2
_VISIT_H = (18.0, 21.0)
_HEIGHTS_M = (1.82, 1.66)
_NEAREST_M = 1.5
_APART_M = 0.5
_WALL_M = 0.3
_BEHIND_M = (0.5, 1.4)


@dataclass(frozen=True, slots=True)
class HomeDevice:
    """One device. places_m: (from t_s on, (x, y, z)), the first from its beginning; sends_by_itself: at the
    rate of a busy device; answers: echo requests bring packets; else it is never heard."""

    mac: str
    name: str
    joined_s: float
    places_m: tuple[tuple[float, tuple[float, float, float]], ...]
    sends_by_itself: bool = False
    answers: bool = True

    def place_m(self, t_s: float) -> tuple[float, float, float]:
        """Where it stands at t_s."""
        return [place for since_s, place in self.places_m if since_s <= t_s][-1]


@dataclass(frozen=True, slots=True)
class Visit:
    """Somebody's way through the room. who: 0 or 1; with_visitor: a second person walks along, from
    `visitor_after_s` on."""

    walk: Walk
    who: int
    with_visitor: bool = False
    visitor_after_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Household:
    """home: the scenario behind it, for any one device; plan: with four rooms."""

    home: Scenario
    plan: FloorPlan
    devices: tuple[HomeDevice, ...]
    visits: tuple[Visit, ...]

    def scenario_of(self, device: HomeDevice, visit: Visit) -> Scenario:
        """The home as the radio simulator takes it: this device, where it is during this visit."""
        start_s = visit.walk.start_s
        return replace(
            self.home,
            device_m=device.place_m(start_s),
            device_mac=device.mac,
            join_s=0.0,
            walks=(visit.walk,),
        )

    def room_of(self, device: HomeDevice, t_s: float) -> str | None:
        """The room in which the device stands at t_s."""
        x_m, y_m, _ = device.place_m(t_s)
        return self.plan.room_at(x_m, y_m)


def make_household(
    seed: int,
    *,
    days: int = 7,
    devices: int = 12,
    moved_after_s: float = DAY_S,
    joined_within_s: float = 1.5 * DAY_S,
) -> Household:
    """A home of four rooms with 3 to 12 devices.

    Half of them send by themselves, the last one never answers, the third is carried into another room at
    `moved_after_s`. They join one after the other from six in the morning of the first day on, all
    `joined_within_s`. Two people walk at different times; on the third and the last day a visitor comes
    along in the evening.
    """
    rng = np.random.default_rng([seed, 0x40_0E])
    home = make_home(seed, walks=days * sum(map(len, _HOURS)))
    plan = _plan(home)
    places = _places(home, devices + 1, rng)
    listed = []
    for number in range(devices):
        where = [(0.0, places[number])]
        if number == 2:
            where.append((moved_after_s, _elsewhere(plan, places[number], places[devices:], rng)))
        listed.append(
            HomeDevice(
                f"f4:f5:d8:{seed & 0xFF:02x}:00:{number + 1:02x}",
                _NAMES[number],
                6.0 * 3600 + joined_within_s * (number / devices) ** 2,
                tuple(where),
                sends_by_itself=number % 2 == 0 and number != devices - 1,
                answers=number != devices - 1,
            )
        )
    return Household(home, plan, tuple(listed), _visits(home, days, rng))


def _plan(home: Scenario) -> FloorPlan:
    """The home's plan with four rooms: two share the room that the camera sees, two lie behind its wall."""
    plan = floor_plan(home)
    x0, y0, x1, y1 = home.plan_m
    wall_x, middle_y = home.room_m[2], (y0 + y1) / 2
    corners = {
        "Living room": (x0, y0, wall_x, middle_y),
        "Kitchen": (x0, middle_y, wall_x, y1),
        "Study": (wall_x, y0, x1, middle_y),
        "Bedroom": (wall_x, middle_y, x1, y1),
    }
    rooms = tuple(
        Room(name, np.array([[a, b], [c, b], [c, d], [a, d]])) for name, (a, b, c, d) in corners.items()
    )
    return replace(plan, rooms=rooms)


def _places(home: Scenario, count: int, rng: np.random.Generator) -> list[tuple[float, float, float]]:
    """By the walls of the room or behind the one to the next rooms, apart from each other and the hub."""
    x0, y0, x1, y1 = home.room_m
    found: list[tuple[float, float, float]] = []
    while len(found) < count:
        side = len(found) % 4
        x, y = rng.uniform(x0 + 0.5, x1 - 0.5), rng.uniform(y0 + 0.5, y1 - 0.5)
        x, y = (
            (x, y1 - _WALL_M),
            (x1 - _WALL_M, y),
            (x, y0 + _WALL_M),
            (x1 + rng.uniform(*_BEHIND_M), y),
        )[side]
        near_split = abs(y - (y0 + y1) / 2) < _APART_M
        near_hub = np.hypot(x - home.anchor_m[0], y - home.anchor_m[1]) < _NEAREST_M
        crowded = any(np.hypot(x - a, y - b) < _APART_M for a, b, _ in found)
        if not (near_split or near_hub or crowded):
            found.append((float(x), float(y), float(rng.uniform(0.4, 1.4))))
    return found


def _elsewhere(
    plan: FloorPlan,
    old: tuple[float, float, float],
    candidates: list[tuple[float, float, float]],
    rng: np.random.Generator,
) -> tuple[float, float, float]:
    """A place in another room than `old`, of the candidates or mirrored from `old`."""
    room = plan.room_at(old[0], old[1])
    for place in candidates:
        if plan.room_at(place[0], place[1]) != room:
            return place
    _, y0, _, y1 = plan.bounds_m
    return old[0], y0 + y1 - old[1], float(rng.uniform(0.4, 1.4))


def _visits(home: Scenario, days: int, rng: np.random.Generator) -> tuple[Visit, ...]:
    """Every crossing of the room, in order of time; no two at once but where the visitor comes along."""
    visits = []
    paths = iter(home.walks)
    for day in range(days):
        guest_today = day in (2, days - 1)
        for who, hours in enumerate(_HOURS):
            for hour in hours:
                at_h = hour + rng.uniform(-_JITTER_H, _JITTER_H)
                walk = replace(next(paths), start_s=day * DAY_S + at_h * 3600, height_m=_HEIGHTS_M[who])
                along = guest_today and _VISIT_H[0] <= at_h <= _VISIT_H[1]
                after_s = float(rng.choice([0.0, 9.0])) if along else 0.0
                visits.append(Visit(walk, who, along, after_s))
    return tuple(sorted(visits, key=lambda visit: visit.walk.start_s))


def hear(
    household: Household, visit: Visit, rates: Mapping[str, float], from_s: float, to_s: float
) -> CsiBatch:
    """What the hub's card gives from from_s to to_s of the visit, of all the named devices together.

    rates: MAC -> packets per second. Arrivals are on the household's timeline, in ns.
    """
    parts, radio = [], None
    for device in household.devices:
        if device.mac not in rates:
            continue
        number = int(device.mac[-2:], 16)
        radio = Radio(
            household.scenario_of(device, visit),
            packets_per_s=rates[device.mac],
            seed=household.home.seed * 100 + number,
        )
        heard = radio.generate(from_s, to_s)
        mine = np.flatnonzero(heard.mac == mac_from_text(device.mac))
        parts.append({name: getattr(heard, name)[mine] for name in _PACKET})
    assert radio is not None, "nobody is heard"
    joined = {name: np.concatenate([part[name] for part in parts]) for name in _PACKET}
    order = np.argsort(joined["t_s"], kind="stable")
    packets = {name: values[order] for name, values in joined.items()}
    # One card hears them all: one clock, one count.
    packets["nic_us"] = (np.rint(packets["t_s"] * 1e6).astype(np.int64) & 0xFFFF_FFFF).astype(np.uint32)
    packets["bfee_count"] = (np.arange(len(order)) & 0xFFFF).astype(np.uint16)
    batch = RadioBatch(**packets, legacy_t_s=np.empty(0), legacy_frames=())
    read = LogReader(Attribution()).feed(b"".join(data for _, data in radio.log_bytes(batch)))
    arrival_ns = np.rint(batch.t_s * 1e9).astype(np.int64)
    return replace(read, packets=replace(read.packets, arrival_ns=arrival_ns))
