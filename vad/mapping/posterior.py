"""A probability over the map: a grid of log-densities, and what can be said from it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Bounds = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Grid:
    """Candidate places in the map frame: from (x0, y0) on, every step_m; row 0 at the lowest y."""

    x0_m: float
    y0_m: float
    step_m: float
    columns: int
    rows: int

    @classmethod
    def over(cls, bounds_m: Bounds, step_m: float) -> Grid:
        """The grid whose points cover [x0, x1] x [y0, y1] with both ends."""
        x0, y0, x1, y1 = bounds_m
        columns, rows = round((x1 - x0) / step_m) + 1, round((y1 - y0) / step_m) + 1
        return cls(x0, y0, step_m, max(columns, 2), max(rows, 2))

    @property
    def points_m(self) -> FloatArray:
        """All candidates (rows * columns, 2), row by row."""
        x = self.x0_m + self.step_m * np.arange(self.columns)
        y = self.y0_m + self.step_m * np.arange(self.rows)
        return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)

    @property
    def bounds_m(self) -> Bounds:
        """(x0, y0, x1, y1) of the outermost candidates."""
        return (
            self.x0_m,
            self.y0_m,
            self.x0_m + self.step_m * (self.columns - 1),
            self.y0_m + self.step_m * (self.rows - 1),
        )


@dataclass(frozen=True, slots=True)
class Posterior:
    """log_density (rows, columns): log p(device at the candidate | all evidence), up to a constant."""

    grid: Grid
    log_density: FloatArray

    @property
    def probability(self) -> FloatArray:
        """(rows, columns), sums to 1."""
        p = np.exp(self.log_density - self.log_density.max())
        return np.asarray(p / p.sum(), dtype=np.float64)

    def on(self, grid: Grid) -> Posterior:
        """The same on another grid of the same extent, by bicubic interpolation of the log-density."""
        x = (grid.x0_m + grid.step_m * np.arange(grid.columns) - self.grid.x0_m) / self.grid.step_m
        y = (grid.y0_m + grid.step_m * np.arange(grid.rows) - self.grid.y0_m) / self.grid.step_m
        across, up = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
        source = self.log_density.astype(np.float32)
        fine = cv2.remap(source, across, up, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return Posterior(grid, np.asarray(fine, dtype=np.float64))

    def mean_and_covariance(self) -> tuple[FloatArray, FloatArray]:
        """Mean (2,) m and covariance (2, 2) m^2; a cell's own extent is counted in."""
        p, points = self.probability.ravel(), self.grid.points_m
        mean = p @ points
        centred = points - mean
        cell = self.grid.step_m**2 / 12
        return mean, (centred * p[:, None]).T @ centred + cell * np.eye(2)

    def region(self, share: float) -> NDArray[np.bool_]:
        """Highest-density cells (rows, columns) that hold `share` of the probability."""
        p = self.probability
        order = np.argsort(p, axis=None)[::-1]
        held = np.cumsum(p.ravel()[order])
        mask = np.zeros(p.size, dtype=np.bool_)
        mask[order[: int(np.searchsorted(held, share)) + 1]] = True
        return mask.reshape(p.shape)

    def region_polygons_m(self, share: float) -> list[FloatArray]:
        """Outlines (K, 2) in metres of the region's parts, largest first; closed, map frame."""
        scale = 4  # outlines follow cell edges, not cell centres
        mask = self.region(share).astype(np.uint8).repeat(scale, axis=0).repeat(scale, axis=1)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        outlines = []
        for contour in sorted(contours, key=cv2.contourArea, reverse=True):
            simple = cv2.approxPolyDP(contour, scale / 4, closed=True)[:, 0, :].astype(np.float64)
            cell = (simple + 0.5) / scale - 0.5
            outlines.append(np.array([self.grid.x0_m, self.grid.y0_m]) + cell * self.grid.step_m)
        return outlines

    def radius_m(self, share: float) -> float:
        """The radius around the mean that holds `share` of the probability, never below half a cell."""
        mean, _ = self.mean_and_covariance()
        distance = np.linalg.norm(self.grid.points_m - mean, axis=1)
        order = np.argsort(distance)
        held = np.cumsum(self.probability.ravel()[order])
        reached = distance[order[min(int(np.searchsorted(held, share)), len(order) - 1)]]
        return float(max(reached, self.grid.step_m / 2))

    def fused(self, other: Posterior) -> Posterior:
        """The product with independent evidence on the same grid (method.md 4)."""
        if other.grid != self.grid:
            raise ValueError("posteriors on different grids cannot be multiplied")
        total = self.log_density + other.log_density
        return Posterior(self.grid, total - total.max())

    def tempered(self, share: float) -> Posterior:
        """The evidence counted as `share` of what it claims; 0 is a flat posterior."""
        return Posterior(self.grid, share * self.log_density)
