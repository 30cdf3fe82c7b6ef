"""The map as a picture: floor plan, rooms, cameras, and every device with its 90 % region."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse, Patch, Polygon, Wedge
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from vad.bus.messages import CameraMessage, DeviceMessage, MapMessage, Point
from vad.report.labels import Label, place_labels
from vad.report.words import printable

PAPER, FLOOR, WALL, INK, FAINT = "#eeece7", "#ffffff", "#39424e", "#22282f", "#8b929b"
ROOM_COLOURS = ("#cfe3f1", "#f6e0c4", "#d8ead0", "#ead9ec", "#f4d7d7", "#dfe0f0", "#efe9c6", "#d2eae6")
DEVICE_COLOURS = ("#0f766e", "#b4450c", "#6d28d9", "#be185d", "#1d4ed8", "#4d7c0f", "#92600a", "#475569")
STALE_COLOUR = "#6b7280"
CAMERA_COLOUR = "#22282f"
CAMERA_VIEW_DEG, CAMERA_VIEW_M = 60.0, 0.7
"""The wedge shows where a camera looks, not how wide its lens is."""
CHI2_90_2DOF = 4.605
"""The 90 % quantile of chi-squared with two degrees of freedom (Gaussian ellipse)."""
LONG_SIDE_IN = 9.0
DPI = 160


@dataclass(frozen=True, slots=True)
class Floor:
    """What is drawn.

    grid: (height, width) int8 of `plan`, row 0 at the bottom, 0 free, 100 wall, -1 unknown. truth: MAC -> map
    x, y in metres, for recorded or simulated data where it is known.
    """

    plan: MapMessage
    grid: NDArray[np.int8] | None = None
    devices: Sequence[DeviceMessage] = ()
    cameras: Sequence[CameraMessage] = ()
    truth: Mapping[str, Point] = field(default_factory=dict)


def save_floor(floor: Floor, path: Path) -> None:
    """Write the picture; the suffix (.png, .svg) says which kind. OSError where it cannot be written."""
    # text stays text in an SVG, and the same map gives the same file
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "vad"}):
        undated = {"Date": None} if path.suffix == ".svg" else {}
        draw_floor(floor).savefig(path, dpi=DPI, facecolor=PAPER, metadata=undated)


def draw_floor(floor: Floor) -> Figure:
    """The picture as a matplotlib figure, on no screen."""
    x0, y0, x1, y1 = floor.plan.bounds_m
    width_m, height_m = max(x1 - x0, 0.5), max(y1 - y0, 0.5)
    margin_m = 0.02 * max(width_m, height_m)
    scale = LONG_SIDE_IN / (max(width_m, height_m) + 2 * margin_m)
    plan_w, plan_h = (width_m + 2 * margin_m) * scale, (height_m + 2 * margin_m) * scale
    notes = _notes(floor)
    head_in, foot_in = 0.75, 0.5 + 0.2 * len(notes)
    figure_w, figure_h = max(plan_w, 5.0), plan_h + head_in + foot_in
    figure = Figure(figsize=(figure_w, figure_h), facecolor=PAPER)
    FigureCanvasAgg(figure)
    left = (figure_w - plan_w) / 2 / figure_w
    axes = figure.add_axes((left, foot_in / figure_h, plan_w / figure_w, plan_h / figure_h))
    axes.set_xlim(x0 - margin_m, x0 + width_m + margin_m)
    axes.set_ylim(y0 - margin_m, y0 + height_m + margin_m)
    axes.set_axis_off()

    _draw_grid(axes, floor)
    _draw_rooms(axes, floor.plan)
    for camera in floor.cameras:
        _draw_camera(axes, camera)
    _draw_devices(axes, floor)
    _draw_head(figure, floor, 1 - 0.3 / figure_h, 1 - 0.55 / figure_h)
    _draw_scale(axes, width_m)
    for i, note in enumerate(notes):
        y = (foot_in - 0.36 - 0.2 * i) / figure_h
        figure.text(0.3 / figure_w, y, note, size=8, color=INK, parse_math=False)
    return figure


def _draw_grid(axes: Axes, floor: Floor) -> None:
    plan = floor.plan
    if floor.grid is None:
        x0, y0, x1, y1 = plan.bounds_m
        axes.add_patch(Polygon(((x0, y0), (x1, y0), (x1, y1), (x0, y1)), fc=FLOOR, ec=WALL, lw=1.5, zorder=1))
        return
    colours = np.zeros((*floor.grid.shape, 4), np.float32)
    colours[floor.grid == 0] = to_rgba(FLOOR)
    colours[floor.grid > 0] = to_rgba(WALL)
    height, width = floor.grid.shape
    x, y, yaw = plan.origin
    cells_to_map = Affine2D().rotate(yaw).translate(x, y) + axes.transData
    side = plan.resolution_m
    limits = axes.axis()
    # walls lie over the rooms' colours, so the free floor goes below and the walls above
    for layer, zorder in ((floor.grid == 0, 1), (floor.grid > 0, 4)):
        axes.imshow(
            colours * layer[..., None],
            origin="lower",
            extent=(0, width * side, 0, height * side),
            transform=cells_to_map,
            interpolation="nearest",
            zorder=zorder,
        )
    axes.axis(limits)
    axes.set_aspect("equal")


def _draw_rooms(axes: Axes, plan: MapMessage) -> None:
    for i, room in enumerate(plan.rooms):
        if len(room.polygon_m) < 3:
            continue
        colour = ROOM_COLOURS[i % len(ROOM_COLOURS)]
        axes.add_patch(Polygon(room.polygon_m, fc=colour, ec="none", alpha=0.6, zorder=2))
        corners = np.array(room.polygon_m)
        low, high = corners.min(axis=0), corners.max(axis=0)
        # a room's name stands in its upper left, where devices' labels seldom are
        axes.annotate(
            printable(room.name).upper(),
            (low[0], high[1]),
            xytext=(9, -9),
            textcoords="offset points",
            ha="left",
            va="top",
            size=8.5,
            color="#5b6570",
            weight="bold",
            zorder=5,
            parse_math=False,
        )


def _draw_camera(axes: Axes, camera: CameraMessage) -> None:
    if camera.position_m is None:
        return
    x, y, _ = camera.position_m
    if camera.map_from_camera is not None:
        # the optical axis is the camera's z, the third column of map_from_camera
        ahead = (camera.map_from_camera[0][2], camera.map_from_camera[1][2])
        if math.hypot(*ahead) > 0.05:
            middle = math.degrees(math.atan2(ahead[1], ahead[0]))
            half = CAMERA_VIEW_DEG / 2
            axes.add_patch(
                Wedge(
                    (x, y),
                    CAMERA_VIEW_M,
                    middle - half,
                    middle + half,
                    fc=CAMERA_COLOUR,
                    alpha=0.16,
                    zorder=6,
                )
            )
    axes.plot([x], [y], marker="s", ms=8, mfc=CAMERA_COLOUR, mec="white", mew=1.4, zorder=9)
    axes.plot([x], [y], marker="o", ms=2.8, mfc="white", mec="none", zorder=9.1)


def _draw_devices(axes: Axes, floor: Floor) -> None:
    labels: list[Label] = []
    regions: list[Patch] = []
    taken = [(c.position_m[0], c.position_m[1]) for c in floor.cameras if c.position_m is not None]
    for camera in floor.cameras:
        if camera.position_m is not None:
            name = printable(camera.id)
            labels.append(Label(camera.position_m[0], camera.position_m[1], f"camera {name}", CAMERA_COLOUR))
    for i, device in enumerate(floor.devices):
        if device.x_m is None or device.y_m is None:
            continue
        colour = STALE_COLOUR if device.state == "stale" else DEVICE_COLOURS[i % len(DEVICE_COLOURS)]
        region = _region(device, device.x_m, device.y_m)
        if region is not None:
            regions.append(region)
            axes.add_patch(region)
            region.set(
                facecolor=to_rgba(colour, 0.2), edgecolor=to_rgba(colour, 0.8), linewidth=1.1, zorder=6
            )
        axes.plot(
            [device.x_m], [device.y_m], marker="o", ms=8.5, mfc=colour, mec="white", mew=1.5, ls="", zorder=8
        )
        true = floor.truth.get(device.mac)
        if true is not None:
            axes.plot([device.x_m, true[0]], [device.y_m, true[1]], color=colour, lw=1, ls=":", zorder=7)
            axes.plot([true[0]], [true[1]], marker="x", ms=7, mec=colour, mew=1.8, ls="", zorder=7.5)
            taken.append(true)
        name = printable(device.name or device.mac)
        more = [] if device.radius90_m is None else [f"±{device.radius90_m:.2f} m"]
        more += [] if device.state == "mapped" else [device.state]
        labels.append(Label(device.x_m, device.y_m, "\n".join((name, ", ".join(more))).strip(), colour))
    place_labels(axes, labels, taken, [region.get_window_extent() for region in regions])


def _region(device: DeviceMessage, x_m: float, y_m: float) -> Patch | None:
    """The 90 % region: as given, else the Gaussian's ellipse, else the circle, else none."""
    if device.region90 is not None and len(device.region90) >= 3:
        return Polygon(device.region90)
    if device.covariance_m2 is not None:
        values, vectors = np.linalg.eigh(np.array(device.covariance_m2))
        minor, major = 2 * np.sqrt(CHI2_90_2DOF * np.maximum(values, 0))
        return Ellipse((x_m, y_m), major, minor, angle=math.degrees(math.atan2(vectors[1, 1], vectors[0, 1])))
    if device.radius90_m is not None:
        return Circle((x_m, y_m), device.radius90_m)
    return None


