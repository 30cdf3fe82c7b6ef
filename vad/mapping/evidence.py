"""What walks say of one device, term by term, so that any number of them adds up at the same cost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vad.mapping.arrival_likelihood import arrival_log_likelihood
from vad.mapping.doppler_line import LineModel
from vad.mapping.height import height_range_m
from vad.mapping.posterior import Grid, Posterior

FloatArray = NDArray[np.float64]

HEARD_SHARE = 1.0
HEARD_SHARE_WITH_PHASES = 0.75
"""How much the walker's loudness counts; less where the antennas' phases tell the range, too."""

DOPPLER_CORRELATION = 0.18
ARRIVAL_CORRELATION = 0.5
"""Walks through one room share their multipath and the walker's ways: n walks count as n / (1 + (n - 1) c)
independent ones (method.md 3). Chosen on the plain-room recordings so that 90 % regions keep their word."""


@dataclass(frozen=True, slots=True)
class Terms:
    """Sums over `walks` walks on one grid of G candidates.

    doppler (G,): log-likelihood of the spectrograms and of how their loudness changes; heard (G,): log of how
    loud the walks would have been; arrival (G, P, B, B) float32: see arrival_sums; None where the device has
    no antennas to compare; height (7,): see height_log_likelihood; None where no walk could tell.
    """

    grid: Grid
    walks: int
    doppler: FloatArray
    heard: FloatArray
    arrival: NDArray[np.float32] | None = None
    height: FloatArray | None = None

    def plus(self, other: Terms) -> Terms:
        """Both together; ValueError for another grid."""
        if other.grid != self.grid:
            raise ValueError("evidence on different grids cannot be added")
        arrival = self.arrival if other.arrival is None else other.arrival
        if self.arrival is not None and other.arrival is not None:
            arrival = self.arrival + other.arrival
        height = self.height if other.height is None else other.height
        if self.height is not None and other.height is not None:
            height = self.height + other.height
        return Terms(
            self.grid,
            self.walks + other.walks,
            self.doppler + other.doppler,
            self.heard + other.heard,
            arrival,
            height,
        )

    def compact(self, grid: Grid) -> Terms:
        """The same on a grid of the same extent, what the antennas tell taken as more of Doppler's: small
        enough to keep. Of several walks of one device the antennas' places are then not held in common."""
        told, heard = self.doppler, self.heard
        if self.arrival is not None:
            told = told + arrival_log_likelihood(self.arrival)
            heard = HEARD_SHARE_WITH_PHASES * heard
        fine = [
            Posterior(self.grid, part.reshape(self.grid.rows, self.grid.columns)).on(grid).log_density.ravel()
            for part in (told - told.max(), heard)
        ]
        return Terms(grid, self.walks, fine[0], fine[1], height=self.height)

    def height_range_m(self) -> tuple[float, float] | None:
        """Lowest and highest height above the floor, 90 %, metres; None where it is not told."""
        if self.height is None:
            return None
        share = 1 / (1 + (self.walks - 1) * DOPPLER_CORRELATION)
        return height_range_m(share * self.height, LineModel().torso_z_m)

    def log_density(self) -> FloatArray:
        """log p(device at each candidate | all walks), (G,), up to a constant that walks share."""
        n = self.walks
        heard_share = HEARD_SHARE if self.arrival is None else HEARD_SHARE_WITH_PHASES
        total = self.doppler / (1 + (n - 1) * DOPPLER_CORRELATION) + heard_share * self.heard / n
        if self.arrival is not None:
            total = total + arrival_log_likelihood(
                self.arrival, weight=1 / (1 + (n - 1) * ARRIVAL_CORRELATION)
            )
        return np.asarray(total, dtype=np.float64)

    def posterior(self, grid: Grid) -> Posterior:
        """The same as a posterior on a grid of the same extent."""
        total = self.log_density()
        return Posterior(self.grid, (total - total.max()).reshape(self.grid.rows, self.grid.columns)).on(grid)
