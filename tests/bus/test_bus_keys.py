"""Keys and selectors: what is built is read back, what is illegal is refused with a reason."""

from __future__ import annotations

import contextlib

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from vad.bus.keys import HubKeys, ParsedKey, chunk, parse_key
from vad.bus.messages import DeviceMessage
from vad.bus.selectors import (
    MAX_LENGTH,
    STATES,
    SelectorError,
    device_selector,
    parse_device_selector,
    require_no_selector,
)
from vad.errors import VadError

MAC = "aa:bb:cc:dd:ee:01"


def test_keys_are_the_designs_and_legal() -> None:
    keys = HubKeys("home")
    built = {
        keys.status: ParsedKey("home", "status"),
        keys.map: ParsedKey("home", "map"),
        keys.grid: ParsedKey("home", "grid"),
        keys.events: ParsedKey("home", "events"),
        keys.alive: ParsedKey("home", "alive"),
        keys.camera("front"): ParsedKey("home", "camera", "front"),
        keys.device(MAC.upper()): ParsedKey("home", "device", MAC),
        keys.heatmap(MAC): ParsedKey("home", "heatmap", MAC),
        keys.capture("s-1"): ParsedKey("home", "capture", "s-1"),
        keys.agent_alive("attic"): ParsedKey("home", "agent_alive", "attic"),
        keys.agent_clock("attic"): ParsedKey("home", "agent_clock", "attic"),
        keys.agent_cmd("attic"): ParsedKey("home", "agent_cmd", "attic"),
        keys.agent_csi("attic"): ParsedKey("home", "agent_csi", "attic"),
    }
    assert keys.device(MAC) == f"vad/home/devices/{MAC}"
    for key, parsed in built.items():
        assert str(zenoh.KeyExpr(key)) == key
        assert parse_key(key) == parsed
    everywhere = zenoh.KeyExpr(HubKeys("*").device())
    assert everywhere.includes(keys.device(MAC))
    assert not everywhere.intersects(keys.heatmap(MAC))


@pytest.mark.parametrize(
    "key", ["", "vad", "vad/home", "vad//status", "x/home/status", "vad/home/devices/a/b"]
)
def test_foreign_keys_are_not_ours(key: str) -> None:
    assert parse_key(key) is None


@given(st.text(max_size=12))
def test_a_chunk_is_legal_for_zenoh_or_refused(text: str) -> None:
    try:
        key = HubKeys("home").camera(chunk(text))
    except VadError:
        return
    assert str(zenoh.KeyExpr(key)) == key
    assert parse_key(key) == ParsedKey("home", "camera", text)


def test_a_wrong_mac_or_hub_is_refused() -> None:
    with pytest.raises(VadError, match="not a MAC"):
        HubKeys("home").device("front door")
    with pytest.raises(VadError, match="zenoh key"):
        HubKeys("my/home")


@given(
    st.frozensets(st.text(min_size=1, max_size=8), max_size=3),
    st.frozensets(st.sampled_from(STATES), max_size=3),
    st.none() | st.floats(0, 100),
)
def test_a_selector_is_read_back(rooms: frozenset[str], states: frozenset[str], limit: float | None) -> None:
    selector = device_selector(rooms=rooms, states=states, macs=[MAC], max_sigma_m=limit)
    assert parse_device_selector(selector.to_parameters()) == selector


@given(st.text(max_size=60))
def test_any_parameters_give_a_selector_or_a_reason(parameters: str) -> None:
    with contextlib.suppress(SelectorError):
        parse_device_selector(parameters)


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ("colour=red", "'colour' is not a selector"),
        ("state=maped", "'maped' is not a device state"),
        ("state", "state: the selector has no value"),
        ("max_sigma_m=small", "'small' is not a number"),
        ("max_sigma_m=nan", "not a length"),
        ("max_sigma_m=-1", "not a length"),
        ("mac=kitchen", "'kitchen' is not a MAC address"),
        ("room=a;room=b", "given twice"),
        ("room=" + "x" * MAX_LENGTH, "longer than"),
    ],
)
def test_a_bad_selector_says_why(parameters: str, reason: str) -> None:
    with pytest.raises(SelectorError, match=reason):
        parse_device_selector(parameters)


def test_zenohs_own_parameters_pass() -> None:
    assert parse_device_selector("_anyke;_time=[now(-1s)..]") == parse_device_selector("")
    require_no_selector("_anyke")
    with pytest.raises(SelectorError, match="takes no selectors"):
        require_no_selector("room=a")


def test_who_is_wanted() -> None:
    device = DeviceMessage(
        source="live", mac=MAC, state="mapped", room="Hall", covariance_m2=((0.04, 0.0), (0.0, 0.25))
    )
    lost = DeviceMessage(source="live", mac="aa:bb:cc:dd:ee:02", state="waiting")
    assert parse_device_selector("room=Hall|Bad;state=mapped;max_sigma_m=0.5").wants(device)
    assert not parse_device_selector("max_sigma_m=0.49").wants(device)
    assert not parse_device_selector("room=Bad").wants(device)
    assert not parse_device_selector("max_sigma_m=9").wants(lost)
    assert parse_device_selector("mac=AA:BB:CC:DD:EE:02").wants(lost)