def _draw_head(figure: Figure, floor: Floor, title_y: float, line_y: float) -> None:
    plan = floor.plan
    left = 0.3 / figure.get_figwidth()
    mapped = sum(device.x_m is not None for device in floor.devices)
    figure.text(
        left, title_y, f"Wi-Fi devices of {printable(plan.hub) or 'the home'}",
        size=15, weight="bold", color=INK, va="center", parse_math=False,
    )  # fmt: skip
    sources = {plan.source, *(d.source for d in floor.devices), *(c.source for c in floor.cameras)} - {"live"}
    said = [f"{mapped} of {len(floor.devices)} on the map", f"map epoch {plan.epoch}"]
    said += [plan.published_at[:16].replace("T", " ") + " UTC"] if plan.published_at else []
    said += ["shaded: holds the device in 90 % of cases"] if mapped else []
    said += ["x: true place"] if floor.truth else []
    figure.text(left, line_y, "   ·   ".join(said), size=8.5, color=FAINT, va="center", parse_math=False)
    if sources:
        figure.text(
            1 - left, title_y, " + ".join(sorted(sources)).upper(),
            size=9, weight="bold", color="#ffffff", ha="right", va="center",
            bbox={"boxstyle": "round,pad=0.45", "fc": "#b4450c", "ec": "none"},
        )  # fmt: skip


def _draw_scale(axes: Axes, width_m: float) -> None:
    """A bar of a round length below the plan, right."""
    length_m = next((size for size in (5.0, 2.0, 1.0, 0.5) if size <= width_m / 4), 0.1)
    right, bottom = axes.get_xlim()[1], axes.get_ylim()[0]
    right -= 0.04 * width_m
    axes.plot(
        [right - length_m, right], [bottom, bottom], color=INK, lw=2.5, solid_capstyle="butt", clip_on=False
    )
    axes.annotate(
        f"{length_m:g} m", (right - length_m / 2, bottom), xytext=(0, -5), textcoords="offset points",
        ha="center", va="top", size=8, color=INK, annotation_clip=False,
    )  # fmt: skip


def _notes(floor: Floor) -> list[str]:
    """One line for each device that has no place, with its reason; at most eight."""
    nowhere = [device for device in floor.devices if device.x_m is None or device.y_m is None]
    lines = []
    for device in nowhere:
        why = f"{device.state}: {printable(device.reason)}" if device.reason else device.state
        lines.append(f"not on the map: {printable(device.name or device.mac)} ({why})")
    return lines if len(lines) <= 8 else [*lines[:7], f"and {len(lines) - 7} more that are not on the map"]
