"""map_server files: real maps, the 205 trap, the modes, round trips, errors that help."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from vad.errors import ConfigError, ProtocolError, SourceError, VadError
from vad.robot.floor_plan import FREE, OCCUPIED, UNKNOWN, FloorPlan, Room
from vad.robot.map_server import (
    floor_plan_from_bytes,
    floor_plan_to_bytes,
    load_floor_plan,
    parse_metadata,
    save_floor_plan,
)
from vad.robot.pgm import parse_pgm, pgm_bytes

YAML = """\
image: m.pgm
resolution: 0.05
origin: [-1, 2, 0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""


def read(yaml_text: str, pgm: bytes) -> FloorPlan:
    return floor_plan_from_bytes(yaml_text.encode(), pgm, epoch=3, where="m.yaml", image_where="m.pgm")


def grey(*values: int, maxval: int = 255) -> bytes:
    return f"P2\n{len(values)} 1\n{maxval}\n{' '.join(map(str, values))}\n".encode()


@pytest.mark.parametrize(
    ("name", "yaml_name", "shape", "free_thresh"),
    [
        ("small_house.pgm", "small_house.orig.yaml", (500, 500), 0.196),
        ("tb3_sandbox.pgm", "tb3_sandbox.yaml", (384, 384), 0.196),
        ("wali_cart_house.map.pgm", "wali_cart_house.map.yaml", (257, 322), 0.25),
        ("wali_tb5wali_current.map.pgm", "wali_tb5wali_current.map.yaml", (232, 343), 0.25),
    ],
)
def test_real_maps(
    shared_data: Path, name: str, yaml_name: str, shape: tuple[int, int], free_thresh: float
) -> None:
    maps = shared_data / "robots/maps"
    yaml_bytes, pgm = (maps / yaml_name).read_bytes(), (maps / name).read_bytes()
    plan = floor_plan_from_bytes(yaml_bytes, pgm, epoch=1, where=yaml_name, image_where=name)
    assert plan.cells.shape == shape
    assert parse_metadata(yaml_bytes, where=yaml_name).free_thresh == free_thresh
    assert plan.resolution_m == 0.05
    pixels, _ = parse_pgm(pgm, where=name)
    top_down = plan.cells[::-1]
    assert (top_down[pixels == 205] == UNKNOWN).all()
    assert (top_down[pixels == 254] == FREE).all()
    assert (top_down[pixels == 0] == OCCUPIED).all()
    assert (top_down[0, 0], plan.cells[0, 0]) == (UNKNOWN, UNKNOWN)
    for state in (UNKNOWN, FREE, OCCUPIED):
        assert np.count_nonzero(plan.cells == state) > 100
    # A home, its walls and what surrounds it: not all of it free.
    assert 0.02 < np.mean(plan.cells == FREE) < 0.9
    again = floor_plan_from_bytes(
        *floor_plan_to_bytes(plan, name), epoch=1, where=yaml_name, image_where=name
    )
    assert (again.cells == plan.cells).all()
    assert again.origin == plan.origin


def test_a_real_map_from_its_path(shared_data: Path) -> None:
    plan = load_floor_plan(shared_data / "robots/maps/tb3_sandbox.yaml", epoch=5)
    assert plan.epoch == 5
    np.testing.assert_allclose(plan.bounds_m, (-10.0, -10.0, 9.2, 9.2))


def test_the_205_trap() -> None:
    for free_thresh in ("0.196", "0.25"):
        plan = read(YAML.replace("0.196", free_thresh), grey(0, 100, 205, 206, 254))
        assert plan.cells.tolist() == [[OCCUPIED, UNKNOWN, UNKNOWN, FREE, FREE]]


def test_negated_pictures_have_no_trap() -> None:
    plan = read(YAML.replace("negate: 0", "negate: 1"), grey(0, 50, 205, 255))
    assert plan.cells.tolist() == [[FREE, UNKNOWN, OCCUPIED, OCCUPIED]]


def test_scale_and_raw() -> None:
    scale = YAML.replace("0.65", "0.9").replace("0.196", "0.1") + "mode: scale\n"
    assert read(scale, grey(0, 127, 205, 255)).cells.tolist() == [[100, 50, UNKNOWN, 0]]
    raw = YAML + "mode: raw\n"
    assert read(raw, grey(0, 1, 100, 101, 205, 255)).cells.tolist() == [[0, 1, 100, -1, -1, -1]]


def test_rows_are_flipped_and_origin_and_rooms_are_kept() -> None:
    pgm = b"P5 # a comment\n2 # another\n2\n255\n" + bytes([0, 0, 254, 254])
    rooms = "rooms:\n- name: Küche\n  polygon_m: [[0, 0], [1, 0], [1, 1e0]]\nvendor_key: {a: 1}\n"
    plan = read(YAML.replace("0.05", "5e-2") + rooms, pgm)
    assert plan.cells.tolist() == [[FREE, FREE], [OCCUPIED, OCCUPIED]]
    assert (plan.epoch, plan.resolution_m, plan.origin) == (3, 0.05, (-1.0, 2.0, 0.0))
    assert plan.room_at(0.9, 0.5) == "Küche"


def test_16_bit_pictures() -> None:
    pgm = b"P5\n3 1\n65535\n" + bytes([0, 0, 0xFF, 0xFF, 0x80, 0])
    assert read(YAML, pgm).cells.tolist() == [[OCCUPIED, FREE, UNKNOWN]]


@example(np.zeros((1, 1), np.int8), True, 0.05, (0.0, 0.0, 0.0), [("\x85", 3), ("Küche", 3)])
@given(
    hnp.arrays(np.int8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=12), elements=st.integers(-1, 100)),
    st.booleans(),
    st.floats(1e-3, 1.0),
    st.tuples(*[st.floats(-100, 100)] * 3),
    st.lists(st.tuples(st.text(min_size=1, max_size=8), st.integers(3, 6)), max_size=3),
)
def test_what_is_written_is_read_again(
    cells: NDArray[np.int8],
    trinary: bool,
    resolution_m: float,
    origin: tuple[float, float, float],
    rooms: list[tuple[str, int]],
) -> None:
    if trinary:
        cells = np.where(cells < 0, cells, np.where(cells < 50, FREE, OCCUPIED)).astype(np.int8)
    made = tuple(Room(name, np.arange(2.0 * k).reshape(k, 2) / 3) for name, k in rooms)
    plan = FloorPlan(9, resolution_m, origin, cells, made)
    yaml_bytes, pgm = floor_plan_to_bytes(plan, "x.pgm")
    again = floor_plan_from_bytes(yaml_bytes, pgm, epoch=9, where="", image_where="")
    assert (again.cells == cells).all()
    assert (again.resolution_m, again.origin, again.epoch) == (resolution_m, origin, 9)
    assert [room.name for room in again.rooms] == [name for name, _ in rooms]
    for room, same in zip(made, again.rooms, strict=True):
        assert (room.polygon == same.polygon).all()


