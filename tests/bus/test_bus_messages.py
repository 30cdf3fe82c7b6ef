"""The wire format: schemas do not change unseen, messages come back as they were sent."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vad.bus import messages as m
from vad.bus.grid import grid_to_png, png_to_grid
from vad.bus.schemas import json_schemas, write_schemas
from vad.errors import ProtocolError

pytestmark = pytest.mark.timeout(600)
"""Much work for the processor: a busy machine takes many times as long as an idle one."""

SCHEMAS = Path(__file__).parent / "schemas"
HOW_TO_RENEW = "a wanted change? python -m vad.bus.schemas tests/bus/schemas, and say so in the commit"


def test_schemas_are_the_checked_in_ones() -> None:
    checked_in = {path.stem: path.read_text(encoding="utf-8") for path in SCHEMAS.glob("*.json")}
    assert json_schemas() == checked_in, HOW_TO_RENEW


def test_schemas_are_written_one_a_file(tmp_path: Path) -> None:
    written = write_schemas(tmp_path / "new")
    assert sorted(path.name for path in written) == sorted(path.name for path in SCHEMAS.glob("*.json"))


@pytest.mark.parametrize("kind", m.ALL)
def test_every_schema_names_itself(kind: type[msgspec.Struct]) -> None:
    name = m.schema_id(kind)
    assert m.encoding_of(kind) == f"application/json;{name}"
    definition = json.loads(json_schemas()[name])["$defs"][kind.__name__]
    assert definition["properties"]["schema"]["enum"] == [name]


numbers = st.floats(-100, 100)
points = st.tuples(numbers, numbers)


@given(
    st.builds(
        m.DeviceMessage,
        source=st.sampled_from(["live", "replay", "simulated"]),
        hub=st.text(),
        mac=st.just("aa:bb:cc:dd:ee:ff"),
        name=st.none() | st.text(),
        state=st.sampled_from(["discovered", "waiting", "capturing", "mapped", "stale", "failed"]),
        reason=st.text(),
        x_m=st.none() | numbers,
        y_m=st.none() | numbers,
        covariance_m2=st.none() | st.tuples(points, points),
        region90=st.none() | st.lists(points, max_size=4).map(tuple),
        room=st.none() | st.text(),
        evidence=st.dictionaries(st.text(), numbers, max_size=3),
        walks=st.integers(0, 100),
    )
)
def test_a_device_comes_back_as_it_was(message: m.DeviceMessage) -> None:
    assert m.decode(m.encode(message), m.DeviceMessage) == message


def test_all_fields_are_on_the_wire_and_more_are_tolerated() -> None:
    message = m.CameraMessage(source="live", id="front", state="uncalibrated")
    wire = json.loads(m.encode(message))
    assert set(wire) == {field.name for field in msgspec.structs.fields(m.CameraMessage)}
    wire["from_a_later_version"] = 1
    assert m.decode(json.dumps(wire).encode(), m.CameraMessage) == message


@pytest.mark.parametrize(
    "change", [{"schema": "vad.camera.v2"}, {"state": "fine"}, {"source": "guess"}, {"percent": "much"}]
)
def test_a_foreign_message_is_refused(change: dict[str, str]) -> None:
    wire = json.loads(m.encode(m.CameraMessage(source="live", id="front", state="valid")))
    with pytest.raises(msgspec.ValidationError):
        m.decode(json.dumps(wire | change).encode(), m.CameraMessage)


@given(st.floats(0.01, 3), st.floats(0.01, 3), st.floats(0, 3.2))
def test_sigma_is_the_worst_directions(a: float, b: float, angle: float) -> None:
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    covariance = turn @ np.diag([a * a, b * b]) @ turn.T
    message = m.DeviceMessage(
        source="live",
        mac="aa:bb:cc:dd:ee:ff",
        state="mapped",
        covariance_m2=tuple(tuple(row) for row in covariance.tolist()),
    )
    assert message.sigma_m == pytest.approx(max(a, b), rel=1e-6)


def test_a_device_without_estimate_has_no_sigma() -> None:
    assert m.DeviceMessage(source="live", mac="aa:bb:cc:dd:ee:ff", state="waiting").sigma_m is None


def test_the_grid_survives_being_a_picture() -> None:
    grid = np.random.default_rng(3).choice(np.array([-1, 0, 100], np.int8), size=(30, 50))
    np.testing.assert_array_equal(png_to_grid(grid_to_png(grid)), grid)
    between = np.array([[10, 19, 20, 64, 65, 99]], np.int8)
    np.testing.assert_array_equal(png_to_grid(grid_to_png(between)), [[0, 0, -1, -1, 100, 100]])


@pytest.mark.parametrize("broken", [b"", b"not a picture", b"\x89PNG\r\n\x1a\n"])
def test_a_broken_grid_is_a_protocol_error(broken: bytes) -> None:
    with pytest.raises(ProtocolError, match="map grid"):
        png_to_grid(broken)
