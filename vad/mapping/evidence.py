"""What walks say of one device, term by term, so that any number of them adds up at the same cost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vad.mapping.arrival_likelihood import arrival_log_likelihood
from vad.mapping.posterior import Grid, Posterior

FloatArray = NDArray[np.float64]

HEARD_SHARE = 1.0
HEARD_SHARE_WITH_PHASES = 0.75
"""How much the walker's loudness counts; less where the antennas' phases tell the range, too."""

DOPPLER_CORRELATION = 0.18
ARRIVAL_CORRELATION = 0.5
"""Walks through one room share their multipath and the walker's ways: n walks count as n / (1 + (n - 1) c)
independent ones (method.md 3). Chosen on the plain-room recordings so that 90 % regions keep their word."""


def joint_posterior(product: Posterior, walks: int) -> Posterior:
    """The posterior from the plain product of `walks` walks' posteriors, for devices without antennas to
    compare: what the daemon keeps of a device is this product and the count."""
    return product.tempered(1 / (1 + (walks - 1) * DOPPLER_CORRELATION))


@dataclass(frozen=True, slots=True)
class Terms:
    """Sums over `walks` walks on one grid of G candidates.

    doppler (G,): log-likelihood of the spectrograms; heard (G,): log of how loud the walks would have been;
    arrival (G, P, B, B) float32: see arrival_sums; None where the device has no antennas to compare.
    """

    grid: Grid
    walks: int
    doppler: FloatArray
    heard: FloatArray
    arrival: NDArray[np.float32] | None

    def plus(self, other: Terms) -> Terms:
        """Both together; ValueError for another grid."""
        if other.grid != self.grid:
            raise ValueError("evidence on different grids cannot be added")
        arrival = self.arrival if other.arrival is None else other.arrival
        if self.arrival is not None and other.arrival is not None:
            arrival = self.arrival + other.arrival
        return Terms(
            self.grid,
            self.walks + other.walks,
            self.doppler + other.doppler,
            self.heard + other.heard,
            arrival,
        )

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