def test_saving_and_loading(tmp_path: Path) -> None:
    cells = np.array([[-1, 0, 100]], np.int8)
    save_floor_plan(FloorPlan(0, 0.05, (1.0, 2.0, 0.5), cells), tmp_path / "home.yaml")
    plan = load_floor_plan(tmp_path / "home.yaml", epoch=4)
    assert (plan.cells == cells).all()
    assert plan.origin == (1.0, 2.0, 0.5)
    with pytest.raises(SourceError, match="cannot write"):
        save_floor_plan(plan, tmp_path / "none" / "home.yaml")


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (("resolution: 0.05\n", ""), "resolution"),
        (("0.05", "-1"), "resolution"),
        (("0.05", "fine"), "resolution"),
        (("0.05", ".nan"), "resolution"),
        (("[-1, 2, 0]", "[-1, 2]"), "origin"),
        (("[-1, 2, 0]", "[-1, x, 0]"), "origin"),
        (("[-1, 2, 0]", "7"), "origin"),
        (("m.pgm", "[]"), "image"),
        (("0.196", "0.7"), "free_thresh"),
        (("negate: 0", "mode: maybe\nnegate: 0"), "mode"),
        (("negate: 0", "rooms: 3\nnegate: 0"), "rooms"),
        (("negate: 0", "rooms: [{name: a}]\nnegate: 0"), "rooms[0]"),
        (("negate: 0", "rooms: [{name: a, polygon_m: [[0,0],[1,1],[2]]}]\nnegate: 0"), "rooms[0].polygon_m"),
        (("negate: 0", "rooms: [{name: a, polygon_m: [[0,0],[1,1],4]}]\nnegate: 0"), "rooms[0].polygon_m"),
    ],
)
def test_a_wrong_yaml_names_the_key_and_the_remedy(change: tuple[str, str], key: str) -> None:
    assert change[0] in YAML
    with pytest.raises(ConfigError) as caught:
        parse_metadata(YAML.replace(*change).encode(), where="dir/m.yaml")
    assert caught.value.where == f"dir/m.yaml: $.{key}"
    assert caught.value.remedy


