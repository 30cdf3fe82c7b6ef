"""Old plan onto new plan: turned, shifted, flipped, changed; other homes; what is symmetrical."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from vad.mapping.plan_match import IDENTITY, Occupancy, PlanTransform, agreement, match_plans
from vad.robot.map_server import floor_plan_from_bytes
from vad.robot.valetudo import map_from_payload

pytestmark = pytest.mark.timeout(600)
"""Much work for the processor: a busy machine takes many times as long as an idle one."""

DIFFERENT_HOMES = (
    "3irobotix__converted_3790",
    "3irobotix__viomi_v6_41_no_path",
    "dreame__1c_1096_fullcleanup",
    "dreame__l10su_1121_new_path",
    "dreame__misc_monastery_with_cutoff",
    "dreame__z10_1056_virtual_restrictions",
    "roborock__S5_FW1886_with_goto_target",
    "roborock__S5_FW2020_with_segments",
    "roborock__S6_FW2652_with_active_segment_and_no_mop_zone",
)
LARGE_HOMES = ("dreame__misc_monastery_with_cutoff", "roborock__S5_FW2020_with_segments")
"""Left out where every pair is tried, for the time it takes."""


def home(step_m: float = 0.05) -> Occupancy:
    """Three rooms, 8 m x 6 m, nothing symmetrical."""
    cells = np.full((140, 180), -1, np.int8)

    def fill(x0: float, y0: float, x1: float, y1: float, value: int) -> None:
        x0, y0, x1, y1 = (round((v + 0.5) / step_m) for v in (x0, y0, x1, y1))
        cells[y0:y1, x0:x1] = value

    fill(0, 0, 8, 6, 100)
    fill(0.1, 0.1, 3.5, 5.9, 0)
    fill(3.6, 2.5, 7.9, 5.9, 0)
    fill(3.6, 0.1, 6.0, 2.4, 0)
    fill(3.5, 4.0, 3.6, 4.9, 0)
    fill(4.5, 2.4, 5.3, 2.5, 0)
    fill(1.0, 1.0, 1.6, 2.8, 100)
    fill(5.5, 3.2, 6.5, 3.8, 100)
    return Occupancy(cells, step_m, (-0.5, -0.5, 0.0))


def changed(cells: NDArray[np.int8], share: float, rng: np.random.Generator) -> NDArray[np.int8]:
    """The cells with a share of them set to anything."""
    hit = rng.random(cells.shape) < share
    return np.where(hit, rng.choice(np.array([-1, 0, 100], np.int8), cells.shape), cells).astype(np.int8)


def turned_90(plan: Occupancy, x_m: float, y_m: float) -> tuple[Occupancy, PlanTransform]:
    """The plan after a quarter turn clockwise, its lower left corner at (x, y), and the way there."""
    new = Occupancy(np.rot90(plan.cells).copy(), plan.resolution_m, (x_m, y_m, 0.0))
    width_m = plan.cells.shape[1] * plan.resolution_m
    ox, oy, _ = plan.origin
    return new, PlanTransform(-math.pi / 2, x_m - oy, y_m + width_m + ox)


def worst_m(found: PlanTransform, truth: PlanTransform, plan: Occupancy) -> float:
    rows, cols = np.array(plan.cells.shape) * plan.resolution_m
    corners = np.array([[0, 0], [cols, 0], [0, rows], [cols, rows]]) + plan.origin[:2]
    return float(np.linalg.norm(found.apply(corners) - truth.apply(corners), axis=1).max())


def turn_deg(found: PlanTransform, truth: PlanTransform) -> float:
    return math.degrees(abs(math.remainder(found.angle_rad - truth.angle_rad, math.tau)))


@pytest.mark.parametrize("seed", range(3))
def test_turned_by_90_degrees_shifted_and_a_tenth_changed(seed: int) -> None:
    old = home()
    new, truth = turned_90(old, 3.0, -7.0)
    new = Occupancy(changed(new.cells, 0.1, np.random.default_rng(seed)), new.resolution_m, new.origin)
    found = match_plans(old, new)
    assert found.transform is not None, found
    assert not found.transform.flipped
    assert turn_deg(found.transform, truth) < 1.0
    assert worst_m(found.transform, truth, old) < 0.1


@pytest.mark.parametrize("angle_deg", [-160.0, 17.3, 45.0])
@pytest.mark.parametrize("flipped", [False, True])
def test_any_angle_and_both_ways_up(angle_deg: float, flipped: bool) -> None:
    truth = PlanTransform(math.radians(angle_deg), 2.0, 11.0, flipped)
    old = home()
    side = 320
    rows_cols = np.indices((side, side)).reshape(2, -1).T
    new_origin = truth.apply(np.array([[3.5, 2.5]]))[0] - side * 0.05 / 2
    there = (rows_cols[:, ::-1] + 0.5) * 0.05 + new_origin
    back = np.floor((truth.inverse_apply(there) - old.origin[:2]) / 0.05).astype(int)
    inside = ((back >= 0) & (back < np.array(old.cells.shape)[::-1])).all(axis=1)
    cells = np.full(side * side, -1, np.int8)
    cells[inside] = old.cells[back[inside, 1], back[inside, 0]]
    new = Occupancy(cells.reshape(side, side), 0.05, (float(new_origin[0]), float(new_origin[1]), 0.0))
    found = match_plans(old, new)
    assert found.transform is not None, found
    assert found.transform.flipped == flipped
    assert turn_deg(found.transform, truth) < 1.0
    assert worst_m(found.transform, truth, old) < 0.1


def test_the_origin_may_be_turned_and_the_cells_of_another_size() -> None:
    old = home()
    fine = Occupancy(old.cells.repeat(2, axis=0).repeat(2, axis=1), 0.025, (4.0, 1.0, 0.7))
    found = match_plans(old, fine)
    truth_angle = 0.7
    assert found.transform is not None
    assert found.transform.angle_rad == pytest.approx(truth_angle, abs=math.radians(1))
    corner = found.transform.apply(np.array([[-0.5, -0.5]]))[0]
    assert np.linalg.norm(corner - [4.0, 1.0]) < 0.1


def test_the_same_plan_is_known_without_a_search() -> None:
    old = home()
    grown = old.cells.copy()
    grown[100:, 150:] = 0
    assert agreement(old, Occupancy(grown, 0.05, old.origin)).same
    moved = Occupancy(old.cells, 0.05, (0.0, -0.5, 0.0))
    assert not agreement(old, moved).same


def test_what_fits_in_two_places_is_refused() -> None:
    cells = np.full((120, 160), -1, np.int8)
    cells[10:110, 10:150] = 100
    cells[12:108, 12:148] = 0
    box = Occupancy(cells, 0.05, (0.0, 0.0, 0.0))
    found = match_plans(box, box)
    assert found.transform is None
    assert "two places" in found.reason


@pytest.mark.parametrize("cells", [np.full((50, 50), -1, np.int8), np.zeros((3, 3), np.int8)])
def test_plans_that_show_nothing_are_refused(cells: NDArray[np.int8]) -> None:
    empty = Occupancy(cells, 0.05, (0.0, 0.0, 0.0))
    for pair in ((empty, home()), (home(), empty), (empty, empty)):
        found = match_plans(*pair)
        assert found.transform is None
        assert "too little" in found.reason


def test_other_rooms_are_refused() -> None:
    other = home().cells.copy()
    other[:, 80:] = np.where(other[:, 80:] == 0, 100, other[:, 80:])
    other[15:60, 90:130] = 0
    found = match_plans(home(), Occupancy(other, 0.05, (0.0, 0.0, 0.0)))
    assert found.transform is None


@given(
    st.floats(-math.pi, math.pi),
    st.floats(-50, 50),
    st.floats(-50, 50),
    st.booleans(),
    st.tuples(st.floats(-50, 50), st.floats(-50, 50)),
)
def test_there_and_back(angle: float, x: float, y: float, flipped: bool, point: tuple[float, float]) -> None:
    transform = PlanTransform(angle, x, y, flipped)
    points = np.array([point])
    np.testing.assert_allclose(transform.inverse_apply(transform.apply(points)), points, atol=1e-9)
    assert np.linalg.det(transform.matrix) == pytest.approx(-1 if flipped else 1)
    assert IDENTITY.apply(points) == pytest.approx(points)


def recorded(folder: Path, name: str) -> Occupancy:
    plan = map_from_payload((folder / f"{name}.json").read_bytes(), 1).plan
    return Occupancy(plan.cells, plan.resolution_m, plan.origin)


def test_recorded_homes_turned_and_changed_are_found(shared_data: Path) -> None:
    rng = np.random.default_rng(7)
    for name in DIFFERENT_HOMES:
        old = recorded(shared_data / "robots" / "valetudo", name)
        new, truth = turned_90(old, -4.0, 9.0)
        new = Occupancy(changed(new.cells, 0.1, rng), new.resolution_m, new.origin)
        found = match_plans(old, new)
        assert found.transform is not None, (name, found)
        assert turn_deg(found.transform, truth) < 1.0, name
        assert worst_m(found.transform, truth, old) < 0.1, name


def test_every_other_recorded_home_is_refused(shared_data: Path) -> None:
    plans: dict[str, Any] = {
        name: recorded(shared_data / "robots" / "valetudo", name)
        for name in DIFFERENT_HOMES
        if name not in LARGE_HOMES
    }
    maps = shared_data / "robots" / "maps"
    for yaml_name, pgm in (
        ("small_house.orig.yaml", "small_house.pgm"),
        ("wali_cart_house.map.yaml", "wali_cart_house.map.pgm"),
    ):
        plan = floor_plan_from_bytes(
            (maps / yaml_name).read_bytes(),
            (maps / pgm).read_bytes(),
            epoch=1,
            where=yaml_name,
            image_where=pgm,
        )
        plans[yaml_name] = Occupancy(plan.cells, plan.resolution_m, plan.origin)
    for one, other in itertools.combinations(plans, 2):
        found = match_plans(plans[one], plans[other])
        assert found.transform is None, (one, other, found)


def test_a_home_mapped_again_by_the_same_robot_is_found(shared_data: Path) -> None:
    folder = shared_data / "robots" / "valetudo"
    one, other = (recorded(folder, f"dreame__l10su_{name}") for name in ("1058_goto_target", "1121_carpet"))
    found = match_plans(one, other)
    assert found.transform is not None
    assert worst_m(found.transform, IDENTITY, one) < 0.2
    assert agreement(one, other).same


def test_recorded_maps_have_the_pose_where_it_is_turned_to(shared_data: Path) -> None:
    """The charger of one map lands on the charger of the other: the transform holds for what hangs on it."""
    folder = shared_data / "robots" / "valetudo"
    names = ("roborock__S5_FW1886_with_goto_target", "roborock__S5_FW1886_with_forbidden_zones")
    places = []
    for name in names:
        (file,) = sorted(folder.glob(f"{name}*.json"))
        tree = json.loads(file.read_bytes())
        (dock,) = [e["points"] for e in tree["entities"] if e["type"] == "charger_location"]
        plan = map_from_payload(file.read_bytes(), 1).plan
        at = np.array([[dock[0] / 100, (tree["size"]["y"] - dock[1]) / 100]])
        places.append((Occupancy(plan.cells, plan.resolution_m, plan.origin), at))
    (old, dock_then), (new, dock_now) = places
    found = match_plans(old, new)
    assert found.transform is not None
    assert np.linalg.norm(found.transform.apply(dock_then) - dock_now) < 0.15
