"""Who is measured when: the order, the reasons, the pauses, and that nobody starves."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from vad.capture import schedule as s
from vad.capture.schedule import Candidate, Limits, Schedule, View

S = 1_000_000_000
H = 3600 * S
LAMP, TV, PLUG, PRINTER = (f"f4:f5:d8:00:00:0{k}" for k in (1, 2, 3, 4))
WALKER = View("", (7,))
NOBODY = View("")


def device(mac: str, state: str = "waiting", *, heard: float = 400.0, **more: object) -> Candidate:
    """A device that sends by itself."""
    base = Candidate(mac, mac[-2:], state, heard_per_s=heard)
    return replace(base, **more)  # type: ignore[arg-type]


def test_new_before_stale_before_not_sharp_before_checks() -> None:
    book = Schedule(Limits(together=1))
    mapped = device(PRINTER, "mapped", walks=3)
    sharp = device(PLUG, walks=1)
    stale = device(TV, "stale", walks=5)
    new = device(LAMP, "discovered")
    devices = [mapped, sharp, stale, new]
    book.decide(0, devices, NOBODY)
    order = []
    for _ in range(4):
        (mac,) = book.decide(25 * H, devices, WALKER).record
        order.append(mac)
        devices = [d for d in devices if d.mac != mac]
    assert order == [LAMP, TV, PLUG, PRINTER]


def test_a_doubted_map_comes_before_sharpening() -> None:
    book = Schedule(Limits(together=1))
    doubted = device(TV, "mapped", walks=4, doubted=True)
    decision = book.decide(S, [device(PLUG, walks=1), doubted], WALKER)
    assert decision.record == (TV,)
    assert "contradicts the map" in decision.step


def test_several_devices_share_a_walk() -> None:
    book = Schedule(Limits(together=2))
    decision = book.decide(S, [device(mac) for mac in (LAMP, TV, PLUG)], WALKER)
    assert decision.record == (LAMP, TV)
    assert decision.track == 7
    assert decision.waits == {PLUG: s.NOBODY}
    assert decision.step == "somebody walks alone: measuring 01 (new), 02 (new)"


def test_a_mapped_device_that_sends_anyway_is_measured_more_often() -> None:
    book = Schedule(Limits(together=2))
    devices = [device(LAMP), device(TV, "mapped", walks=3)]
    book.decide(0, devices, NOBODY)
    assert book.decide(2 * H, devices, WALKER).record == (LAMP,)
    assert book.decide(3 * H, devices, WALKER).record == (LAMP, TV)
    book.measured(3 * H, TV)
    assert book.decide(4 * H, devices[1:], WALKER).record == ()
    decision = book.decide(6 * H, devices[1:], NOBODY)
    assert (decision.step, decision.record) == (s.ALL_MAPPED, ())
    assert book.decide(6 * H, devices[1:], WALKER).record == (TV,)


def test_nobody_and_several_people_are_reasons() -> None:
    book = Schedule()
    decision = book.decide(S, [device(LAMP)], NOBODY)
    assert (decision.step, decision.waits, decision.record) == (s.NOBODY, {LAMP: s.NOBODY}, ())
    decision = book.decide(S, [device(LAMP)], View("", (1, 2)))
    assert decision.step == "2 people walk: waiting until one of them walks alone"
    assert decision.waits == {LAMP: decision.step}
    assert decision.record == ()
    assert decision.track is None


def test_without_a_camera_everybody_waits_for_it() -> None:
    decision = Schedule().decide(S, [device(LAMP)], View("30 %, more of the drive is needed", (1,)))
    assert decision.step == "calibrating the camera: 30 %, more of the drive is needed"
    assert decision.waits == {LAMP: s.NO_CALIBRATION}
    assert decision.record == ()


def test_what_is_not_heard_says_why_and_hinders_nobody() -> None:
    book = Schedule(Limits(together=1))
    silent = device(LAMP, heard=0.0, why_unheard="its frames are encrypted")
    slow = device(TV, heard=20.0)
    decision = book.decide(S, [silent, slow, device(PLUG)], WALKER)
    assert decision.record == (PLUG,)
    assert decision.waits == {LAMP: "its frames are encrypted", TV: s.TOO_FEW}
    assert book.decide(S, [silent, slow], WALKER).step == "waiting for CSI packets of a device"


def test_a_device_is_asked_for_packets_and_measured_when_they_come() -> None:
    book = Schedule()
    quiet = device(LAMP, heard=0.0, reaches=True, why_unheard="not heard")
    decision = book.decide(0, [quiet], WALKER)
    assert (decision.record, decision.provoke) == ((), (LAMP,))
    assert decision.step == "somebody walks alone: asking 01 for packets"
    answered = replace(quiet, heard_per_s=200.0)
    decision = book.decide(S, [answered], WALKER)
    assert (decision.record, decision.provoke) == ((LAMP,), (LAMP,))


def test_who_sends_enough_by_itself_is_not_asked() -> None:
    busy, slow = (device(mac, heard=rate, reaches=True) for mac, rate in ((LAMP, 150.0), (TV, 70.0)))
    decision = Schedule().decide(0, [busy, slow], WALKER)
    assert decision.record == (LAMP, TV)
    assert decision.provoke == (TV,)


def test_a_mute_device_costs_a_moment_of_fewer_and_fewer_walks() -> None:
    """It is explained, and the device behind it is measured in the same walk."""
    book = Schedule(Limits(together=1))
    mute = device(LAMP, heard=0.0, reaches=True, why_unheard="it is not heard at all")
    other = device(TV, walks=1)
    asked = 0
    for walk in range(200):  # one every 10 minutes
        at = walk * 600 * S
        assert book.decide(at - S, [mute, other], NOBODY).record == ()
        first = book.decide(at, [mute, other], WALKER)
        if first.provoke == (LAMP,):
            asked += 1
            first = book.decide(at + s.ANSWER_NS, [mute, other], WALKER)
            assert first.waits[LAMP].startswith("it is not heard at all; the next try comes")
            first = book.decide(at + s.ANSWER_NS + S, [mute, other], WALKER)
        assert first.record == (TV,)
        assert first.provoke == ()
    assert 6 < asked < 16, "the pauses grow to six hours"


def test_the_pause_ends_when_it_joins_anew() -> None:
    book = Schedule()
    for _ in range(5):
        book.failed(0, LAMP, "80 packets/s are too few", its_fault=True)
    decision = book.decide(S, [device(LAMP)], WALKER)
    assert decision.waits == {LAMP: "80 packets/s are too few; the next try comes 16 min later"}
    book.look_again(2 * S, LAMP)
    assert book.decide(3 * S, [device(LAMP)], WALKER).record == (LAMP,)


def test_a_walker_that_leaves_is_not_the_devices_fault() -> None:
    book = Schedule()
    book.decide(0, [device(LAMP)], NOBODY)
    book.failed(0, LAMP, "the walker left", its_fault=False)
    assert book.decide(S, [device(LAMP)], NOBODY).waits == {LAMP: f"the walker left; {s.NOBODY}"}
    assert book.decide(S, [device(LAMP)], WALKER).record == (LAMP,)


def test_what_many_walks_did_not_make_sharp_is_tried_again_rarely() -> None:
    book, blurred = Schedule(), device(LAMP, "failed", walks=8, wish="walk elsewhere")
    book.decide(0, [blurred], NOBODY)
    book.measured(0, LAMP, blurred=True)
    assert book.decide(H // 2, [blurred], WALKER).waits == {LAMP: "walk elsewhere"}
    assert book.decide(H + S, [blurred], WALKER).record == (LAMP,)
    book.measured(H + S, LAMP, blurred=True)
    assert book.decide(2 * H + 2 * S, [blurred], WALKER).record == ()
    assert book.decide(3 * H + 2 * S, [blurred], WALKER).record == (LAMP,)


def test_a_mapped_device_is_looked_at_once_a_day() -> None:
    book, mapped = Schedule(Limits(recheck_ns=24 * H)), device(LAMP, "mapped", heard=0.0, reaches=True)
    assert book.decide(0, [mapped], WALKER).step == "watching: no device waits to be measured"
    assert book.decide(24 * H, [mapped], WALKER).provoke == (LAMP,)
    book.measured(24 * H, LAMP)
    assert book.decide(47 * H, [mapped], WALKER).provoke == ()
    book.look_again(24 * H + S, LAMP)
    assert book.decide(24 * H + S, [mapped], WALKER).provoke == (), "it comes and goes"
    book.look_again(47 * H, LAMP)
    assert book.decide(47 * H, [mapped], WALKER).provoke == (LAMP,)
    never = Schedule(Limits(recheck_ns=0))
    never.decide(0, [mapped], WALKER)
    assert never.decide(1000 * H, [mapped], WALKER).provoke == ()


def test_a_restart_every_night_does_not_put_the_check_off_for_ever() -> None:
    mapped = device(LAMP, "mapped", heard=0.0, reaches=True, walks=2, measured_ago_ns=23 * H)
    book = Schedule(Limits(recheck_ns=24 * H))
    assert book.decide(0, [mapped], WALKER).provoke == ()
    assert book.decide(H, [mapped], WALKER).provoke == (LAMP,)


def test_without_airtime_only_those_are_measured_that_send_by_themselves() -> None:
    quiet, busy = device(LAMP, heard=0.0, reaches=True), device(TV, walks=3)
    decision = Schedule().decide(S, [quiet, busy], WALKER, airtime=False)
    assert (decision.record, decision.provoke) == ((TV,), ())
    assert decision.waits == {LAMP: s.NO_AIRTIME}


@given(st.integers(2, 20), st.integers(1, 5), st.integers(0, 1000))
def test_many_devices_are_measured_alike(count: int, together: int, start: int) -> None:
    """Walks are shared out evenly, whatever was first."""
    book = Schedule(Limits(together=together))
    walks: Counter[str] = Counter()
    macs = [f"f4:f5:d8:00:01:{k:02x}" for k in range(count)]
    for walk in range(3 * count):
        now_ns = start + walk * 600 * S
        devices = [device(mac, walks=walks[mac]) for mac in macs]
        for mac in book.decide(now_ns, devices, WALKER).record:
            walks[mac] += 1
            book.measured(now_ns, mac)
    assert max(walks.values()) - min(walks[mac] for mac in macs) <= 1


def test_a_device_whose_walks_tell_nothing_does_not_hold_up_the_others() -> None:
    book, walks = Schedule(Limits(together=1)), Counter({LAMP: 0, TV: 1})
    for walk in range(20):
        (mac,) = book.decide(walk * H, [device(LAMP), device(TV, walks=walks[TV])], WALKER).record
        walks[mac] += 1
        if mac == LAMP:
            book.failed(walk * H, LAMP, "the walker left", its_fault=False)
        else:
            book.measured(walk * H, TV)
        assert walk > 2 or mac == LAMP, "new goes first"
    assert abs(walks[LAMP] - walks[TV]) <= 2


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["discovered", "waiting", "stale", "mapped", "failed", "capturing"]),
            st.integers(0, 9),
            st.sampled_from([0.0, 30.0, 200.0]),
            st.booleans(),
            st.booleans(),
        ),
        max_size=6,
    ),
    st.lists(st.tuples(st.integers(0, 7200), st.integers(0, 2), st.booleans()), min_size=1, max_size=20),
)
def test_whatever_happens_every_decision_is_sound(
    kinds: list[tuple[str, int, float, bool, bool]], moments: list[tuple[int, int, bool]]
) -> None:
    """Only known devices that are heard are recorded, with one walker; who is not recorded has a reason."""
    book = Schedule()
    devices = [
        Candidate(f"f4:f5:d8:00:02:{k:02x}", f"d{k}", state, walks, doubted, heard, reaches)
        for k, (state, walks, heard, reaches, doubted) in enumerate(kinds)
    ]
    now_ns = 0
    for pause_s, people, airtime in moments:
        now_ns += pause_s * S
        decision = book.decide(now_ns, devices, View("", tuple(range(people))), airtime=airtime)
        by_mac = {d.mac: d for d in devices}
        assert all(by_mac[mac].heard for mac in decision.record)
        assert not decision.record or people == 1
        assert not decision.provoke or (people == 1 and airtime) or decision.record
        assert all(decision.waits.values()), "an empty reason"
        assert decision.step
        wanted = {d.mac for d in devices if book.kind(now_ns, d) != "done"}
        assert wanted <= set(decision.record) | set(decision.waits)
        assert not set(decision.record) & set(decision.waits)
        for mac in decision.record:
            book.failed(now_ns, mac, "it went silent", its_fault=airtime)
