"""Direct position determination with an uncertain track: ask the whole spectrogram about each candidate.

For a candidate R the walk predicts f_R(t) = -(kappa / lambda) d/dt(|P T| + |P R|); the spectrogram's
log-likelihood along that line is the candidate's (method.md 2). The track is not exact: its errors, along
and across the path and in time, lengthen or shorten the path by a slowly varying deviation d(t). A hidden
Markov model over (d, d/dt) sums over all ways it may have gone: d/dt shifts the line in frequency, d is
held near zero, so that what the track says of the whole walk still counts. kappa, the share of the walker's
speed that the reflecting surface shows, is averaged over. Neither end of the link is favoured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vad.mapping.walk import WalkTrack
from vad.sensing.spectrogram import Spectrogram

FloatArray = NDArray[np.float64]

SPEED_OF_LIGHT_MPS = 299_792_458.0


@dataclass(frozen=True, slots=True)
class DopplerModel:
    """What is assumed of the walk. Heights are those of the ends above or below the torso: the first two
    where no height is known, device_off_torso_m (usual in a home) where the anchor's is.

    deviation_per_sigma: standard deviation of the path's deviation, in units of the track's stated sigma_m
    (two ends see the same error; recorded tracks understate their errors in time); correlation_s: how long
    its rate lasts. temper: the share of a frame's log-likelihood that counts, as neighbouring frames share
    their windows. Chosen on the plain-room recordings and on simulated homes together.
    """

    kappas: tuple[float, ...] = (0.86, 0.93, 1.0)
    torso_z_m: float = 1.05
    device_above_torso_m: float = 0.8
    device_off_torso_m: float = 0.4
    anchor_above_torso_m: float = 1.0
    deviation_per_sigma: float = 1.7
    min_deviation_m: float = 0.05
    max_deviation_m: float = 0.3
    correlation_s: float = 0.8
    smoothing_s: float = 0.4
    temper: float = 0.4
    frame_step_s: float = 0.1


@dataclass(frozen=True, slots=True)
class _Deviations:
    """The hidden states: deviation and rate on a grid (D, V), and how they go on in one frame."""

    rates_mps: FloatArray
    start: NDArray[np.float32]
    step: NDArray[np.float32]


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
    device_dz = model.device_above_torso_m if anchor_z_m is None else model.device_off_torso_m
    device_rate = _range_rate(position[:, None] - points_m[None], velocity, device_dz)
    return np.asarray(-(anchor_rate + device_rate) / wavelength_m)


def doppler_log_likelihood(
    spectrogram: Spectrogram,
    walk: WalkTrack,
    anchor_m: FloatArray,
    points_m: FloatArray,
    *,
    wavelength_m: float,
    anchor_z_m: float | None = None,
    model: DopplerModel | None = None,
    should_stop: Callable[[], bool] = lambda: False,
) -> FloatArray | None:
    """log p(spectrogram | device at each of points_m), (G,), up to a constant.

    anchor_m: (2,) the known end of the link, map frame. None when `should_stop` asked to give up.
    """
    model = model or DopplerModel()
    hop_ns = int(np.median(np.diff(spectrogram.t_ns))) if len(spectrogram.t_ns) > 1 else 50_000_000
    frames = np.arange(0, len(spectrogram.t_ns), max(1, round(model.frame_step_s * 1e9 / hop_ns)))
    frames = frames[walk.covers(spectrogram.t_ns[frames])]
    heard = spectrogram.log_likelihood[frames] * spectrogram.weight[frames, None]
    table = np.exp(model.temper * heard).astype(np.float32)
    sigma_m = float(np.median(walk.sigma_m))
    deviations = _deviations(model, sigma_m)
    line_hz = predicted_doppler_hz(
        points_m,
        walk.smoothed(model.smoothing_s),
        anchor_m,
        spectrogram.t_ns[frames],
        wavelength_m=wavelength_m,
        model=model,
        anchor_z_m=anchor_z_m,
    ).astype(np.float32)
    shift_hz = (-deviations.rates_mps / wavelength_m).astype(np.float32)
    scores = []
    for kappa in model.kappas:
        if should_stop():
            return None
        scores.append(_forward(table, spectrogram.f_hz, np.float32(kappa) * line_hz, shift_hz, deviations))
    stacked = np.array(scores)
    top = stacked.max()
    return np.asarray(np.log(np.mean(np.exp(stacked - top), axis=0) + 1e-300) + top)


def log_heard(points_m: FloatArray, walk: WalkTrack) -> FloatArray:
    """log of the mean over the walk of 1 / (d^2 + 1 m^2), d from candidate to walker; (G,).

    The walker's echo falls with the square of its distance from the device: that it was heard speaks for
    near candidates. Without it the answer depends on how far the map happens to reach (method.md 3).
    """
    places = walk.xy_m[:: max(1, len(walk.xy_m) // 100)]
    squared = ((points_m[:, None] - places[None]) ** 2).sum(axis=2)
    return np.asarray(np.log(np.mean(1 / (squared + 1), axis=1)))


def _deviations(model: DopplerModel, sigma_m: float) -> _Deviations:
    """A damped random motion of d with the stated standard deviations, on a grid of its values."""
    sigma_d = float(
        np.clip(model.deviation_per_sigma * sigma_m, model.min_deviation_m, model.max_deviation_m)
    )
    sigma_v = sigma_d / model.correlation_s
    values = np.linspace(-2.5 * sigma_d, 2.5 * sigma_d, 9)
    rates = np.linspace(-3 * sigma_v, 3 * sigma_v, 9)
    dt = model.frame_step_s
    keep = np.exp(-dt / model.correlation_s)
    spread = max(sigma_v * np.sqrt(1 - keep**2), 0.4 * (rates[1] - rates[0]))
    pull = (sigma_v / sigma_d) ** 2
    count = len(values) * len(rates)
    step = np.zeros((count, count), dtype=np.float32)
    for i, value in enumerate(values):
        for j, rate in enumerate(rates):
            to_rate = np.exp(-0.5 * ((rates - (keep * rate - pull * value * dt)) / spread) ** 2)
            to_rate /= to_rate.sum()
            place = (value + rate * dt - values[0]) / (values[1] - values[0])
            low = int(np.floor(place))
            for row, share in ((low, 1 - (place - low)), (low + 1, place - low)):
                if 0 <= row < len(values):
                    step[row * len(rates) : (row + 1) * len(rates), i * len(rates) + j] += share * to_rate
    start = np.exp(-0.5 * (values / sigma_d) ** 2)[:, None] * np.exp(-0.5 * (rates / sigma_v) ** 2)[None]
    return _Deviations(rates, (start / start.sum()).astype(np.float32).reshape(-1, 1), step)


def _forward(
    table: NDArray[np.float32],
    f_axis_hz: FloatArray,
    line_hz: NDArray[np.float32],
    shift_hz: NDArray[np.float32],
    deviations: _Deviations,
) -> FloatArray:
    """The forward algorithm for all candidates at once: log-evidence (G,).

    table (F, B): tempered likelihood; line_hz (F, G): undisturbed prediction; shift_hz (V,): by each rate.
    """
    candidates = line_hz.shape[1]
    step_hz = f_axis_hz[1] - f_axis_hz[0]
    belief = np.repeat(deviations.start, candidates, axis=1)
    total = np.zeros(candidates)
    rates = len(shift_hz)
    for k in range(len(table)):
        if k:
            belief = deviations.step @ belief
        bins = (line_hz[k][None] + shift_hz[:, None] - f_axis_hz[0]) / step_hz + 0.5
        seen = table[k][np.clip(bins, 0, table.shape[1] - 1).astype(np.int32)]
        belief.reshape(-1, rates, candidates)[...] *= seen[None]
        norm = belief.sum(axis=0)
        total += np.log(norm)
        belief /= norm
    return total


def _range_rate(offset_m: FloatArray, velocity_mps: FloatArray, dz_m: float) -> FloatArray:
    """d/dt of the distance for offsets (F, G, 2) at velocities (F, 2); (F, G)."""
    distance = np.sqrt(offset_m[..., 0] ** 2 + offset_m[..., 1] ** 2 + dz_m**2 + 1e-6)
    along = offset_m[..., 0] * velocity_mps[:, None, 0] + offset_m[..., 1] * velocity_mps[:, None, 1]
    return np.asarray(along / distance)
