"""Names beside points, placed so that they cover neither each other nor other points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.transforms import Bbox
from numpy.typing import NDArray

GAP_PT = 9.0
"""From a point to its label."""
FAR_PT = 26.0
"""The same for a label that found no room near its point; it gets a thin line."""
POINT_PT = 7.0
"""Half the side of the square that a point's marker needs."""

PAD_PT = 2.0
FAR_COST, REGION_COST = 0.1, 0.2
"""What a far place costs, and covering a region, next to covering another label (1)."""

Point = tuple[float, float]
_DIRECTIONS: tuple[Point, ...] = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))
_CHOICES = [(reach, direction) for reach in (GAP_PT, FAR_PT) for direction in _DIRECTIONS]


@dataclass(frozen=True, slots=True)
class Label:
    """A text for the point x_m, y_m of the map."""

    x_m: float
    y_m: float
    text: str
    colour: str


def place_labels(
    axes: Axes, labels: Sequence[Label], taken: Sequence[Point] = (), regions: Sequence[Bbox] = ()
) -> None:
    """Draw the labels in turn, each where it overlaps least.

    taken: further points (map) to keep free; regions: boxes (pixels) that are better left uncovered.
    """
    figure = axes.get_figure(root=True)
    if figure is None or not isinstance(figure.canvas, FigureCanvasAgg):
        raise TypeError("labels are measured with the Agg canvas")
    renderer = figure.canvas.get_renderer()  # type: ignore[no-untyped-call]
    px_per_pt = figure.dpi / 72
    page = axes.get_window_extent(renderer)
    half = POINT_PT * px_per_pt
    points = [axes.transData.transform((label.x_m, label.y_m)) for label in labels]
    occupied = [
        Bbox.from_extents(x - half, y - half, x + half, y + half)
        for x, y in (*points, *(axes.transData.transform(point) for point in taken))
    ]
    for own, (label, point) in enumerate(zip(labels, points, strict=True)):
        text = axes.annotate(
            label.text,
            (label.x_m, label.y_m),
            xytext=(0, 0),
            textcoords="offset points",
            size=8,
            color=label.colour,
            weight="bold",
            linespacing=1.15,
            zorder=10,
            parse_math=False,
            bbox={"boxstyle": f"square,pad={PAD_PT / 8}", "fc": "white", "ec": "none", "alpha": 0.82},
            arrowprops={"arrowstyle": "-", "color": label.colour, "lw": 0.8, "shrinkA": 0, "shrinkB": 5},
        )
        extent = text.get_window_extent(renderer)
        size = np.array((extent.width, extent.height)) + 2 * PAD_PT * px_per_pt
        others = [box for i, box in enumerate(occupied) if i != own]
        places = [_place(point, size, direction, reach * px_per_pt) for reach, direction in _CHOICES]
        costs = [
            sum(_overlap_px2(box, other) for other in others)
            + REGION_COST * sum(_overlap_px2(box, region) for region in regions)
            + size.prod() - _overlap_px2(box, page)
            + (reach > GAP_PT) * FAR_COST * size.prod()
            for (reach, _), box in zip(_CHOICES, places, strict=True)
        ]  # fmt: skip
        chosen = int(np.argmin(costs))
        middle = np.mean((places[chosen].min, places[chosen].max), axis=0)
        text.set_horizontalalignment("center")
        text.set_verticalalignment("center")
        dx_pt, dy_pt = (middle - point) / px_per_pt
        text.xyann = (float(dx_pt), float(dy_pt))
        if _CHOICES[chosen][0] == GAP_PT and text.arrow_patch is not None:
            text.arrow_patch.set_visible(False)
        occupied.append(places[chosen])


def _place(point: NDArray[np.float64], size: NDArray[np.float64], direction: Point, reach_px: float) -> Bbox:
    """The label's box on that side of its point."""
    side = np.array(direction)
    middle = point + side * (reach_px / np.hypot(*side) + size / 2)
    return Bbox([middle - size / 2, middle + size / 2])


def _overlap_px2(a: Bbox, b: Bbox) -> float:
    shared = np.minimum(a.max, b.max) - np.maximum(a.min, b.min)
    return float(shared.prod()) if (shared > 0).all() else 0.0
