"""Direct position determination: ask the whole spectrogram about each candidate place (method.md 2).

For a candidate R the walk predicts f_R(t) = -(kappa / lambda) d/dt(|P T| + |P R|); the log-likelihood of
the spectrogram along that line, summed over time, is the candidate's. Nuisances that a home never tells
are averaged over: the time offset between camera and CSI, and kappa, the share of the walker's speed
that the reflecting surface shows. Neither end of the link is favoured: T may send or receive.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vad.mapping.posterior import Grid, Posterior
from vad.mapping.walk import WalkTrack
from vad.sensing.spectrogram import Spectrogram

FloatArray = NDArray[np.float64]

SPEED_OF_LIGHT_MPS = 299_792_458.0


@dataclass(frozen=True, slots=True)
class DopplerModel:
    """What is assumed of the walk. Heights are those of the ends above or below the torso.

    temper: the share of a 0.1 s frame's log-likelihood that counts, as neighbouring frames share their
    windows and the track's errors last longer than a frame. Chosen on the plain-room recordings so that
    the 90 % region holds the truth in about 90 % of walks.
    """

    kappas: tuple[float, ...] = (0.86, 0.93, 1.0)
    offsets_s: tuple[float, ...] = (-0.3, -0.2, -0.1, 0.0, 0.1, 0.2, 0.3)
    torso_z_m: float = 1.05
    device_above_torso_m: float = 0.8
    anchor_above_torso_m: float = 1.0
    temper: float = 0.25
    frame_step_s: float = 0.1


def predicted_doppler_hz(
    points_m: FloatArray,
    walk: WalkTrack,
    anchor_m: FloatArray,
    t_ns: NDArray[np.int64],
    *,
    wavelength_m: float,
    model: DopplerModel,
    anchor_z_m: float | None = None,
) -> FloatArray:
    """f_R(t) for kappa = 1: (F, G) for candidates points_m (G, 2) at times t_ns (F,), map frame."""
    position, velocity = walk.position_m(t_ns), walk.velocity_mps(t_ns)
    anchor_dz = model.anchor_above_torso_m if anchor_z_m is None else anchor_z_m - model.torso_z_m
    anchor_rate = _range_rate(position[:, None] - anchor_m, velocity, anchor_dz)
    device_rate = _range_rate(position[:, None] - points_m[None], velocity, model.device_above_torso_m)
    return np.asarray(-(anchor_rate + device_rate) / wavelength_m)


def doppler_posterior(
    spectrogram: Spectrogram,
    walk: WalkTrack,
    anchor_m: FloatArray,
    grid: Grid,
    *,
    carrier_hz: float,
    anchor_z_m: float | None = None,
    model: DopplerModel | None = None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Posterior | None:
    """The device's posterior from one walk, under a flat prior over `grid` but for the range (`_log_heard`).

    anchor_m: (2,) the known end of the link, map frame. None when `should_stop` asked to give up.
    """
    model = model or DopplerModel()
    wavelength_m = SPEED_OF_LIGHT_MPS / carrier_hz
    hop_ns = int(np.median(np.diff(spectrogram.t_ns))) if len(spectrogram.t_ns) > 1 else 50_000_000
    stride = max(1, round(model.frame_step_s * 1e9 / hop_ns))
    frames = np.arange(0, len(spectrogram.t_ns), stride)
    weighted = spectrogram.log_likelihood[frames] * spectrogram.weight[frames, None]
    table = np.asarray(weighted, dtype=np.float32)
    t_ns = spectrogram.t_ns[frames]
    points = grid.points_m
    scores = []
    for offset_s in model.offsets_s:
        shifted = t_ns + int(offset_s * 1e9)
        inside = walk.covers(shifted)
        if not inside.any():
            continue
        f_hz = predicted_doppler_hz(
            points,
            walk,
            anchor_m,
            shifted[inside],
            wavelength_m=wavelength_m,
            model=model,
            anchor_z_m=anchor_z_m,
        )
        for kappa in model.kappas:
            if should_stop():
                return None
            # As many frames for each offset, or an offset that leaves the track would win by saying less.
            scores.append(_along(table[inside], spectrogram.f_hz, kappa * f_hz) * (len(t_ns) / inside.sum()))
    stacked = model.temper * np.array(scores)
    top = stacked.max()
    total = np.log(np.mean(np.exp(stacked - top), axis=0)) + top
    total += _log_heard(points, walk)
    return Posterior(grid, (total - total.max()).reshape(grid.rows, grid.columns))


def _log_heard(points_m: FloatArray, walk: WalkTrack) -> FloatArray:
    """log of the mean over the walk of 1 / (d^2 + 1 m^2), d from candidate to walker; (G,).

    The walker's echo falls with the square of its distance from the device: that it was heard speaks for
    near candidates. Without it the answer depends on how far the map happens to reach (method.md 3).
    """
    places = walk.xy_m[:: max(1, len(walk.xy_m) // 100)]
    squared = ((points_m[:, None] - places[None]) ** 2).sum(axis=2)
    return np.asarray(np.log(np.mean(1 / (squared + 1), axis=1)))


def _along(table: NDArray[np.float32], f_axis_hz: FloatArray, f_hz: FloatArray) -> FloatArray:
    """Sum over frames of the table (F, B) at f_hz (F, G), linear between bins; (G,)."""
    step_hz = f_axis_hz[1] - f_axis_hz[0]
    bins = np.clip((f_hz - f_axis_hz[0]) / step_hz, 0, len(f_axis_hz) - 1.001).astype(np.float32)
    low = bins.astype(np.int32)
    share = bins - low
    rows = np.arange(len(table), dtype=np.int32)[:, None] * table.shape[1]
    flat = table.ravel()
    index = rows + low
    return np.asarray((flat[index] * (1 - share) + flat[index + 1] * share).sum(axis=0), dtype=np.float64)


def _range_rate(offset_m: FloatArray, velocity_mps: FloatArray, dz_m: float) -> FloatArray:
    """d/dt of the distance for offsets (F, G, 2) at velocities (F, 2); (F, G)."""
    distance = np.sqrt(offset_m[..., 0] ** 2 + offset_m[..., 1] ** 2 + dz_m**2 + 1e-6)
    along = offset_m[..., 0] * velocity_mps[:, None, 0] + offset_m[..., 1] * velocity_mps[:, None, 1]
    return np.asarray(along / distance)