@pytest.mark.parametrize("data", [b"", b"[1, 2]", b"{", b"\xff\xfe\x00", b"a: &a [*a]"])
def test_what_is_no_yaml_of_a_map(data: bytes) -> None:
    with pytest.raises(ConfigError):
        parse_metadata(data, where="m.yaml")


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"P6\n1 1\n255\nabc",
        b"P5\n2 2\n255\nabc",
        b"P5\n0 2\n255\n",
        b"P5\n999999999 999999999\n255\n",
        b"P5\n1 1\n0\n\x00",
        b"P5\n1 1\n70000\n\x00\x00",
        b"P2\n2 1\n255\n1 x",
        b"P2\n2 1\n255\n1",
        b"P2\n2 1\n100\n1 101",
        b"\x89PNG\r\n",
    ],
)
def test_a_wrong_picture_names_itself_and_the_remedy(data: bytes) -> None:
    with pytest.raises(ProtocolError) as caught:
        parse_pgm(data, where="dir/m.pgm")
    assert caught.value.where == "dir/m.pgm"
    assert "PGM" in caught.value.remedy


@given(st.binary(max_size=60), st.sampled_from([b"", b"P5\n3 2\n255\n", b"P2\n3 2\n9\n", b"P5 "]))
def test_any_bytes_give_a_picture_or_a_typed_error(data: bytes, head: bytes) -> None:
    try:
        pixels, maxval = parse_pgm(head + data, where="x")
    except ProtocolError:
        return
    assert pixels.max() <= maxval


@given(st.text(max_size=80))
def test_any_text_gives_metadata_or_a_typed_error(text: str) -> None:
    try:
        metadata = parse_metadata((YAML + text).encode(), where="x")
    except VadError:
        return
    assert math.isfinite(metadata.resolution_m)


def test_p5_and_p2_agree() -> None:
    pixels = np.arange(12, dtype=np.uint8).reshape(3, 4)
    text = b"P2\n# c\n4 3\n255\n" + b" # row\n".join(b" ".join(b"%d" % v for v in row) for row in pixels)
    for data in (pgm_bytes(pixels), text):
        assert (parse_pgm(data, where="")[0] == pixels).all()


def test_missing_files_name_the_path_and_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"none\.yaml: cannot read this file: No such file.*yaml file"):
        load_floor_plan(tmp_path / "none.yaml", epoch=0)
    (tmp_path / "m.yaml").write_text(YAML)
    with pytest.raises(SourceError, match=r"m\.pgm: cannot read .*Correct `image:`"):
        load_floor_plan(tmp_path / "m.yaml", epoch=0)
