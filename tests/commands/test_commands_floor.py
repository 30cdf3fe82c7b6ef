"""The picture of the map: everything is where the coordinates say, and names do not cover each other."""

from __future__ import annotations

import math
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Polygon

from vad.bus import messages as m
from vad.report.floor import CHI2_90_2DOF, WALL, Floor, draw_floor, save_floor
from vad.report.labels import Label, place_labels


def plan(**changes: object) -> m.MapMessage:
    fields: dict[str, object] = {
        "source": "live",
        "epoch": 1,
        "bounds_m": (0.0, 0.0, 6.0, 4.0),
        "resolution_m": 0.1,
        "origin": (0.0, 0.0, 0.0),
        "width": 60,
        "height": 40,
    }
    return m.MapMessage(**(fields | changes))  # type: ignore[arg-type]


def device(i: int, **fields: object) -> m.DeviceMessage:
    return m.DeviceMessage(source="live", mac=f"aa:bb:cc:dd:ee:{i:02x}", state="mapped", **fields)  # type: ignore[arg-type]


def pixels(figure: Figure) -> np.ndarray:
    assert isinstance(figure.canvas, FigureCanvasAgg)
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3]


@pytest.mark.parametrize("yaw", [0.0, math.pi / 2, 0.3])
def test_a_wall_is_drawn_where_the_map_says(yaw: float) -> None:
    grid = np.zeros((40, 60), np.int8)
    grid[10:13, 20:23] = 100
    origin = (1.0, 0.5, yaw)
    cell = np.array((2.15, 1.15))
    turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    x, y = turn @ cell + origin[:2]
    figure = draw_floor(Floor(plan(origin=origin, bounds_m=(-4.0, 0.0, 8.0, 8.0)), grid))
    picture = pixels(figure)
    column, row = figure.axes[0].transData.transform((x, y))
    found = picture[picture.shape[0] - 1 - int(row), int(column)]
    np.testing.assert_allclose(found, [int(WALL[i : i + 2], 16) for i in (1, 3, 5)], atol=2)


def test_a_gaussian_without_outline_is_its_90_percent_ellipse() -> None:
    covariance = ((0.09, 0.0), (0.0, 0.01))
    figure = draw_floor(Floor(plan(), None, [device(1, x_m=3.0, y_m=2.0, covariance_m2=covariance)]))
    (ellipse,) = (patch for patch in figure.axes[0].patches if type(patch) is Ellipse)
    assert ellipse.center == (3.0, 2.0)
    assert ellipse.width == pytest.approx(2 * 0.3 * math.sqrt(CHI2_90_2DOF))
    assert ellipse.height == pytest.approx(2 * 0.1 * math.sqrt(CHI2_90_2DOF))
    assert ellipse.angle % 180 == pytest.approx(0.0)


def test_an_outline_is_drawn_as_given() -> None:
    region = ((1.0, 1.0), (2.0, 1.0), (1.5, 2.0))
    figure = draw_floor(
        Floor(plan(), np.zeros((40, 60), np.int8), [device(1, x_m=1.5, y_m=1.4, region90=region)])
    )
    outlines = [patch.get_xy()[:3] for patch in figure.axes[0].patches if isinstance(patch, Polygon)]
    assert any(np.allclose(outline, region) for outline in outlines)


def test_devices_without_a_place_are_listed_not_drawn(tmp_path: Path) -> None:
    lost = [device(i, reason=f"why {i}") for i in range(12)]
    save_floor(Floor(plan(), None, lost), tmp_path / "home.svg")
    drawn = (tmp_path / "home.svg").read_text(encoding="utf-8")
    assert "why 6" in drawn
    assert "why 7" not in drawn
    assert "and 5 more" in drawn
    assert "0 of 12 on the map" in drawn


def test_the_same_map_gives_the_same_file(tmp_path: Path) -> None:
    floor = Floor(plan(), None, [device(1, x_m=1.0, y_m=1.0, radius90_m=0.3)], truth={})
    for name in ("a.svg", "b.svg"):
        save_floor(floor, tmp_path / name)
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()


def test_labels_of_a_crowd_do_not_cover_each_other() -> None:
    figure = Figure(figsize=(8, 6))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_xlim(0, 8)
    axes.set_ylim(0, 6)
    near = [
        Label(4 + 0.45 * (i % 3), 3 + 0.35 * (i // 3), f"device {i}\n±0.30 m", "#000000") for i in range(6)
    ]
    place_labels(axes, [*near, Label(7.95, 5.95, "in the corner", "#000000")])
    renderer = figure.canvas.get_renderer()  # type: ignore[attr-defined]
    boxes = [text.get_bbox_patch().get_window_extent(renderer) for text in axes.texts]  # type: ignore[union-attr]
    for a, b in combinations(boxes, 2):
        shared = np.minimum(a.max, b.max) - np.maximum(a.min, b.min)
        assert not (shared > 2).all()
    page = axes.get_window_extent()
    assert len(boxes) == 7
    assert boxes[-1].x1 <= page.x1 + 1
    assert boxes[-1].y1 <= page.y1 + 1
