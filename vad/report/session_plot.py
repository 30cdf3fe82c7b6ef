"""Two pictures of a solved session: what the radio saw over time, and where the device may be."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from vad.mapping.doppler_likelihood import SPEED_OF_LIGHT_MPS
from vad.mapping.doppler_line import predicted_doppler_hz
from vad.solve import Solved, walk_of

mpl.use("Agg")


def plot_session(solved: Solved, folder: Path) -> list[Path]:
    """Write <id>_spectrogram.png and <id>_map.png into folder (made if absent); the paths written.

    A refused session has no map, and no spectrogram where its packets could not make one.
    """
    folder.mkdir(parents=True, exist_ok=True)
    name = solved.session.header.id
    written = []
    if solved.evidence.spectrogram is not None:
        written.append(folder / f"{name}_spectrogram.png")
        _spectrogram_figure(solved).savefig(written[-1], dpi=110)
    if solved.evidence.posterior is not None:
        written.append(folder / f"{name}_map.png")
        _map_figure(solved).savefig(written[-1], dpi=110)
    return written


def _spectrogram_figure(solved: Solved) -> Figure:
    session, evidence = solved.session, solved.evidence
    spectrogram = evidence.spectrogram
    assert spectrogram is not None
    figure = Figure(figsize=(9, 4), layout="constrained")
    axes = figure.add_subplot()
    start_ns = session.t_ns[0]
    t_s = (spectrogram.t_ns - start_ns) / 1e9
    picture = axes.pcolormesh(
        t_s, spectrogram.f_hz, 10 * np.log10(spectrogram.power.T + 1e-3), cmap="magma", vmin=-10, vmax=13
    )
    figure.colorbar(picture, ax=axes, label="power above the frame's mean (dB)")
    if evidence.path is not None:
        axes.plot(t_s, evidence.path.f_hz, color="white", lw=0.8, label="ridge found")
    walk, anchor = walk_of(session), session.header.anchor
    inside = np.flatnonzero(walk.covers(spectrogram.t_ns))
    estimate_m = None if solved.place is None else solved.place.xy_m
    places = [("truth", session.truth_m, "lime"), ("estimate", estimate_m, "cyan")]
    for name, place_m, colour in places:
        if place_m is None or not len(inside):
            continue
        f_hz = predicted_doppler_hz(
            place_m[None],
            walk,
            np.array([anchor.x_m, anchor.y_m]),
            spectrogram.t_ns[inside],
            wavelength_m=SPEED_OF_LIGHT_MPS / session.header.radio.carrier_hz,
            anchor_z_m=anchor.z_m,
        )
        axes.plot(t_s[inside], f_hz[:, 0], color=colour, lw=1.2, ls="--", label=f"predicted for the {name}")
    axes.set(
        xlabel="time (s)", ylabel="Doppler shift (Hz)", title=f"{session.header.id}: Doppler", ylim=(-60, 60)
    )
    axes.legend(loc="upper right", fontsize=8)
    return figure


def _map_figure(solved: Solved) -> Figure:
    session, posterior, place = solved.session, solved.evidence.posterior, solved.place
    assert posterior is not None
    assert place is not None
    figure = Figure(figsize=(6.6, 6), layout="constrained")
    axes = figure.add_subplot()
    x0, y0, x1, y1 = posterior.grid.bounds_m
    half = posterior.grid.step_m / 2
    picture = axes.imshow(
        np.maximum(posterior.log_density, -12),
        origin="lower",
        extent=(x0 - half, x1 + half, y0 - half, y1 + half),
        cmap="viridis",
    )
    figure.colorbar(picture, ax=axes, label="log-likelihood below the best", shrink=0.8)
    for outline in place.region90_m:
        closed = np.vstack([outline, outline[:1]])
        axes.plot(closed[:, 0], closed[:, 1], color="white", lw=1)
    axes.plot(session.walk_xy_m[:, 0], session.walk_xy_m[:, 1], color="orange", lw=1.5, label="walk")
    axes.plot(session.header.anchor.x_m, session.header.anchor.y_m, "^", color="white", ms=9, label="anchor")
    axes.plot(*place.xy_m, "o", color="cyan", ms=8, label=f"estimate (±{place.radius90_m:.2f} m, 90 %)")
    if solved.paper_m is not None:
        axes.plot(*solved.paper_m, "s", color="violet", ms=7, label="paper's Algorithm 1")
    if session.truth_m is not None:
        axes.plot(*session.truth_m, "*", color="red", ms=13, label="truth")
    title = (
        session.header.id if solved.error_m is None else f"{session.header.id}: error {solved.error_m:.2f} m"
    )
    axes.set(
        xlabel="x (m)", ylabel="y (m)", title=title, xlim=(x0 - half, x1 + half), ylim=(y0 - half, y1 + half)
    )
    axes.legend(loc="upper right", fontsize=8)
    return figure
