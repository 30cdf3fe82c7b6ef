"""`vad replay`: recorded sessions in, places and their errors out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.progress import Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from vad.capture.session import wrong_bounds
from vad.commands.console import EXIT_BAD_INPUT, EXIT_NOTHING, complain, err, out, print_json
from vad.errors import SessionError
from vad.mapping.device_stage import PlaceEstimate
from vad.mapping.posterior import Bounds
from vad.solve import Fused, Solved, fuse, solve_session

LIKELIHOOD = "spectrogram-likelihood"
PAPER = "paper-algorithm-1"


def replay(
    sessions: Annotated[list[Path], typer.Argument(help="Session folders.", show_default=False)],
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")] = False,
    fuse_walks: Annotated[bool, typer.Option("--fuse", help="Multiply the sessions of one device.")] = False,
    plot: Annotated[
        Path | None,
        typer.Option(help="Write spectrogram and likelihood map of each session as PNG into this folder."),
    ] = None,
    bounds: Annotated[
        str | None,
        typer.Option(
            metavar="X0,Y0,X1,Y1", help="Look for the device inside these bounds (m), not the session's."
        ),
    ] = None,
) -> None:
    """Place devices from recorded sessions, with the paper's method beside ours.

    Example:  vad replay recordings/* --fuse --plot pictures/

    Exit code 0: all sessions read; 2: some could not be read, or not to their end (one line each on standard
    error; what can be solved still is); 1: read, but no device could be placed.
    """
    limits = _parse_bounds(bounds)
    if plot is not None:
        _make_folder(plot)
    solved: list[Solved] = []
    broken: list[dict[str, str]] = []
    with Progress(
        TextColumn("[progress.description]{task.description}"),
        TimeElapsedColumn(),
        console=err,
        transient=True,
        disable=not err.is_terminal,
    ) as progress:
        task = progress.add_task("", total=len(sessions))
        for number, folder in enumerate(sessions, start=1):
            progress.update(task, description=f"solving {folder.name} ({number}/{len(sessions)})")
            try:
                one = solve_session(folder, limits)
                solved.append(one)
                for sentence in one.session.damage:
                    complain(f"{folder}: {sentence}")
                if plot is not None:
                    from vad.report.session_plot import plot_session  # matplotlib takes a second to import

                    plot_session(one, plot)
            except SessionError as error:
                broken.append({"folder": str(folder), "error": str(error)})
                complain(str(error))
    fused = fuse(solved) if fuse_walks else []
    if as_json:
        print_json(
            {
                "sessions": [_session_record(s) for s in solved],
                "fused": [_fused_record(f) for f in fused],
                "summary": _summary(solved),
                "unreadable": broken,
            }
        )
    elif solved:
        _print_tables(solved, fused)
    if broken or any(s.session.damage for s in solved):
        raise typer.Exit(EXIT_BAD_INPUT)
    if not any(s.place for s in solved):
        raise typer.Exit(EXIT_NOTHING)


def _parse_bounds(text: str | None) -> Bounds | None:
    if text is None:
        return None
    try:
        x0, y0, x1, y1 = (float(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not X0,Y0,X1,Y1 in metres", param_hint="--bounds") from None
    if wrong := wrong_bounds((x0, y0, x1, y1)):
        raise typer.BadParameter(wrong, param_hint="--bounds")
    return x0, y0, x1, y1


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise typer.BadParameter(f"{folder}: {error.strerror}", param_hint="--plot") from None


def _place_record(place: PlaceEstimate, height90_m: tuple[float, float] | None) -> dict[str, Any]:
    return {
        "x_m": round(float(place.xy_m[0]), 3),
        "y_m": round(float(place.xy_m[1]), 3),
        "covariance_m2": np.round(place.covariance_m2, 5).tolist(),
        "radius90_m": round(place.radius90_m, 3),
        "region90_m": [np.round(outline, 3).tolist() for outline in place.region90_m],
        "height90_m": None if height90_m is None else [_rounded(z_m) for z_m in height90_m],
    }


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


def _session_record(solved: Solved) -> dict[str, Any]:
    header = solved.session.header
    place: dict[str, Any] = {
        "x_m": None,
        "y_m": None,
        "covariance_m2": None,
        "radius90_m": None,
        "region90_m": None,
        "height90_m": None,
    }
    if solved.place is not None:
        place = _place_record(solved.place, solved.height90_m)
    paper = None
    if solved.paper_m is not None:
        paper = {
            "method": PAPER,
            "x_m": round(float(solved.paper_m[0]), 3),
            "y_m": round(float(solved.paper_m[1]), 3),
            "error_m": _rounded(solved.paper_error_m),
        }
    return {
        "session": header.id,
        "device": header.device.mac or header.device.name,
        "source": "simulated" if header.source == "simulated" else "replay",
        "method": LIKELIHOOD,
        "status": solved.evidence.status,
        "reason": solved.evidence.reason,
        **place,
        "error_m": _rounded(solved.error_m),
        "paper": paper,
        "notes": solved.session.notes,
    }


def _fused_record(fused: Fused) -> dict[str, Any]:
    return {
        "device": fused.device,
        "sessions": list(fused.sessions),
        "method": LIKELIHOOD,
        "status": fused.place.status,
        "reason": fused.place.reason,
        **_place_record(fused.place, fused.height90_m),
        "error_m": _rounded(fused.error_m),
    }


def _summary(solved: list[Solved]) -> dict[str, Any]:
    """Pooled errors by method, over the sessions whose truth is known."""
    summary: dict[str, Any] = {"sessions": len(solved), "refused": sum(s.place is None for s in solved)}
    for method, errors in (
        (LIKELIHOOD, [s.error_m for s in solved]),
        (PAPER, [s.paper_error_m for s in solved]),
    ):
        known = [e for e in errors if e is not None]
        if known:
            summary[method] = {
                "count": len(known),
                "median_m": round(float(np.median(known)), 3),
                "mean_m": round(float(np.mean(known)), 3),
                "p80_m": round(float(np.percentile(known, 80)), 3),
            }
    return summary


def _metres(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _print_tables(solved: list[Solved], fused: list[Fused]) -> None:
    table = Table(title="Sessions (m, map frame)")
    for name in ("session", "status", "x", "y", "±90 %", "error", "paper's error"):
        table.add_column(name, justify="left" if name in ("session", "status") else "right")
    for one in solved:
        place = one.place
        table.add_row(
            one.session.header.id,
            one.evidence.status
            if not one.evidence.reason
            else f"{one.evidence.status}: {one.evidence.reason}",
            _metres(None if place is None else float(place.xy_m[0])),
            _metres(None if place is None else float(place.xy_m[1])),
            _metres(None if place is None else place.radius90_m),
            _metres(one.error_m),
            _metres(one.paper_error_m),
        )
    out.print(table)
    if fused:
        table = Table(title="Fused by device")
        for name in ("device", "walks", "x", "y", "±90 %", "error"):
            table.add_column(name, justify="left" if name == "device" else "right")
        for group in fused:
            table.add_row(
                group.device,
                str(len(group.sessions)),
                _metres(float(group.place.xy_m[0])),
                _metres(float(group.place.xy_m[1])),
                _metres(group.place.radius90_m),
                _metres(group.error_m),
            )
        out.print(table)
    summary = _summary(solved)
    for method in (LIKELIHOOD, PAPER):
        if method in summary:
            line = summary[method]
            out.print(
                f"{method}: median {line['median_m']:.2f} m, mean {line['mean_m']:.2f} m, "
                f"80 % below {line['p80_m']:.2f} m ({line['count']} sessions)"
            )
    for one in solved:
        for note in one.session.notes:
            if note not in one.session.damage:  # said already
                err.print(f"{one.session.header.id}: {note}", style="yellow", markup=False, highlight=False)
