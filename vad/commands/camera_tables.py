"""Tables of `vad camera`: how far a calibration is, and how far robot and camera differ."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table
from rich.text import Text

from vad.report.words import printable

if TYPE_CHECKING:
    from vad.mapping.camera_calibration import CameraCalibration, Deviations

_STYLES = {"valid": "green", "collecting": "yellow", "recalibrating": "yellow", "invalid": "red"}


@dataclass(frozen=True, slots=True)
class Row:
    """Deviations over a part of the floor, metres. bias_x_m, bias_y_m: mean of camera minus robot."""

    part: str
    pairs: int
    mean_m: float
    median_m: float
    p95_m: float
    worst_m: float
    bias_x_m: float
    bias_y_m: float


def rows_of(drive: Deviations, calibration: CameraCalibration) -> list[Row]:
    """One row for all, then by thirds of the picture, and near and far from the camera."""
    lens, position = calibration.intrinsics, calibration.position_m
    assert lens is not None
    assert position is not None
    third = np.clip((3.0 * drive.image_px[:, 0] / lens.width_px).astype(int), 0, 2)
    away_m = np.linalg.norm(drive.robot_m - position[:2], axis=1)
    middle_m = float(np.median(away_m)) if len(away_m) else 0.0
    parts = [("all", np.ones(len(third), dtype=np.bool_))]
    parts += [(f"{name} third", third == k) for k, name in enumerate(("left", "middle", "right"))]
    parts += [
        (f"nearer than {middle_m:.1f} m", away_m < middle_m),
        (f"from {middle_m:.1f} m on", away_m >= middle_m),
    ]
    rows = []
    for name, chosen in parts:
        error = (drive.camera_m - drive.robot_m)[chosen]
        off = np.linalg.norm(error, axis=1)
        if not len(off):
            continue
        values = (np.mean(off), np.median(off), np.percentile(off, 95), np.max(off), *np.mean(error, axis=0))
        rows.append(Row(name, len(off), *(round(float(v), 4) for v in values)))
    return rows


def check_table(rows: list[Row]) -> Table:
    """Deviation of robot and camera, in centimetres."""
    table = Table(
        title="robot against camera, cm", title_justify="left", header_style="bold", box=None, pad_edge=False
    )
    table.add_column("part of the picture")
    for name in ("pairs", "mean", "median", "95 %", "worst", "bias x", "bias y"):
        table.add_column(name, justify="right")
    for row in rows:
        plain = (row.mean_m, row.median_m, row.p95_m, row.worst_m)
        signed = (row.bias_x_m, row.bias_y_m)
        cells = [f"{100 * v:.1f}" for v in plain] + [f"{100 * v:+.1f}" for v in signed]
        table.add_row(row.part, str(row.pairs), *cells)
    return table


def check_json(rows: list[Row], agreeing: float, *, right: bool) -> dict[str, Any]:
    """The same for machines."""
    return {"right": right, "agreeing": round(agreeing, 3), "parts": [asdict(row) for row in rows]}


def progress_table(found: CameraCalibration, trouble: str = "", drive: Deviations | None = None) -> Table:
    """How the camera stands, what is missing, and every estimate with its uncertainty."""
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    bar = "█" * (found.percent // 5) + "░" * (20 - found.percent // 5)
    table.add_row("camera", Text(f"{found.status} {bar} {found.percent} %", _STYLES.get(found.status, "")))
    if found.reason:
        table.add_row("missing", Text(printable(found.reason)))
    if trouble:
        table.add_row("trouble", Text(printable(trouble), "red"))
    if found.pairs:
        unseen = f"; not seen: {', '.join(found.unseen)} third of the picture" if found.unseen else ""
        table.add_row("pairs", f"{found.pairs}{unseen}")
    position, doubt, lens = found.position_m, found.position_covariance, found.intrinsics
    if position is not None and doubt is not None:
        sigma = np.sqrt(np.diag(doubt))
        each = [f"{p:.2f} ±{s:.2f}" for p, s in zip(position, sigma, strict=True)]
        table.add_row("position", f"x {each[0]}  y {each[1]}  height {each[2]} m")
    if lens is not None:
        terms = f"k1 {lens.k1:+.3f}, k2 {lens.k2:+.3f}"
        table.add_row("lens", f"focal length {lens.fx_px:.0f} ±{found.focal_sigma_px:.0f} px, {terms}")
    if found.time_offset_s is not None and found.time_offset_sigma_s is not None:
        late = f"{1e3 * found.time_offset_s:.0f} ±{1e3 * found.time_offset_sigma_s:.0f} ms"
        table.add_row("poses late by", late)
    if found.deviation_m is not None:
        table.add_row("deviation", f"{100 * found.deviation_m:.1f} cm on average")
    if drive is not None and len(drive.robot_m):
        off = np.linalg.norm(drive.camera_m - drive.robot_m, axis=1)
        table.add_row("this drive", f"{len(off)} pairs, {100 * float(np.mean(off)):.1f} cm on average")
    return table


def result_json(found: CameraCalibration) -> dict[str, Any]:
    """A calibration for machines, without what only the daemon needs."""
    plain = found.to_dict()
    plain.pop("view")
    position = found.position_m
    plain["position_m"] = None if position is None else [round(float(v), 4) for v in position]
    return plain
