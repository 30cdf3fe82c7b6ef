"""The device table: who is one device, who is not, and that nothing grows without bounds."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from table_world import Home

from vad.devices.device import MAX_MACS, Change, Device, bounded
from vad.devices.identity import GENERIC_NAMES, stable_client_id, telling_host_name
from vad.devices.table import APART_NS, MAX_TOLD, DeviceTable

LAMP, TV = "f4:f5:d8:00:00:01", "f4:f5:d8:00:00:02"
PHONE, PHONE_LATER, PHONE_AT_LAST = "02:00:00:00:00:0a", "06:00:00:00:00:0b", "0a:00:00:00:00:0c"
DUID = "ff:11:22:33:44:00:02:00:00:ab:11:01:02:03:04:05:06"


def test_who_joins_is_known_and_what_is_told_of_him_is_kept() -> None:
    home = Home(vendor_of={LAMP: "Google, Inc."}.get)
    (change,) = home.join(LAMP)
    lamp = change.device
    assert (change.kind, lamp.mac, lamp.vendor, lamp.random_mac) == ("new", LAMP, "Google, Inc.", False)
    assert home.table.in_network(lamp)
    (change,) = home.tell(LAMP, host_name="lamp", ip="192.168.1.20", client_id="01:" + LAMP)
    assert change == Change("changed", replace(lamp, host_name="lamp", ip="192.168.1.20"))
    assert home.tell(LAMP, host_name="lamp", ip="192.168.1.20") == []
    assert home.join(LAMP) == [], "told by two sources"
    (change,) = home.leave(LAMP)
    assert change.device.last_seen > lamp.last_seen
    assert not home.table.in_network(lamp)
    assert home.leave(LAMP) == []


def test_a_lease_that_was_there_before_the_station_counts() -> None:
    home = Home()
    assert home.tell(LAMP, host_name="lamp", ip="10.0.0.2") == []
    assert len(home.table) == 0
    (change,) = home.join(LAMP)
    assert (change.kind, change.device.host_name, change.device.ip) == ("new", "lamp", "10.0.0.2")


def test_on_two_interfaces_at_once_it_is_in_until_it_left_both() -> None:
    home = Home()
    home.join(LAMP, "wlan0")
    home.join(LAMP, "wlan1")
    home.leave(LAMP, "wlan0")
    device = home.table.find(LAMP)
    assert device is not None
    assert home.table.in_network(device)
    home.leave(LAMP, "wlan1")
    assert not home.table.in_network(device)


@pytest.mark.parametrize("identity", [{"host_name": "Annas-Phone"}, {"client_id": DUID}])
def test_a_phone_with_a_new_random_address_stays_one_device(identity: dict[str, str]) -> None:
    home = Home()
    home.join(PHONE)
    home.tell(PHONE, ip="10.0.0.5", **identity)
    home.measured.add(PHONE)
    home.leave(PHONE)
    (change,) = home.join(PHONE_LATER)
    assert change.kind == "new", "nobody knows yet"
    gone, merged = home.tell(PHONE_LATER, ip="10.0.0.6", **identity)
    assert (gone.kind, gone.device.mac, gone.into) == ("gone", PHONE_LATER, PHONE)
    phone = merged.device
    assert (merged.kind, phone.mac, phone.macs) == ("changed", PHONE, (PHONE, PHONE_LATER))
    assert (phone.current_mac, phone.ip) == (PHONE_LATER, "10.0.0.6")
    assert home.table.find(PHONE_LATER) == home.table.find(PHONE) == phone
    assert home.table.in_network(phone)
    # The lease of the address before is still in the file; it is not the phone's any more.
    assert home.tell(PHONE, ip="10.0.0.5", host_name="Annas-Phone") == []
    # Told before it joins, it is never two.
    home.leave(PHONE_LATER)
    home.tell(PHONE_AT_LAST, ip="10.0.0.7", **identity)
    (change,) = home.join(PHONE_AT_LAST)
    assert change.device.macs == (PHONE, PHONE_LATER, PHONE_AT_LAST)
    # It takes its first address again.
    home.leave(PHONE_AT_LAST)
    (change,) = home.join(PHONE)
    assert change.device.macs == (PHONE_LATER, PHONE_AT_LAST, PHONE)
    assert change.device.mac == PHONE


def test_an_access_point_that_lists_the_old_address_for_some_minutes() -> None:
    home = Home()
    home.join(PHONE)
    home.tell(PHONE, host_name="Annas-Phone")
    home.join(PHONE_LATER)  # without a farewell
    (change,) = home.tell(PHONE_LATER, host_name="Annas-Phone")
    assert change.kind == "changed", "two at the same time are two"
    home.now_ns += 300 * 10**9
    changes = {(change.kind, change.device.mac) for change in home.leave(PHONE)}
    assert changes == {("changed", PHONE), ("gone", PHONE_LATER)}
    assert home.known() == [(PHONE, PHONE_LATER)]


def test_two_phones_of_one_name_at_home_together_are_two_for_good() -> None:
    home = Home()
    for mac in (PHONE, PHONE_LATER):
        home.join(mac)
        home.tell(mac, host_name="Galaxy-S21")
    assert home.table.due_ns is not None
    changes = home.wait(APART_NS + 1)
    assert {(change.kind, change.device.shared) for change in changes} == {("changed", True)}
    assert home.table.due_ns is None
    home.leave(PHONE)
    home.leave(PHONE_LATER)
    home.join(PHONE_AT_LAST)
    home.tell(PHONE_AT_LAST, host_name="galaxy-s21")
    assert home.known() == [(PHONE,), (PHONE_LATER,), (PHONE_AT_LAST,)]


def test_two_phones_taken_for_one_are_taken_apart_when_both_are_in() -> None:
    home = Home()
    home.join(PHONE)
    home.tell(PHONE, host_name="Galaxy-S21", ip="10.0.0.5")
    home.measured.add(PHONE)
    home.leave(PHONE)
    home.join(PHONE_LATER)
    home.tell(PHONE_LATER, host_name="Galaxy-S21", ip="10.0.0.6")
    assert len(home.table) == 1
    home.join(PHONE)  # the first one comes home, the second one is still here
    assert len(home.table) == 1
    changes = {change.device.mac: change for change in home.wait(APART_NS)}
    assert changes[PHONE].device.macs == (PHONE,)
    assert (changes[PHONE].device.ip, changes[PHONE].device.moved) == ("10.0.0.5", True)
    other = changes[PHONE_LATER]
    assert (other.kind, other.device.macs, other.device.ip) == ("new", (PHONE_LATER,), "10.0.0.6")
    home.leave(PHONE)
    home.tell(PHONE_LATER, host_name="Galaxy-S21", ip="10.0.0.9")
    assert len(home.table) == 2


def two(first: str = PHONE, second: str = PHONE_LATER) -> Home:
    """Two addresses of one name, one after the other, that would be one device."""
    home = Home(names={TV: "tv", LAMP: None}, ignore=[PHONE_AT_LAST])
    home.join(first)
    home.tell(first, host_name="Annas-Phone")
    home.leave(first)
    home.join(second)
    return home


def test_what_is_one() -> None:
    for first, second in ((PHONE, PHONE_LATER), (PHONE, LAMP), ("f4:f5:d8:00:00:77", PHONE)):
        home = two(first, second)
        home.tell(second, host_name="annas-phone.lan")
        assert home.known() == [(first, second)]


def test_what_is_not_one() -> None:
    real = two("f4:f5:d8:00:00:77", "f4:f5:d8:00:00:78")
    real.tell("f4:f5:d8:00:00:78", host_name="Annas-Phone")
    assert len(real.table) == 2, "real addresses do not change"
    listed = two(TV, LAMP)
    listed.tell(LAMP, host_name="Annas-Phone")
    assert len(listed.table) == 2, "the settings list both"
    hidden = two(PHONE, PHONE_AT_LAST)
    hidden.tell(PHONE_AT_LAST, host_name="Annas-Phone")
    assert len(hidden.table) == 2, "what people see does not vanish into what is ignored"
    measured = two()
    measured.measured.add(PHONE_LATER)
    measured.tell(PHONE_LATER, host_name="Annas-Phone")
    assert len(measured.table) == 2, "its walks would be lost"
    named = two()
    named.table.change(PHONE, name="Anna's")
    named.table.change(PHONE_LATER, name="Ben's")
    named.tell(PHONE_LATER, host_name="Annas-Phone")
    assert len(named.table) == 2, "people know better"
    contrary = two()
    contrary.join(PHONE)
    contrary.tell(PHONE, client_id=DUID)
    contrary.leave(PHONE)
    contrary.tell(PHONE_LATER, client_id=DUID.replace("ab:11", "ab:12"))
    contrary.tell(PHONE_LATER, host_name="Annas-Phone")
    assert len(contrary.table) == 2, "two machines say who they are"
    for name in [*sorted(GENERIC_NAMES), "", "a"]:
        generic = Home()
        for mac in (PHONE, PHONE_LATER):
            generic.join(mac)
            generic.tell(mac, host_name=name.title())
            generic.leave(mac)
        assert len(generic.table) == 2, name


def test_an_address_belongs_to_one_device() -> None:
    home = Home()
    home.join(LAMP, ip="10.0.0.2")
    home.join(TV)
    changes = {change.device.mac: change.device.ip for change in home.tell(TV, ip="10.0.0.2")}
    assert changes == {LAMP: None, TV: "10.0.0.2"}


def test_names_and_what_is_ignored() -> None:
    home = Home(names={TV: "the big one"}, ignore=[PHONE.upper()])
    for mac in (TV, LAMP, PHONE):
        home.join(mac, host_name=f"host-{mac[-1]}")
    tv, lamp, phone = home.table.all()
    assert [home.table.name_of(one) for one in (tv, lamp)] == ["the big one", "host-1"]
    assert home.table.name_of(home.table.change(LAMP, name="lamp")) == "lamp"
    assert home.table.name_of(home.table.change(LAMP, name="")) == "host-1"
    assert home.table.ignores(phone)
    assert not home.table.ignores(lamp)
    assert home.table.ignores(home.table.change(LAMP, ignored=True))
    assert not home.table.ignores(home.table.change(LAMP, ignored=False))


def test_listed_devices_are_known_without_being_in() -> None:
    home = Home(names={LAMP: "lamp"})
    (change,) = home.listed(LAMP, ip="10.0.0.2")
    assert (change.kind, change.device.ip) == ("new", "10.0.0.2")
    assert not home.table.in_network(change.device)
    assert home.listed(LAMP, ip="10.0.0.2") == []


def test_an_agent_is_a_device_of_its_own() -> None:
    home = Home()
    home.join(PHONE, "agent lab", agent="lab", host_name="lab-pc")
    home.leave(PHONE, "agent lab")
    home.join(PHONE_LATER)
    home.tell(PHONE_LATER, host_name="lab-pc")
    assert len(home.table) == 2
    agent = home.table.find(PHONE)
    assert agent is not None
    assert agent.agent == "lab"


def test_what_was_forgotten_is_new() -> None:
    home = Home()
    home.join(LAMP)
    home.tell(LAMP, host_name="lamp", ip="10.0.0.2")
    assert home.table.forget(LAMP).host_name == "lamp"
    assert len(home.table) == 0
    (change,) = home.join(LAMP)
    assert (change.kind, change.device.host_name) == ("new", None)


def test_a_restart_brings_back_the_same() -> None:
    home = two()
    home.tell(PHONE_LATER, host_name="Annas-Phone", ip="10.0.0.6")
    home.table.change(PHONE, name="Anna's", moved=True)
    after = DeviceTable()
    for device in home.table.all():
        after.restore(device)
    assert after.all() == home.table.all()
    assert after.find(PHONE_LATER) == home.table.find(PHONE)
    stale = Device(PHONE_LATER, (PHONE_LATER,), "", "")
    after.restore(stale)
    assert after.all() == home.table.all(), "an address has one owner"


def calls(work: Callable[[], None]) -> int:
    """How many functions it calls: what it costs, in a unit that is the same on every machine."""
    count = 0

    def seen(_frame: object, event: str, _argument: object) -> None:
        nonlocal count
        count += event in ("call", "c_call")

    before = sys.getprofile()
    sys.setprofile(seen)
    try:
        work()
    finally:
        sys.setprofile(before)
    return count


def test_several_thousand_stations_do_no_harm() -> None:
    home = Home(limit=200)
    worth = [f"f4:f5:d8:00:01:{number:02x}" for number in range(50)]
    for mac in worth:
        home.join(mac)
        home.measured.add(mac)
        home.leave(mac)
    home.join(LAMP)  # in the network now

    def passes(numbers: range) -> None:
        for number in numbers:
            mac = f"02:00:00:01:{number >> 8:02x}:{number & 255:02x}"
            home.join(
                mac, host_name="Passer-By" if number % 2 else f"name-{number}", ip=f"10.0.{number % 99}.1"
            )
            home.leave(mac)
            home.tell(mac.replace("02:", "06:", 1), host_name=f"only-told-{number}")

    passes(range(1000))  # the table is full
    full = calls(lambda: passes(range(1000, 2000)))
    assert full < 3_000_000, "a few thousand for one who passes by"
    assert calls(lambda: passes(range(2000, 3000))) < 1.2 * full, "and no more for the ones after him"
    assert len(home.table) <= 200
    assert all(home.table.find(mac) for mac in (*worth, LAMP))
    assert len(home.table._told) <= MAX_TOLD
    assert len(home.table._present) == 1
    assert len(home.table._by_identity) <= 400
    assert not home.table._together


def test_a_table_full_of_what_is_worth_keeping_refuses_the_newcomer() -> None:
    home = Home(limit=2)
    home.join(LAMP)
    home.join(TV)
    assert home.join(PHONE) == []
    assert home.table.refused == 1
    home.leave(TV)
    gone, new = home.join(PHONE)
    assert (gone.kind, gone.device.mac, new.kind, new.device.mac) == ("gone", TV, "new", PHONE)


def test_the_addresses_of_a_device_are_bounded() -> None:
    macs = tuple(f"02:00:00:00:00:{number:02x}" for number in range(40))
    assert bounded(macs[:5], macs[0]) == macs[:5]
    kept = bounded(macs, macs[0])
    assert len(kept) == MAX_MACS
    assert (kept[0], kept[1:]) == (macs[0], macs[-MAX_MACS + 1 :])
    assert bounded(macs, macs[30]) == macs[-MAX_MACS:]


@pytest.mark.parametrize(
    ("client_id", "stable"),
    [
        (None, None),
        ("*", None),
        ("01:02:00:00:00:00:0a", None),  # its own address
        ("01:06:00:00:00:00:77", None),  # another random one
        ("01:f4:f5:d8:00:00:77", "01:f4:f5:d8:00:00:77"),  # the real address behind it
        (DUID, "ff:00:02:00:00:ab:11:01:02:03:04:05:06"),
        ("ff:99:99:99:99:00:02:00:00:ab:11:01:02:03:04:05:06", "ff:00:02:00:00:ab:11:01:02:03:04:05:06"),
        ("ff:00:00:00:0a:00:03:00:01:02:00:00:00:00:0a", None),  # a DUID made of its own address
        ("00:30:32:30:30:30:30:30:30:30:30:30:61", None),  # the same in letters
        ("00:61:62", None),
        ("nonsense", None),
    ],
)
def test_which_client_ids_outlive_the_address(client_id: str | None, stable: str | None) -> None:
    assert stable_client_id(client_id, PHONE) == stable


@given(st.text(max_size=20), st.text(alphabet="0123456789abcdef:*", max_size=40))
def test_identities_of_any_text(host_name: str, client_id: str) -> None:
    name = telling_host_name(host_name)
    assert name is None or (len(name) >= 3 and name not in GENERIC_NAMES)
    stable = stable_client_id(client_id, PHONE)
    assert stable is None or PHONE not in stable
