"""Who is measured when: values in, a decision and its reason out. No clock of its own, no I/O.

New devices come before those whose map is gone, these before those that are not sharp yet, and these before
mapped ones, which are looked at now and then to see whether they still are where they were. Within one kind
the device with the fewest walks comes first, then the one measured longest ago.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

Kind = Literal["new", "doubted", "stale", "sharpen", "check", "done"]

MIN_PACKETS_PER_S = 60.0
GOOD_PACKETS_PER_S = 100.0
"""A device that sends so much by itself is not asked for more."""
ANSWER_NS = 2_500_000_000
"""A device that was made to send shows packets within this time, or it does not answer."""
RETRY_FIRST_NS = 60 * 1_000_000_000
RETRY_LAST_NS = 6 * 3600 * 1_000_000_000
RETRY_BLURRED_NS = 3600 * 1_000_000_000
"""First pause of a device that many walks did not make sharp; it doubles, too."""
FRUITLESS = 3
"""After so many walks in a row that told nothing of it, a device goes before others no more."""
FREE_CHECK_NS = 3 * 3600 * 1_000_000_000
"""A mapped device that sends by itself is measured again this often: it costs no airtime."""

NO_CALIBRATION = "the camera does not know yet where it is"
NOBODY = "waiting for somebody to walk through the picture"
ALL_MAPPED = "watching: every device is mapped; they are looked at again when somebody walks"
TOO_FEW = "too few CSI packets of it are heard"
NO_AIRTIME = "the airtime for provoked packets is used up for now, and it does not send by itself"
SILENT = "it was asked for packets and sent none that carry CSI"

_RANK: dict[Kind, int] = {"new": 0, "doubted": 1, "stale": 1, "sharpen": 2, "check": 3, "done": 9}


@dataclass(frozen=True, slots=True)
class Limits:
    """together: devices measured in one walk at most; recheck_ns: a mapped device is measured again after
    this long, 0 = never."""

    together: int = 3
    recheck_ns: int = 24 * 3600 * 1_000_000_000


@dataclass(frozen=True, slots=True)
class Candidate:
    """One device as the scheduler sees it.

    state: of its record; walks: in its map; doubted: its last walk contradicts its map; heard_per_s: CSI
    packets now; reaches: it can be made to send; why_unheard: the reason where it gives no CSI; wish: what
    another walk would be good for; measured_ago_ns: how long its last walk is past, as an earlier run knew
    it; that counts when the device is first met.
    """

    mac: str
    name: str
    state: str
    walks: int = 0
    doubted: bool = False
    heard_per_s: float = 0.0
    reaches: bool = False
    why_unheard: str = ""
    wish: str = NOBODY
    measured_ago_ns: int = 0

    @property
    def heard(self) -> bool:
        """Whether it can be measured as it sends now."""
        return self.heard_per_s >= MIN_PACKETS_PER_S


@dataclass(frozen=True, slots=True)
class View:
    """What the camera tells. calibrating: empty where it knows its place; movers: tracks of all who move."""

    calibrating: str
    movers: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Decision:
    """What to do now.

    record: the devices to measure in a walk that begins now, the most wanted first (empty: none);
    provoke: the devices to make send; track: the walker, where there is one alone; step: one sentence for
    people; waits: why each device that is wanted and not recorded waits.
    """

    step: str
    waits: Mapping[str, str]
    record: tuple[str, ...] = ()
    provoke: tuple[str, ...] = ()
    track: int | None = None


@dataclass(slots=True)
class _Book:
    """What the scheduler remembers of one device."""

    since_ns: int
    measured_ns: int | None = None
    tried_ns: int = 0
    fruitless: int = 0
    not_before_ns: int = 0
    pause_ns: int = 0
    failure: str = ""
    asked_ns: int | None = None
    look_again: bool = False


@dataclass(slots=True)
class Schedule:
    """The policy with its memory of tries; what it forgets at a restart costs a try, no knowledge."""

    limits: Limits = field(default_factory=Limits)
    _books: dict[str, _Book] = field(default_factory=dict)

    def decide(
        self, now_ns: int, devices: Sequence[Candidate], view: View, *, airtime: bool = True
    ) -> Decision:
        """What to do now. airtime: whether the budget allows to make devices send in another walk."""
        self._meet(now_ns, devices)
        decision = self._decide(now_ns, devices, view, airtime=airtime)
        for mac, book in self._books.items():
            if mac not in decision.provoke or mac in decision.record:
                book.asked_ns = None  # it was not asked without a break
        return decision

    def kind(self, now_ns: int, device: Candidate) -> Kind:
        """Why the device would be measured; `done` where it would not."""
        if device.doubted:
            return "doubted"
        if device.state == "stale":
            return "stale"
        if device.state == "mapped":
            return "check" if self._check_due(now_ns, device) else "done"
        return "sharpen" if device.walks else "new"

    def measured(self, now_ns: int, mac: str, *, blurred: bool = False) -> None:
        """A walk told something of the device; blurred: so many walks did not make it sharp."""
        book = self._book(now_ns, mac)
        book.measured_ns = book.tried_ns = now_ns
        book.fruitless, book.look_again, book.failure = 0, False, ""
        book.pause_ns = min(max(2 * book.pause_ns, RETRY_BLURRED_NS), 4 * RETRY_LAST_NS) if blurred else 0
        book.not_before_ns = now_ns + book.pause_ns

    def failed(self, now_ns: int, mac: str, reason: str, *, its_fault: bool) -> None:
        """A walk told nothing of the device; after its own faults the pause before the next try grows."""
        book = self._book(now_ns, mac)
        book.failure, book.tried_ns = reason, now_ns
        if not its_fault:
            book.fruitless += 1
        else:
            book.pause_ns = min(max(2 * book.pause_ns, RETRY_FIRST_NS), RETRY_LAST_NS)
            book.not_before_ns = now_ns + book.pause_ns
            book.failure = f"{reason}; the next try comes {_duration(book.pause_ns)} later"

    def look_again(self, now_ns: int, mac: str) -> None:
        """The device joined anew: it is due without a pause, for it may have been carried elsewhere.

        Some devices come and go all day: one that was measured within FREE_CHECK_NS is not looked at again.
        """
        book = self._book(now_ns, mac)
        book.look_again = book.measured_ns is None or now_ns - book.measured_ns > FREE_CHECK_NS
        book.pause_ns = book.not_before_ns = 0

    def _decide(self, now_ns: int, devices: Sequence[Candidate], view: View, *, airtime: bool) -> Decision:
        wanted = sorted(
            (d for d in devices if self.kind(now_ns, d) != "done"), key=lambda d: self._order(now_ns, d)
        )
        if view.calibrating:
            waits = {d.mac: NO_CALIBRATION for d in wanted}
            return Decision(f"calibrating the camera: {view.calibrating}", waits)
        if not wanted:
            return Decision("watching: no device waits to be measured", {})
        waits = {d.mac: why for d in wanted if (why := self._hindrance(now_ns, d, airtime=airtime))}
        ready = [d for d in wanted if d.mac not in waits]
        if not ready:
            return Decision("waiting for CSI packets of a device", waits)
        if len(view.movers) != 1:
            step = NOBODY if any(d.state != "mapped" for d in wanted) else ALL_MAPPED
            if view.movers:
                step = f"{len(view.movers)} people walk: waiting until one of them walks alone"
            for device in ready:
                waits[device.mac] = self._wish(device) if not view.movers else step
            return Decision(step, waits)
        return self._with_walker(now_ns, ready, waits, view.movers[0])

    def _with_walker(
        self,
        now_ns: int,
        ready: list[Candidate],
        waits: dict[str, str],
        track: int,
    ) -> Decision:
        """Somebody walks alone: the most wanted devices together, as soon as their packets come."""
        group = ready[: self.limits.together]
        asked = {d.mac for d in group if self._book(now_ns, d.mac).asked_ns is not None}
        weak = [d for d in group if d.mac in asked or d.heard_per_s < GOOD_PACKETS_PER_S]
        provoke = tuple(d.mac for d in weak if d.reaches)
        missing = [d for d in group if not d.heard]
        for device in missing:
            book = self._book(now_ns, device.mac)
            book.asked_ns = now_ns if book.asked_ns is None else book.asked_ns
            if now_ns - book.asked_ns >= ANSWER_NS:
                self.failed(now_ns, device.mac, device.why_unheard or SILENT, its_fault=True)
                waits[device.mac] = book.failure
        missing = [d for d in missing if d.mac not in waits]
        for device in ready:
            waits.setdefault(device.mac, self._wish(device))
        names = ", ".join(d.name for d in group)
        if missing:
            step = f"somebody walks alone: asking {', '.join(d.name for d in missing)} for packets"
            return Decision(step, waits, provoke=provoke, track=track)
        chosen = [d for d in group if d.heard]
        if not chosen:
            return Decision(f"{names} did not answer", waits)
        return Decision(
            f"somebody walks alone: measuring {self._reasons(now_ns, chosen)}",
            {mac: why for mac, why in waits.items() if mac not in {d.mac for d in chosen}},
            tuple(d.mac for d in chosen),
            tuple(mac for mac in provoke if mac in {d.mac for d in chosen}),
            track,
        )

    def _reasons(self, now_ns: int, chosen: list[Candidate]) -> str:
        words = {
            "new": "new",
            "doubted": "its last walk contradicts the map",
            "stale": "its map is gone",
            "sharpen": "not sharp yet",
            "check": "still there?",
            "done": "still there?",
        }
        return ", ".join(f"{d.name} ({words[self.kind(now_ns, d)]})" for d in chosen)

    def _hindrance(self, now_ns: int, device: Candidate, *, airtime: bool) -> str:
        """Why the device cannot be measured even if somebody walked now; empty where it can."""
        book = self._book(now_ns, device.mac)
        if now_ns < book.not_before_ns:
            return book.failure or device.wish
        if device.heard:
            return ""
        if not device.reaches:
            return device.why_unheard or TOO_FEW
        return "" if airtime else NO_AIRTIME

    def _wish(self, device: Candidate) -> str:
        failure = self._books[device.mac].failure
        return f"{failure}; {device.wish}" if failure else device.wish

    def _order(self, now_ns: int, device: Candidate) -> tuple[int, int, int, int]:
        """The smaller goes first. A walk that told nothing counts as one: nobody holds up the others."""
        book = self._book(now_ns, device.mac)
        kind = self.kind(now_ns, device)
        walks = 0 if kind == "check" else device.walks
        rank = _RANK[kind]
        if book.fruitless >= FRUITLESS:
            rank = max(rank, _RANK["sharpen"])
        return rank, walks + book.fruitless, book.tried_ns, book.since_ns

    def _check_due(self, now_ns: int, device: Candidate) -> bool:
        if self._book(now_ns, device.mac).look_again:
            return True
        due_ns = min(self.limits.recheck_ns, FREE_CHECK_NS) if device.heard else self.limits.recheck_ns
        return 0 < due_ns <= self._age_ns(now_ns, device)

    def _age_ns(self, now_ns: int, device: Candidate) -> int:
        """How long ago the device was measured, as far as is remembered."""
        book = self._book(now_ns, device.mac)
        return now_ns - (book.since_ns if book.measured_ns is None else book.measured_ns)

    def _meet(self, now_ns: int, devices: Sequence[Candidate]) -> None:
        known = {device.mac for device in devices}
        self._books = {mac: book for mac, book in self._books.items() if mac in known}
        for device in devices:
            self._book(now_ns - device.measured_ago_ns, device.mac)

    def _book(self, now_ns: int, mac: str) -> _Book:
        return self._books.setdefault(mac, _Book(now_ns))


def _duration(ns: int) -> str:
    minutes = round(ns / 60e9)
    return f"{minutes} min" if minutes < 90 else f"{round(minutes / 60)} h"
