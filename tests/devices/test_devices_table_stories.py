"""Any order of events: what the device table promises whatever happens."""

from __future__ import annotations

from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from table_world import Home

from vad.devices.device import Change, Device
from vad.devices.identity import is_random

MACS = (*(f"f4:f5:d8:00:00:0{k}" for k in range(3)), *(f"02:00:00:00:00:0{k}" for k in range(5)))
macs = st.sampled_from(MACS)


class TableStories(RuleBasedStateMachine):
    """Any order of events: addresses have one owner, what is told rebuilds the table, nothing leaks."""

    def __init__(self) -> None:
        super().__init__()
        self.home = Home(limit=5, names={MACS[0]: "lamp"}, ignore=[MACS[1]])
        self.mirror: dict[str, Device] = {}
        self.inside: set[tuple[str, str]] = set()

    def keep(self, changes: list[Change]) -> None:
        for change in changes:
            mac = change.device.mac
            if change.kind == "gone":
                del self.mirror[mac]
                assert change.into is None or change.into in self.mirror
            else:
                assert (change.kind == "new") == (mac not in self.mirror)
                self.mirror[mac] = change.device

    @rule(mac=macs, interface=st.sampled_from(["wlan0", "wlan1"]))
    def join(self, mac: str, interface: str) -> None:
        self.keep(self.home.join(mac, interface))
        if self.home.table.find(mac) is not None:
            self.inside.add((mac, interface))

    @rule(mac=macs, interface=st.sampled_from(["wlan0", "wlan1"]))
    def leave(self, mac: str, interface: str) -> None:
        self.keep(self.home.leave(mac, interface))
        self.inside.discard((mac, interface))

    @rule(
        mac=macs,
        name=st.sampled_from(["anna", "ben", "iphone"]),
        ip=st.sampled_from(["10.0.0.1", "10.0.0.2"]),
    )
    def tell(self, mac: str, name: str, ip: str) -> None:
        self.keep(self.home.tell(mac, host_name=name, ip=ip))

    @rule(minutes=st.integers(0, 20))
    def wait(self, minutes: int) -> None:
        self.keep(self.home.wait(minutes * 60 * 10**9))

    @precondition(lambda self: self.mirror)
    @rule(data=st.data(), ignored=st.none() | st.booleans(), name=st.none() | st.sampled_from(["", "x", "y"]))
    def change(self, data: st.DataObject, ignored: bool | None, name: str | None) -> None:
        mac = data.draw(st.sampled_from(sorted(self.mirror)))
        self.mirror[mac] = self.home.table.change(mac, ignored=ignored, name=name)

    @precondition(lambda self: self.mirror)
    @rule(data=st.data())
    def measure(self, data: st.DataObject) -> None:
        self.home.measured.add(data.draw(st.sampled_from(sorted(self.mirror))))

    @precondition(lambda self: self.mirror)
    @rule(data=st.data())
    def forget(self, data: st.DataObject) -> None:
        mac = data.draw(st.sampled_from(sorted(self.mirror)))
        self.home.measured.discard(mac)
        del self.mirror[self.home.table.forget(mac).mac]

    @invariant()
    def what_was_told_is_the_table(self) -> None:
        assert {device.mac: device for device in self.home.table.all()} == self.mirror
        assert len(self.mirror) <= 5

    @invariant()
    def addresses_have_one_owner(self) -> None:
        owned = [mac for device in self.mirror.values() for mac in device.macs]
        assert len(owned) == len(set(owned))
        assert all(device.mac in device.macs for device in self.mirror.values())
        ips = [device.ip for device in self.mirror.values() if device.ip is not None]
        assert len(ips) == len(set(ips))
        assert all(self.home.table.find(mac) is not None for mac in owned)

    @invariant()
    def who_is_in_is_known(self) -> None:
        for device in self.mirror.values():
            here = any((mac, wlan) in self.inside for mac in device.macs for wlan in ("wlan0", "wlan1"))
            assert self.home.table.in_network(device) == here

    @invariant()
    def nothing_real_was_joined_with_something_real(self) -> None:
        for device in self.mirror.values():
            assert len([mac for mac in device.macs if not is_random(mac)]) <= 2

    @invariant()
    def the_measured_are_kept(self) -> None:
        assert all(self.home.table.find(mac) is not None for mac in self.home.measured)


TestTableStories = TableStories.TestCase
