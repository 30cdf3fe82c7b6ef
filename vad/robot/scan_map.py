"""Laser scans at known poses -> an occupancy grid. Pure (Elfes 1989: log-odds along each beam)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vad.robot.floor_plan import FREE, OCCUPIED, UNKNOWN, FloorPlan

RESOLUTION_M = 0.05
MIN_RANGE_M = 0.15
MAX_RANGE_M = 5.0
GROW_CELLS = 80
MAX_CELLS = 4000
"""A side of 200 m; poses beyond it are damaged."""

HIT, PASS, LIMIT = 3, -1, 30
"""Added to a cell once per scan. What stood there long takes as long to forget."""
OCCUPIED_FROM, FREE_FROM = 4, -2


class ScanMap:
    """Grows with what is seen. The frame is the poses'."""

    def __init__(self) -> None:
        self.scans = 0
        self._odds = np.zeros((0, 0), np.int16)
        self._low = np.zeros(2, np.int64)  # cell (column, row) of the array's corner, counted from the origin

    def add(self, x_m: float, y_m: float, yaw_rad: float, ranges_m: NDArray[np.float64]) -> None:
        """One scan from a scanner at this pose. ranges_m: (N,), evenly around, counter-clockwise from its
        front; NaN where there is no echo."""
        bearing = yaw_rad + np.arange(len(ranges_m)) * (math.tau / len(ranges_m))
        good = (ranges_m >= MIN_RANGE_M) & (ranges_m <= MAX_RANGE_M)
        if not good.any():
            return
        way = np.stack([np.cos(bearing[good]), np.sin(bearing[good])], axis=1)
        ranges = ranges_m[good]
        along = np.arange(0.0, float(ranges.max()), RESOLUTION_M / 2)
        beams, steps = np.nonzero(along < ranges[:, None] - RESOLUTION_M)
        centre = np.array([x_m, y_m])
        hits = np.unique(_cells(centre + way * ranges[:, None]), axis=0)
        passed = np.unique(_cells(centre + way[beams] * along[steps, None]), axis=0)
        both = np.concatenate([hits, passed])
        if np.abs(both).max() > MAX_CELLS:
            return
        self._grow(both.min(axis=0), both.max(axis=0))
        self.scans += 1
        # A cell that is hit is not passed: the beam ends in it.
        change = np.zeros(self._odds.shape, np.int16)
        change[tuple((passed - self._low)[:, ::-1].T)] = PASS
        change[tuple((hits - self._low)[:, ::-1].T)] = HIT
        self._odds = np.clip(self._odds + change, -LIMIT, LIMIT)

    def floor_plan(self, epoch: int) -> FloorPlan | None:
        """What is known so far; None before the first scan."""
        if not self.scans:
            return None
        cells = np.full(self._odds.shape, UNKNOWN, np.int8)
        cells[self._odds <= FREE_FROM] = FREE
        cells[self._odds >= OCCUPIED_FROM] = OCCUPIED
        x_m, y_m = (float(v) * RESOLUTION_M for v in self._low)
        return FloorPlan(epoch, RESOLUTION_M, (x_m, y_m, 0.0), cells)

    def _grow(self, low: NDArray[np.int64], high: NDArray[np.int64]) -> None:
        """Make room, in large steps so that the plan's bounds seldom change."""
        size = np.array(self._odds.shape[::-1], np.int64)
        old_high = self._low + size if self._odds.size else low
        old_low = self._low if self._odds.size else low
        wanted_low = np.minimum(old_low, low // GROW_CELLS * GROW_CELLS)
        wanted_high = np.maximum(old_high, (high // GROW_CELLS + 1) * GROW_CELLS)
        if self._odds.size and (wanted_low == old_low).all() and (wanted_high == old_high).all():
            return
        wanted_low = wanted_low // GROW_CELLS * GROW_CELLS
        columns, rows = (wanted_high - wanted_low).tolist()
        grown = np.zeros((rows, columns), np.int16)
        if self._odds.size:
            column, row = (self._low - wanted_low).tolist()
            grown[row : row + size[1], column : column + size[0]] = self._odds
        self._odds, self._low = grown, wanted_low


def _cells(points_m: NDArray[np.float64]) -> NDArray[np.int64]:
    cells: NDArray[np.int64] = np.floor(points_m / RESOLUTION_M).astype(np.int64)
    return cells
