"""What is announced and said is what Home Assistant takes, whatever a device calls itself."""

from __future__ import annotations

from typing import Any, get_args

import msgspec
import pytest
from discovery_rules import check_announcement, check_topic
from hypothesis import given
from hypothesis import strategies as st

from vad.bus import messages as m
from vad.homeassistant.entities import device_announcement, hub_announcement
from vad.homeassistant.states import camera_state, device_state, status_state
from vad.homeassistant.topics import Topics, safe_id

TOPICS = Topics("vad", "homeassistant", "home")
MAC = "f4:f5:d8:d3:35:b2"

texts = st.none() | st.text(max_size=400)
metres = st.none() | st.floats(-1e4, 1e4)
devices = st.builds(
    m.DeviceMessage,
    source=st.sampled_from(get_args(m.Source)),
    mac=st.just(MAC),
    name=texts,
    state=st.sampled_from(get_args(m.DeviceState)),
    reason=st.text(max_size=400),
    x_m=metres,
    y_m=metres,
    radius90_m=metres,
    room=texts,
    macs=st.sampled_from([(), (MAC,), (MAC, "3a:11:22:33:44:55")]),
    host_name=texts,
    vendor=texts,
    in_network=st.booleans(),
    covariance_m2=st.none() | st.just(((0.04, 0.01), (0.01, 0.02))),
)


def _decoded(payload: bytes) -> dict[str, Any]:
    value = msgspec.json.decode(payload)
    assert isinstance(value, dict)
    return value


@given(devices)
def test_any_device_is_announced_by_the_rules(device: m.DeviceMessage) -> None:
    states = {TOPICS.device(MAC): _decoded(device_state(device))}
    told = check_announcement(TOPICS.device_config(MAC), device_announcement(device, TOPICS), states)
    assert told["device"]["via_device"] == "vad_home"
    assert ["mac", MAC] in told["device"]["connections"]
    assert told["device"]["name"]
    tracker = told["components"]["tracker"]
    assert "state_topic" not in tracker  # no longer taken from 2027.1 on
    zones = states[TOPICS.device(MAC)]["in_zones"]
    assert zones == (["zone.home"] if device.in_network else [])


@given(st.lists(devices, max_size=3), st.text(max_size=400), st.text(max_size=300))
def test_any_health_is_announced_by_the_rules(known: list[m.DeviceMessage], step: str, why: str) -> None:
    parts = (
        m.Part(part="camera", state="ok", detail="fine"),
        m.Part(part="csi", state="starting", detail="opening"),
        m.Part(part="robot", state="failed", detail=why),
    )
    status = m.StatusMessage(source="live", version="1", uptime_s=1, step=step, parts=parts)
    camera = m.CameraMessage(source="live", id="main", state="collecting", percent=40.2, reason=why)
    states = {
        TOPICS.status: _decoded(status_state(status, known)),
        TOPICS.camera("main"): _decoded(camera_state(camera)),
    }
    told = check_announcement(TOPICS.hub_config, hub_announcement("main", TOPICS), states)
    assert states[TOPICS.status]["problem"] == "ON"
    assert set(states[TOPICS.status]["problems"]) == {"robot"}
    assert states[TOPICS.status]["devices"] == len(known)
    assert "availability_topic" not in told["components"]["running"]
    assert told["components"]["map"]["image_topic"] == TOPICS.map


def test_what_is_not_known_is_null() -> None:
    device = m.DeviceMessage(source="live", mac=MAC, state="waiting", reason="somebody must walk")
    state = _decoded(device_state(device))
    assert state["reason"] == "somebody must walk"
    assert [state[key] for key in ("room", "x_m", "y_m", "sigma_m", "radius_90_m", "ip")] == [None] * 6


def test_a_long_name_is_cut_and_a_control_character_replaced() -> None:
    device = m.DeviceMessage(source="live", mac=MAC, name="\x1b[31m" + "x" * 400, state="mapped")
    name = _decoded(device_announcement(device, TOPICS))["device"]["name"]
    assert name.startswith("\N{REPLACEMENT CHARACTER}[31m")
    assert len(name) == 255


@given(st.text(min_size=1))
def test_any_id_is_made_safe(text: str) -> None:
    check_topic(safe_id(text))
    assert safe_id(text).isascii()


@pytest.mark.parametrize("mac", ["F4:F5:D8:D3:35:B2", MAC])
def test_a_device_has_one_topic_however_its_address_is_written(mac: str) -> None:
    assert TOPICS.device(mac) == "vad/home/devices/f4f5d8d335b2"
    assert TOPICS.device_config(mac) == "homeassistant/device/vad_home/f4f5d8d335b2/config"
