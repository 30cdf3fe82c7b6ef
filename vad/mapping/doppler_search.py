"""Where to ask the Doppler likelihood: coarsely everywhere, finely where it is worth it, at the right time.

Camera and CSI are stamped on one timeline: their offset is nearly always small, now and then far from it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from vad.mapping.doppler_likelihood import DopplerModel, doppler_log_likelihood, log_heard
from vad.mapping.posterior import Grid, Posterior
from vad.mapping.walk import WalkTrack
from vad.sensing.spectrogram import Spectrogram

FloatArray = NDArray[np.float64]

COARSE_STEP_M = 0.5
WORTH_NATS = 9.0
"""A coarse cell this far below the best one is not looked at more closely."""

OFFSETS_S = (-0.25, 0.0, 0.25)
USUAL_SD_S, UNUSUAL_SD_S = 0.08, 0.38
UNUSUAL_SHARE = 0.6
FINE_S = 0.07
REACH_S = 0.56
CELLS = 50
"""The time offset between camera and CSI: the best CELLS of the coarse grid at OFFSETS_S, each with half a
step of tolerance, are asked again every FINE_S up to REACH_S; what they prefer is held."""


@dataclass(frozen=True, slots=True)
class DopplerSearch:
    """One walk's spectrogram and track, to be asked about places. `should_stop`: gives up soon after."""

    spectra: Spectrogram
    walk: WalkTrack
    anchor_m: FloatArray
    wavelength_m: float
    anchor_z_m: float | None
    model: DopplerModel
    should_stop: Callable[[], bool]

    def at(
        self, points_m: FloatArray, offset_s: float, tolerance_s: float | None = None
    ) -> FloatArray | None:
        """log-likelihood (G,) of points_m (G, 2) if the walk is offset_s later than its stamps say, give or
        take tolerance_s; None when asked to stop."""
        model = self.model
        if tolerance_s is not None:
            model = replace(model, line=replace(model.line, late_sd_s=tolerance_s))
        return doppler_log_likelihood(
            self.spectra,
            self.walk.later(offset_s),
            self.anchor_m,
            points_m,
            wavelength_m=self.wavelength_m,
            anchor_z_m=self.anchor_z_m,
            model=model,
            should_stop=self.should_stop,
        )

    def over(self, grid: Grid, offset_s: float) -> FloatArray | None:
        """log-likelihood (G,) over a grid; None when asked to stop."""
        if grid.step_m >= COARSE_STEP_M:
            return self.at(grid.points_m, offset_s)
        coarse = Grid.over(grid.bounds_m, COARSE_STEP_M)
        rough = self.at(coarse.points_m, offset_s)
        if rough is None:
            return None
        shape = (coarse.rows, coarse.columns)
        result = Posterior(coarse, rough.reshape(shape)).on(grid).log_density.ravel()
        worth = (rough > rough.max() - WORTH_NATS).reshape(shape).astype(np.uint8)
        around = Posterior(coarse, cv2.dilate(worth, np.ones((3, 3), np.uint8)).astype(np.float64))
        near = around.on(grid).log_density.ravel() > 0.3
        close = self.at(grid.points_m[near], offset_s)
        if close is None:
            return None
        result = np.minimum(result, rough.max() - WORTH_NATS)
        result[near] = close
        return np.asarray(result)

    def time_offset_s(self, grid: Grid, offsets_s: tuple[float, ...] = OFFSETS_S) -> float | None:
        """How much later the walk is than its stamps say: the posterior mean over places and offsets; None
        when asked to stop. A single offset is taken as known."""
        if len(offsets_s) == 1:
            return offsets_s[0]
        points = Grid.over(grid.bounds_m, max(COARSE_STEP_M, grid.step_m)).points_m
        prior = log_heard(points, self.walk)
        rough = []
        for offset_s in offsets_s:
            found = self.at(points, offset_s, (offsets_s[1] - offsets_s[0]) / 2)
            if found is None:
                return None
            rough.append(found + prior)
        best = np.argsort(np.max(rough, axis=0))[-CELLS:]
        fine_s = np.arange(-REACH_S, REACH_S + 1e-9, FINE_S)
        log_weight = []
        for offset_s in fine_s.tolist():
            found = self.at(points[best], offset_s, FINE_S / 2)
            if found is None:
                return None
            log_weight.append(np.logaddexp.reduce(found + prior[best]) + _log_prior(offset_s))
        weight = np.exp(np.array(log_weight) - np.max(log_weight))
        return float(np.sum(weight * fine_s) / weight.sum())


def _log_prior(offset_s: float) -> float:
    usual = np.log((1 - UNUSUAL_SHARE) / USUAL_SD_S) - 0.5 * (offset_s / USUAL_SD_S) ** 2
    unusual = np.log(UNUSUAL_SHARE / UNUSUAL_SD_S) - 0.5 * (offset_s / UNUSUAL_SD_S) ** 2
    return float(np.logaddexp(usual, unusual))
