"""Home Assistant's rules for discovery messages, as its MQTT integration's schemas state them (2026.7)."""

from __future__ import annotations

import re
from typing import Any

import msgspec

CONFIG_TOPIC = re.compile(r"homeassistant/device/[a-zA-Z0-9_-]+/[a-zA-Z0-9_-]+/config")
ENTITY = {
    "platform", "unique_id", "name", "availability_topic", "json_attributes_topic",
    "json_attributes_template", "icon", "entity_category", "enabled_by_default",
}  # fmt: skip
PLATFORM: dict[str, set[str]] = {
    "device_tracker": {"source_type"},
    "image": {"image_topic", "content_type"},
    "binary_sensor": {"state_topic", "value_template", "device_class", "payload_on", "payload_off"},
    "sensor": {
        "state_topic", "value_template", "device_class", "state_class", "unit_of_measurement",
        "suggested_display_precision", "options",
    },
}  # fmt: skip
DEVICE = {"identifiers", "connections", "name", "manufacturer", "model", "sw_version", "via_device"}
BLOCKED_ATTRIBUTES = {
    "assumed_state", "available", "device_class", "device_info", "entity_category", "entity_picture",
    "entity_registry_enabled_default", "extra_state_attributes", "force_update", "icon", "name",
    "should_poll", "state", "supported_features", "unique_id", "unit_of_measurement",
}  # fmt: skip
_MAC = re.compile("[0-9a-f]{2}(:[0-9a-f]{2}){5}")
_MEMBER = re.compile(r"value_json\.([a-z0-9_]+)")


def check_topic(topic: str) -> None:
    """A topic that may be published to, and not more than MQTT allows."""
    assert topic
    assert not set(topic) & set("#+\0")
    assert "" not in topic.split("/")
    assert len(topic.encode()) < 65536


def check_announcement(topic: str, payload: bytes, states: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """A discovery message that Home Assistant takes, whose templates find what `states` (by topic) have."""
    assert CONFIG_TOPIC.fullmatch(topic)
    told: dict[str, Any] = msgspec.json.decode(payload)
    assert set(told) == {"device", "origin", "components", "qos"}
    assert told["qos"] in (0, 1, 2)
    assert set(told["origin"]) <= {"name", "sw_version", "support_url"}
    assert told["origin"]["name"]
    _check_device(told["device"])
    ids = [component["unique_id"] for component in told["components"].values()]
    assert len(set(ids)) == len(ids)
    for component in told["components"].values():
        _check_component(component, states)
    return told


def _check_device(device: dict[str, Any]) -> None:
    assert set(device) <= DEVICE
    assert device["identifiers"]
    assert all(isinstance(one, str) for one in device["identifiers"])
    for kind, mac in device.get("connections", ()):
        assert kind == "mac"
        assert _MAC.fullmatch(mac)
    for key in ("name", "manufacturer", "model", "sw_version", "via_device"):
        assert isinstance(device.get(key, ""), str)
    assert device["name"].isprintable()


def _check_component(component: dict[str, Any], states: dict[str, dict[str, Any]]) -> None:
    platform = component["platform"]
    assert set(component) <= ENTITY | PLATFORM[platform]
    assert component.get("entity_category", "diagnostic") in ("config", "diagnostic")
    assert isinstance(component["name"], str) or platform == "device_tracker"
    for key in [key for key in component if key.endswith("_topic")]:
        check_topic(component[key])
    attributes = component.get("json_attributes_topic")
    if platform == "device_tracker":
        assert component["source_type"] in ("gps", "router", "bluetooth", "bluetooth_le")
        assert isinstance(states[attributes]["in_zones"], list)
        assert not {"latitude", "longitude"} & set(states[attributes])
    if attributes is not None:
        _check_template(component.get("json_attributes_template", ""), states[attributes])
        if "json_attributes_template" not in component:
            assert not BLOCKED_ATTRIBUTES & set(states[attributes])
    if "value_template" in component:
        state = states[component["state_topic"]]
        (member,) = _check_template(component["value_template"], state)
        _check_state(component, state[member])


def _check_template(template: str, state: dict[str, Any]) -> list[str]:
    members = _MEMBER.findall(template)
    assert set(members) <= set(state)
    return members


def _check_state(component: dict[str, Any], value: Any) -> None:
    """A state that is null is unknown there; anything else has to fit."""
    if value is None:
        return
    assert len(str(value)) <= 255
    assert value != ""
    kind = component.get("device_class")
    if kind == "enum":
        assert value in component["options"]
    elif "unit_of_measurement" in component or "state_class" in component:
        assert isinstance(value, int | float)
    elif component["platform"] == "binary_sensor":
        assert value in (component.get("payload_on", "ON"), component.get("payload_off", "OFF"))
