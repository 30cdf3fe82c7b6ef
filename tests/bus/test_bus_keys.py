"""Keys and selectors: what is built is read back, what is illegal is refused with a reason."""

from __future__ import annotations

import contextlib
from datetime import UTC
from typing import Literal

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from vad.bus.board import facts_of
from vad.bus.keys import HubKeys, ParsedKey, chunk, parse_key
from vad.bus.messages import DeviceMessage
from vad.bus.selectors import (
    MAX_HISTORY,
    MAX_LENGTH,
    STATES,
    DeviceQuestion,
    HistoryQuestion,
    SelectorError,
    device_selector,
    parse_device_question,
    parse_event_question,
    parse_heatmap_format,
    parse_history_question,
    require_no_selector,
)
from vad.errors import VadError

pytestmark = pytest.mark.timeout(600)
"""Much work for the processor: a busy machine takes many times as long as an idle one."""

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
        keys.history(MAC): ParsedKey("home", "history", MAC),
        keys.devices: ParsedKey("home", "devices"),
        keys.schema("vad.device.v1"): ParsedKey("home", "schema", "vad.device.v1"),
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


TIMES = st.datetimes(timezones=st.just(UTC)).map(
    lambda t: t.isoformat(timespec="milliseconds").replace("+00:00", "Z")
)
SIDES = st.floats(-100, 100)


@given(
    st.frozensets(st.text(min_size=1, max_size=8), max_size=3),
    st.frozensets(st.sampled_from(STATES), max_size=3),
    st.none() | st.floats(0, 100),
    st.none() | st.tuples(SIDES, SIDES).map(lambda p: (min(p), min(p), max(p), max(p))),
    st.none() | TIMES,
    st.booleans(),
    st.sampled_from(["json", "geojson"]),
)
def test_a_selector_is_read_back(
    rooms: frozenset[str],
    states: frozenset[str],
    limit: float | None,
    box: tuple[float, float, float, float] | None,
    time: str | None,
    then: bool,
    form: Literal["json", "geojson"],
) -> None:
    since, at = (None, time) if then else (time, None)
    selector = device_selector(
        rooms=rooms, states=states, macs=[MAC], max_sigma_m=limit, bbox=box, since=since
    )
    question = DeviceQuestion(selector, at, form)
    assert parse_device_question(question.to_parameters()) == question


@given(st.none() | TIMES, st.none() | TIMES, st.integers(1, MAX_HISTORY))
def test_a_question_on_history_is_read_back(since: str | None, until: str | None, limit: int) -> None:
    question = HistoryQuestion(since, until, limit)
    assert parse_history_question(question.to_parameters()) == question


NAMES = ["room", "state", "mac", "max_sigma_m", "since", "bbox", "at", "format", "limit", "until"]
WORDS = st.sampled_from([*NAMES, "=", ";", "|", ",", "%", "1e999", "nan", "2026-01-31T12:00:00Z"]) | st.text()


@given(st.lists(WORDS, max_size=12).map("".join))
def test_any_parameters_give_a_question_or_a_reason(parameters: str) -> None:
    for parse in (
        parse_device_question,
        parse_history_question,
        parse_heatmap_format,
        parse_event_question,
        require_no_selector,
    ):
        with contextlib.suppress(SelectorError):
            parse(parameters)


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ("colour=red", "'colour' is not a selector"),
        ("state=maped", "'maped' is not a device state"),
        ("state", "state: the selector has no value"),
        ("max_sigma_m=small", "'small' is not a number. Write metres"),
        ("max_sigma_m=nan", "not a length"),
        ("max_sigma_m=-1", "not a length"),
        ("mac=kitchen", "'kitchen' is not a MAC address"),
        ("room=a;room=b", "given twice"),
        ("bbox=0,0,1", "bbox: 3 numbers. Write x0,y0,x1,y1"),
        ("bbox=0,0,1,x", "'x' is not a number"),
        ("bbox=1,0,0,1", "not a box"),
        ("bbox=0,0,inf,1", "not a box"),
        ("since=yesterday", "since: 'yesterday' is not an RFC 3339 time. Write a time, e.g. since=2026"),
        ("at=2026-01-31", "not an RFC 3339 time"),
        ("at=2026-02-31T00:00:00Z", "at: day is out of range"),
        ("at=2026-01-31T12:00:00Z;since=2026-01-31T12:00:00Z", "exclude each other"),
        ("format=xml", "'xml' is no form of this key. Use one of json, geojson"),
        ("room=" + "x" * MAX_LENGTH, "longer than"),
    ],
)
def test_a_bad_selector_says_why(parameters: str, reason: str) -> None:
    with pytest.raises(SelectorError, match=reason):
        parse_device_question(parameters)


@pytest.mark.parametrize("limit", ["0", "1001", "-1", "ten", "1e3", "9" * 5000])
def test_a_bad_limit_says_why(limit: str) -> None:
    with pytest.raises(SelectorError, match=r"limit: .* cannot be\. Give a number from 1 to 1000"):
        parse_history_question(f"limit={limit}")


def test_times_of_all_zones_and_lengths_become_one_form() -> None:
    question = parse_device_question("at=2026-01-31t13:30:00.123456789+01:30")
    assert question.at == "2026-01-31T12:00:00.123Z"


def test_zenohs_own_parameters_pass() -> None:
    assert parse_device_question("_anyke;_time=[now(-1s)..]") == DeviceQuestion()
    require_no_selector("_anyke")
    with pytest.raises(SelectorError, match="takes no selectors"):
        require_no_selector("room=a")


def test_who_is_wanted() -> None:
    device = DeviceMessage(
        source="live",
        mac=MAC,
        state="mapped",
        room="Hall",
        x_m=2.0,
        y_m=1.0,
        covariance_m2=((0.04, 0.0), (0.0, 0.25)),
    )
    lost = DeviceMessage(source="live", mac="aa:bb:cc:dd:ee:02", state="waiting")

    def wanted(parameters: str, message: DeviceMessage) -> bool:
        facts = facts_of(message, "2026-01-31T12:00:00.500Z")
        return parse_device_question(parameters).selector.wants(facts)

    assert wanted("room=Hall|Bad;state=mapped;max_sigma_m=0.5", device)
    assert not wanted("max_sigma_m=0.49", device)
    assert not wanted("room=Bad", device)
    assert not wanted("max_sigma_m=9", lost)
    assert wanted("mac=AA:BB:CC:DD:EE:02", lost)
    assert wanted(f"mac={MAC}|AA:BB:CC:DD:EE:02", lost)
    assert wanted("bbox=2,0,3,1", device), "edges belong to it"
    assert not wanted("bbox=0,0,1.9,9", device)
    assert not wanted("bbox=-99,-99,99,99", lost), "what has no place is in no box"
    assert wanted("since=2026-01-31T12:00:00.499Z", device)
    assert not wanted("since=2026-01-31T13:00:00.500%2B01:00", device)
