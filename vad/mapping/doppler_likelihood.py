"""Direct position determination with an uncertain track: ask the whole spectrogram about each candidate.

For a candidate R the walk predicts f_R(t) = -(kappa / lambda) d/dt L(t), L = |P T| + |P R| less what the
body's surface saves; the spectrogram's log-likelihood along that line is the candidate's (method.md 2).
Nothing in the line is exact: the track's errors seen from both ends, kappa, the body's surface, heights,
the clocks, and what limbs and walls do to the Doppler make a Gaussian deviation of known covariance. It is
summed over by Laplace's method: expectation-maximisation climbs to the likeliest deviation, as mean shift
does in a histogram, and the curvature there gives the volume. Neither end of the link is favoured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vad.mapping.doppler_line import LineModel, PredictedLines, predicted_lines
from vad.mapping.walk import WalkTrack
from vad.sensing.spectrogram import Spectrogram

FloatArray = NDArray[np.float64]

SPEED_OF_LIGHT_MPS = 299_792_458.0
_AT_ONCE = 256
"""Candidates whose matrices are worked on together: what fits a small machine's memory."""


@dataclass(frozen=True, slots=True)
class DopplerModel:
    """What is assumed of the walk and of its spectrogram.

    line: of the prediction; frame_step_s: between the frames that are asked; temper: how much a frame counts;
    kernels_hz: widths within which the ridge is looked for around the line, from first to last step;
    signal_share: probability that a frame holds the walker's ridge at all. Chosen on the plain-room
    recordings and on the simulated set-ups together.
    """

    line: LineModel = field(default_factory=LineModel)
    frame_step_s: float = 0.2
    temper: float = 1.4
    kernels_hz: tuple[float, ...] = (6.0, 4.0, 3.4)
    signal_share: float = 0.85


@dataclass(frozen=True, slots=True)
class _Tables:
    """What a frame says around each bin, (F, B): log-likelihood; share of it that is the ridge's; the ridge's
    frequency there; how sharp the likelihood is, 0..1 in units of the kernel's own."""

    log_likelihood: FloatArray
    ridge_share: FloatArray
    centre_hz: FloatArray
    sharpness: FloatArray


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

    anchor_m: (2,) the known end of the link, map frame; anchor_z_m its height where known. None when
    `should_stop` asked to give up.
    """
    model = model or DopplerModel()
    frames = asked_frames(spectrogram, walk, model.frame_step_s)
    if len(frames) == 0:
        return np.zeros(len(points_m))
    tables = [_tables(spectrogram, frames, width, model.signal_share) for width in model.kernels_hz]
    seen = walk.seen_at(spectrogram.t_ns[frames], model.line.smoothing_s)
    result = np.empty(len(points_m))
    for start in range(0, len(points_m), _AT_ONCE):
        if should_stop():
            return None
        chunk = slice(start, start + _AT_ONCE)
        lines = predicted_lines(
            points_m[chunk],
            seen,
            anchor_m,
            wavelength_m=wavelength_m,
            anchor_z_m=anchor_z_m,
            model=model.line,
        )
        result[chunk] = _evidence(lines, tables, spectrogram.f_hz, model)
    return result


def asked_frames(spectrogram: Spectrogram, walk: WalkTrack, step_s: float) -> NDArray[np.int64]:
    """Every step_s a frame (K,), where the walk is known and packets cover it."""
    hop_s = np.median(np.diff(spectrogram.t_ns)) / 1e9 if len(spectrogram.t_ns) > 1 else step_s
    frames = np.arange(0, len(spectrogram.t_ns), max(1, round(step_s / hop_s)))
    return frames[walk.covers(spectrogram.t_ns[frames]) & (spectrogram.weight[frames] > 0)]


def log_heard(points_m: FloatArray, walk: WalkTrack) -> FloatArray:
    """log of the mean over the walk of 1 / (d^2 + 1 m^2), d from candidate to walker; (G,).

    The walker's echo falls with the square of its distance from the device: that it was heard speaks for
    near candidates. Without it the answer depends on how far the map happens to reach (method.md 3).
    """
    places = walk.xy_m[:: max(1, len(walk.xy_m) // 100)]
    squared = ((points_m[:, None] - places[None]) ** 2).sum(axis=2)
    return np.asarray(np.log(np.mean(1 / (squared + 1), axis=1)))


def _tables(
    spectrogram: Spectrogram, frames: NDArray[np.int64], width_hz: float, signal_share: float
) -> _Tables:
    """A frame's power as a density of the ridge's frequency, under a Gaussian kernel of width_hz."""
    f_hz = spectrogram.f_hz
    power = spectrogram.power[frames] / len(f_hz)
    kernel = np.exp(-0.5 * ((f_hz[:, None] - f_hz[None]) / width_hz) ** 2)
    near = np.maximum(power @ kernel, 1e-12)
    centre_hz = (power * f_hz) @ kernel / near
    spread_hz2 = np.maximum((power * f_hz**2) @ kernel / near - centre_hz**2, 0.0)
    bins_wide = np.sqrt(2 * np.pi) * width_hz / (f_hz[1] - f_hz[0])
    ridge = signal_share * len(f_hz) * near / bins_wide
    likelihood = ridge + 1 - signal_share
    sharpness = np.clip(1 - spread_hz2 / width_hz**2, 0.05, 1.0)
    return _Tables(np.log(likelihood), ridge / likelihood, centre_hz, sharpness)


def _evidence(
    lines: PredictedLines, tables: list[_Tables], f_hz: FloatArray, model: DopplerModel
) -> FloatArray:
    """log of the evidence (G,), the deviation from each line summed over."""
    step_hz, frame = f_hz[1] - f_hz[0], np.arange(lines.f_hz.shape[1])
    covariance, deviation = lines.covariance_hz2, np.zeros_like(lines.f_hz)
    diagonal = np.arange(len(frame))

    def bins() -> NDArray[np.int64]:
        place = (lines.f_hz + deviation - f_hz[0]) / step_hz + 0.5
        return np.asarray(np.clip(place, 0, len(f_hz) - 1), dtype=np.int64)

    def whitened(root: FloatArray) -> FloatArray:
        matrix = covariance * root[:, :, None] * root[:, None, :]
        matrix[:, diagonal, diagonal] += 1
        return matrix

    at = bins()
    for table, width_hz in zip(tables, model.kernels_hz, strict=True):
        root = np.sqrt(model.temper * table.ridge_share[frame, at]) / width_hz
        off = (root * (table.centre_hz[frame, at] - lines.f_hz))[..., None]
        pull = root * np.linalg.solve(whitened(root), off)[..., 0]
        deviation = np.matmul(covariance, pull[..., None])[..., 0]
        at = bins()
    last = tables[-1]
    root = np.sqrt(model.temper * last.ridge_share[frame, at] * last.sharpness[frame, at])
    factor = np.linalg.cholesky(whitened(root / model.kernels_hz[-1]))
    log_volume = np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
    fit = model.temper * last.log_likelihood[frame, at].sum(axis=1)
    return np.asarray(fit - 0.5 * (pull * deviation).sum(axis=1) - log_volume)
