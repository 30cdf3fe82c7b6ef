"""A short form of tools/bench week: one day, four devices, the same people; what follows from the seed."""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from vad.mac import mac_from_text
from vad.sim.household import DAY_S, hear, make_household

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

from bench_week import rows_of
from bench_week_sim import simulate

HOUSE = make_household(3)


def test_a_household_follows_from_its_seed() -> None:
    again = make_household(3)
    assert again.devices == HOUSE.devices
    assert [v.walk.start_s for v in again.visits] == [v.walk.start_s for v in HOUSE.visits]
    assert make_household(4).devices != HOUSE.devices


def test_two_people_walk_at_different_times_and_a_visitor_comes_along() -> None:
    visits = HOUSE.visits
    assert len(visits) == 84
    assert {v.who for v in visits} == {0, 1}
    assert {v.walk.height_m for v in visits} == {1.66, 1.82}
    ends = np.array([v.walk.end_s for v in visits[:-1]])
    assert np.all(ends < [v.walk.start_s for v in visits[1:]])
    assert {int(v.walk.start_s // DAY_S) for v in visits if v.with_visitor} == {2, 6}


def test_its_devices_stand_in_rooms_and_one_is_carried_elsewhere() -> None:
    rooms = [HOUSE.room_of(device, 0.0) for device in HOUSE.devices]
    assert None not in rooms
    assert len(set(rooms)) == 4
    (moved,) = [d for d in HOUSE.devices if len(d.places_m) > 1]
    assert HOUSE.room_of(moved, DAY_S - 1) != HOUSE.room_of(moved, DAY_S)
    assert [d.name for d in HOUSE.devices if not d.answers] == ["frame"]


def test_one_card_hears_all_devices() -> None:
    one, two = HOUSE.devices[0].mac, HOUSE.devices[3].mac
    visit = HOUSE.visits[5]
    start_s = visit.walk.start_s
    packets = hear(HOUSE, visit, {one: 200.0, two: 100.0}, start_s + 2, start_s + 6).packets
    macs, counts = np.unique(packets.mac, return_counts=True)
    heard = dict(zip(macs.tolist(), counts.tolist(), strict=True))
    assert heard[mac_from_text(one)] == pytest.approx(800, rel=0.1)
    assert heard[mac_from_text(two)] == pytest.approx(400, rel=0.1)
    assert np.all(np.diff(packets.arrival_ns) > 0)
    assert start_s + 2 <= packets.arrival_ns[0] / 1e9 < packets.arrival_ns[-1] / 1e9 < start_s + 6


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_day_of_the_week() -> None:
    """Every reachable device in its room, the moved one noticed, the mute one explained, a story told."""
    week = simulate(3, days=1, devices=4, moved_after_s=DAY_S / 2, joined_within_s=1800.0)
    rows = {row.name: row for row in rows_of(week)}
    assert set(rows) == {"lamp", "tv", "speaker", "printer"}
    for row in rows.values():
        assert row.right, row
    assert not rows["printer"].answers, "the last one is the mute one"
    assert rows["speaker"].moved_h is not None
    assert rows["speaker"].moved_h < 10
    assert [name for name, row in rows.items() if row.moved_h is not None] == ["speaker"]
    story = [decision.text for decision in week.decisions]
    for words in (
        "lamp joined the network",
        "somebody walks alone: measuring lamp (new)",
        "lamp: mapped, ",
        "2 people walk: waiting until one of them walks alone",
        "speaker was moved, from ",
        "printer waits: it is not heard at all",
    ):
        assert any(words in line for line in story), words
    assert all(a != b for a, b in pairwise(story)), "nothing is said twice in a row"
