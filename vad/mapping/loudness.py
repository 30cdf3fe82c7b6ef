"""How loud the walker's echo is, from moment to moment: louder near either end of the link.

By the radar equation an echo's power falls with the squares of both its distances. Walls and the body's
turning bend that by some decibels for about a second at a time, and what the walls scatter flattens the fall:
how much of it is left differs from home to home and is summed over. What Doppler tells least, how far away
the device is on the far side of the walked floor, this tells.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vad.mapping.doppler_likelihood import asked_frames
from vad.mapping.doppler_line import LineModel
from vad.mapping.walk import WalkTrack
from vad.sensing.spectrogram import Spectrogram

FloatArray = NDArray[np.float64]

MIN_FRAMES = 5


@dataclass(frozen=True, slots=True)
class LoudnessModel:
    """Chosen on the plain-room recordings and the simulated set-ups together.

    slope, slope_sd: what is left of the radar equation's fall, 1 being all of it; level_sd_db, level_s: how
    far the level is off it, and for how long; white_share: of that variance, what differs from frame to
    frame; soft_m2: added to a squared distance to the device: heights, and that a body is no point; frame_s:
    between the frames that are asked.
    """

    slope: float = 0.45
    slope_sd: float = 0.2
    level_sd_db: float = 2.7
    level_s: float = 0.7
    white_share: float = 0.15
    soft_m2: float = 0.3
    frame_s: float = 0.2


def loudness_log_likelihood(
    spectra: Spectrogram,
    walk: WalkTrack,
    anchor_m: FloatArray,
    points_m: FloatArray,
    *,
    anchor_z_m: float | None = None,
    model: LoudnessModel | None = None,
) -> FloatArray:
    """log p(levels | device at each of points_m), (G,), up to a constant.

    anchor_m: (2,) the known end of the link, map frame; anchor_z_m its height where known. The level's zero
    is unknown and summed over.
    """
    model = model or LoudnessModel()
    frames = asked_frames(spectra, walk, model.frame_s)
    if len(frames) < MIN_FRAMES:
        return np.zeros(len(points_m))
    t_s = (spectra.t_ns[frames] - spectra.t_ns[frames[0]]) / 1e9
    lag_s = np.abs(t_s[:, None] - t_s[None])
    shape = (1 - model.white_share) * np.exp(-lag_s / model.level_s) + model.white_share * np.eye(len(t_s))
    factor = np.linalg.cholesky(shape) * model.level_sd_db
    ones = np.linalg.solve(factor, np.ones(len(t_s)))

    def whitened(values: FloatArray) -> FloatArray:
        """As independent noise of variance 1, (F, K), the zero of the level taken out."""
        told = np.linalg.solve(factor, values)
        return np.asarray(told - np.outer(ones, ones @ told / (ones @ ones)), dtype=np.float64)

    level = whitened(spectra.level_db[frames, None])[:, 0]
    fall = whitened(_fall_db(walk.position_m(spectra.t_ns[frames]), anchor_m, points_m, anchor_z_m, model))
    precision = (fall**2).sum(axis=0) + model.slope_sd**-2
    pull = fall.T @ level + model.slope / model.slope_sd**2
    return np.asarray(0.5 * pull**2 / precision - 0.5 * np.log(precision), dtype=np.float64)


def _fall_db(
    places_m: FloatArray,
    anchor_m: FloatArray,
    points_m: FloatArray,
    anchor_z_m: float | None,
    model: LoudnessModel,
) -> FloatArray:
    """The radar equation's level (F, G) for places_m (F, 2) of the walker, decibels."""
    line = LineModel()
    anchor_m2 = line.unknown_anchor_m2 if anchor_z_m is None else (anchor_z_m - line.torso_z_m) ** 2
    to_anchor_m2 = ((places_m - anchor_m) ** 2).sum(axis=1) + max(anchor_m2, _NO_POINT_M2)
    to_device_m2 = ((places_m[:, None] - points_m[None]) ** 2).sum(axis=2) + model.soft_m2
    return np.asarray(-10 * np.log10(to_anchor_m2[:, None] * to_device_m2), dtype=np.float64)


_NO_POINT_M2 = 0.05
"""A body is no point, near the known end either."""
