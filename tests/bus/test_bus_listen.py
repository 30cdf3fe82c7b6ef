"""Who listens on the bus inside the daemon hears what a client would see, in order and without asking."""

from __future__ import annotations

from bus_world import device, mac, settings

from vad.bus import messages as m
from vad.bus.board import Form
from vad.bus.node import Bus


def _status(uptime_s: float, step: str) -> m.StatusMessage:
    return m.StatusMessage(source="live", version="1", uptime_s=uptime_s, step=step)


async def test_a_listener_is_told_what_is_known_then_every_change(endpoint: str) -> None:
    heard: list[tuple[str, Form | None]] = []

    def hear(key: str, form: Form | None) -> None:
        heard.append((key, form))

    bus = Bus(settings(endpoint))
    bus.publish_device(device(0))
    end = bus.listen(hear)
    known = [key for key, _ in heard if "/schema/" not in key]
    assert known == [bus.keys.device(mac(0))]
    heard.clear()
    async with bus:
        heard.clear()  # the schemas are put when the bus opens
        bus.publish_status(_status(1.0, "waiting"))
        bus.publish_status(_status(2.0, "waiting"))  # nothing but time has passed
        bus.publish_grid(b"png")
        bus.publish_event(m.EventMessage(source="live", kind="joined", mac=mac(0), text="a lamp"))
        bus.forget_device(mac(0))
        bus.forget_device(mac(0))  # is forgotten already
        keys = bus.keys
        assert [key for key, _ in heard] == [keys.status, keys.grid, keys.events, keys.device(mac(0))]
        status, grid, _, gone = (form for _, form in heard)
        assert status is not None
        assert m.decode(status.payload, m.StatusMessage).step == "waiting"
        assert grid == Form(b"png", "image/png")
        assert gone is None
        end()
        bus.publish_status(_status(3.0, "capturing"))
        assert len(heard) == 4
