"""FloorPlan: cells and metres, rooms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vad.robot.floor_plan import FREE, OCCUPIED, UNKNOWN, FloorPlan, Room

SQUARE = np.array([[0, 0], [2, 0], [2, 2], [0, 2]], np.float64)


def plan(
    rows: int = 3, cols: int = 4, resolution_m: float = 0.5, origin: tuple[float, float, float] = (0, 0, 0)
) -> FloorPlan:
    return FloorPlan(0, resolution_m, origin, np.zeros((rows, cols), np.int8))


def test_row_0_is_at_the_bottom() -> None:
    grid = plan(origin=(10.0, -1.0, 0.0))
    assert grid.map_from_cell(np.array([[0, 0], [2, 3]])).tolist() == [[10.25, -0.75], [11.75, 0.25]]
    assert grid.bounds_m == (10.0, -1.0, 12.0, 0.5)


def test_a_turned_origin() -> None:
    grid = plan(origin=(1.0, 2.0, math.pi / 2))
    # Columns now run along map y, rows along -x.
    np.testing.assert_allclose(grid.map_from_cell(np.array([[0, 0]])), [[0.75, 2.25]])
    np.testing.assert_allclose(grid.bounds_m, (-0.5, 2.0, 1.0, 4.0))


@given(
    st.floats(-100, 100),
    st.floats(-100, 100),
    st.floats(-math.pi, math.pi),
    st.floats(0.01, 0.5),
    st.integers(0, 11),
    st.integers(0, 6),
)
def test_cells_and_metres_agree(
    x: float, y: float, yaw: float, resolution_m: float, row: int, col: int
) -> None:
    grid = plan(12, 7, resolution_m, (x, y, yaw))
    cells = np.array([[row, col]])
    points = grid.map_from_cell(cells)
    assert (grid.cell_from_map(points) == cells).all()
    x_min, y_min, x_max, y_max = grid.bounds_m
    assert x_min <= points[0, 0] <= x_max
    assert y_min <= points[0, 1] <= y_max


def test_occupancy_outside_is_unknown() -> None:
    cells = np.array([[FREE, OCCUPIED]], np.int8)
    grid = FloorPlan(0, 1.0, (0.0, 0.0, 0.0), cells)
    points = np.array([[0.5, 0.5], [1.5, 0.5], [2.5, 0.5], [-0.1, 0.5], [0.5, 1.1]])
    assert grid.occupancy_at(points).tolist() == [FREE, OCCUPIED, UNKNOWN, UNKNOWN, UNKNOWN]


def test_the_room_of_a_point() -> None:
    kitchen = Room("Kitchen", SQUARE)
    hall = Room("Hall", SQUARE + np.array([2.0, 0.0]))
    grid = FloorPlan(0, 1.0, (0.0, 0.0, 0.0), np.zeros((4, 4), np.int8), (kitchen, hall))
    assert [grid.room_at(1, 1), grid.room_at(3, 1), grid.room_at(1, 3)] == ["Kitchen", "Hall", None]


def test_a_room_with_a_corner_cut_out() -> None:
    corners = [[0, 0], [4, 0], [4, 1], [1, 1], [1, 4], [0, 4]]
    for polygon in (corners, corners[::-1]):
        room = Room("L", np.array(polygon, np.float64))
        assert room.contains(0.5, 3.5)
        assert room.contains(3.5, 0.5)
        assert not room.contains(2.0, 2.0)


@given(st.integers(3, 12), st.floats(0.0, 6.0), st.floats(0.0, 2.0))
def test_a_regular_polygon_contains_what_is_within_its_inner_circle(
    k: int, angle: float, share: float
) -> None:
    turns = np.arange(k) * math.tau / k
    room = Room("", np.stack([np.cos(turns), np.sin(turns)], axis=1))
    inner = math.cos(math.pi / k)
    for radius, inside in ((inner * share * 0.499, True), (1.001 + share, False)):
        assert room.contains(radius * math.cos(angle), radius * math.sin(angle)) is inside


@pytest.mark.parametrize(
    "make",
    [
        lambda: FloorPlan(0, 0.0, (0, 0, 0), np.zeros((1, 1), np.int8)),
        lambda: FloorPlan(0, 1.0, (0, math.nan, 0), np.zeros((1, 1), np.int8)),
        lambda: FloorPlan(0, 1.0, (0, 0, 0), np.zeros((0, 3), np.int8)),
        lambda: FloorPlan(0, 1.0, (0, 0, 0), np.full((1, 1), 101, np.int8)),
        lambda: Room("two points", SQUARE[:2]),
        lambda: Room("nan", SQUARE * math.nan),
    ],
)
def test_what_is_no_plan(make: object) -> None:
    assert callable(make)
    with pytest.raises(ValueError, match=r"is|are"):
        make()
