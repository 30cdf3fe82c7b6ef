"""What is announced to Home Assistant: device-based MQTT discovery (2024.11 and newer).

Source: Home Assistant's MQTT integration, its pages "MQTT discovery" and one for each platform. A device
tracker says whether its device is in the network (zone `home`, or none); its room is a sensor, because rooms
are no zones there. Home Assistant 2026.7 and newer read `in_zones`; the tracker's `state_topic` is on its way
out and not used.
"""

from __future__ import annotations

from typing import Any, get_args

import msgspec

from vad import __version__
from vad.bus import messages as m
from vad.homeassistant.states import plain
from vad.homeassistant.topics import Topics

Component = dict[str, Any]
_DIAGNOSTIC: Component = {"entity_category": "diagnostic"}
_METRES: Component = {
    "device_class": "distance",
    "state_class": "measurement",
    "unit_of_measurement": "m",
    "suggested_display_precision": 2,
} | _DIAGNOSTIC


def device_announcement(device: m.DeviceMessage, topics: Topics) -> bytes:
    """Discovery payload of a Wi-Fi device, for `topics.device_config`."""
    own_id = f"{topics.node}_{topics.device_id(device.mac)}"
    topic = topics.device(device.mac)

    def entity(key: str, platform: str, name: str | None, **more: Any) -> Component:
        return {"platform": platform, "unique_id": f"{own_id}_{key}", "name": name} | more

    def sensor(key: str, name: str, **more: Any) -> Component:
        template = _member(key)
        return entity(key, "sensor", name, state_topic=topic, value_template=template, **more)

    components = {
        # Nameless: it bears the device's own name.
        "tracker": entity(
            "tracker", "device_tracker", None, json_attributes_topic=topic, source_type="router"
        ),
        "room": sensor("room", "Room", icon="mdi:floor-plan", json_attributes_topic=topic),
        "mapping": sensor(
            "mapping",
            "Mapping",
            device_class="enum",
            options=list(get_args(m.DeviceState)),
            json_attributes_topic=topic,
            json_attributes_template="{{ {'reason': value_json.reason} | tojson }}",
            **_DIAGNOSTIC,
        ),
        "radius_90_m": sensor("radius_90_m", "Accuracy", icon="mdi:plus-minus-variant", **_METRES),
        "x_m": sensor("x_m", "X", icon="mdi:axis-x-arrow", enabled_by_default=False, **_METRES),
        "y_m": sensor("y_m", "Y", icon="mdi:axis-y-arrow", enabled_by_default=False, **_METRES),
        "last_seen": sensor("last_seen", "Last came or went", device_class="timestamp", **_DIAGNOSTIC),
    }
    about: Component = {
        "identifiers": [own_id],
        # the first and the present address: by these it is the device that a router's integration knows
        "connections": [["mac", mac] for mac in dict.fromkeys((device.mac, *device.macs[-1:]))],
        "name": plain(device.name) or device.mac,
        "via_device": topics.node,
    }
    if device.vendor:
        about["manufacturer"] = plain(device.vendor)
    return _announcement(about, components, topics)


def hub_announcement(camera: str, topics: Topics) -> bytes:
    """Discovery payload of the hub: map, health, its camera; for `topics.hub_config`."""

    def entity(key: str, platform: str, name: str, **more: Any) -> Component:
        return {"platform": platform, "unique_id": f"{topics.node}_{key}", "name": name} | more

    def of_status(key: str, platform: str, name: str, **more: Any) -> Component:
        template = _member(key)
        return entity(key, platform, name, state_topic=topics.status, value_template=template, **more)

    components = {
        "map": entity("map", "image", "Map", image_topic=topics.map, content_type="image/png"),
        "problem": of_status(
            "problem",
            "binary_sensor",
            "Problem",
            device_class="problem",
            json_attributes_topic=topics.status,
            json_attributes_template="{{ value_json.problems | tojson }}",
            **_DIAGNOSTIC,
        ),
        # Without availability: it is there to say so when all else is unavailable.
        "running": entity(
            "running",
            "binary_sensor",
            "Running",
            device_class="connectivity",
            state_topic=topics.availability,
            payload_on="online",
            payload_off="offline",
            **_DIAGNOSTIC,
        ),
        "step": of_status("step", "sensor", "What it does", icon="mdi:walk", **_DIAGNOSTIC),
        "mapped": of_status(
            "mapped", "sensor", "Devices on the map", icon="mdi:map-marker-check", state_class="measurement"
        ),
        "devices": of_status(
            "devices", "sensor", "Devices known", icon="mdi:devices", state_class="measurement"
        ),
        # One key whatever the camera is called: an entity that is only left out stays for good.
        "camera": entity(
            "camera",
            "sensor",
            "Camera calibration",
            device_class="enum",
            options=list(get_args(m.CameraState)),
            state_topic=topics.camera(camera),
            value_template=_member("calibration"),
            json_attributes_topic=topics.camera(camera),
            **_DIAGNOSTIC,
        ),
    }
    about: Component = {
        "identifiers": [topics.node],
        "name": f"vad {topics.hub}",
        "manufacturer": "vad",
        "model": "Visual Assistant daemon",
        "sw_version": __version__,
    }
    return _announcement(about, components, topics)


def _member(key: str) -> str:
    """A template that takes one member out of a JSON state."""
    return f"{{{{ value_json.{key} }}}}"


def _announcement(about: Component, components: dict[str, Component], topics: Topics) -> bytes:
    for component in components.values():
        if component.get("state_topic") != topics.availability:
            component["availability_topic"] = topics.availability
    return msgspec.json.encode(
        {
            "device": about,
            "origin": {"name": "vad", "sw_version": __version__},
            "components": components,
            "qos": 1,
        }
    )
