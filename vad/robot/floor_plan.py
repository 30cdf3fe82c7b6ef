"""The floor plan: an occupancy grid in the map frame, and the rooms on it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

UNKNOWN = -1
FREE = 0
OCCUPIED = 100


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """A named room. polygon: (K, 2) float64, metres, map frame, K >= 3, either direction, not closed."""

    name: str
    polygon: NDArray[np.float64]

    def __post_init__(self) -> None:
        shape = self.polygon.shape
        if len(shape) != 2 or shape[0] < 3 or shape[1] != 2 or not np.isfinite(self.polygon).all():
            raise ValueError("a room's polygon is an array (K, 2) of finite metres with K >= 3")

    def contains(self, x_m: float, y_m: float) -> bool:
        """Whether the point is inside (even-odd rule); a point on the border may fall on either side."""
        x, y = self.polygon[:, 0], self.polygon[:, 1]
        x_next, y_next = np.roll(x, -1), np.roll(y, -1)
        crosses = (y > y_m) != (y_next > y_m)
        rise = np.where(crosses, y_next - y, 1.0)
        left_of_edge = x_m < x + (y_m - y) / rise * (x_next - x)
        return bool(np.count_nonzero(crosses & left_of_edge) % 2)


@dataclass(frozen=True, slots=True, eq=False)
class FloorPlan:
    """The robot's map.

    epoch: changes when the robot's map does; resolution_m: side of a cell; origin: x_m, y_m, yaw_rad in the
    map frame of the outer corner of cell (0, 0); cells: (rows, cols) int8, row 0 at the bottom, -1 unknown,
    0 free, 100 occupied, between them the occupancy in percent; rooms: the first that contains a point wins;
    map_id: the robot's own name of this map, empty where it gives none.
    """

    epoch: int
    resolution_m: float
    origin: tuple[float, float, float]
    cells: NDArray[np.int8]
    rooms: tuple[Room, ...] = field(default=())
    map_id: str = ""

    def __post_init__(self) -> None:
        if self.cells.ndim != 2 or self.cells.dtype != np.int8 or self.cells.size == 0:
            raise ValueError("cells is a non-empty int8 array (rows, cols)")
        if self.cells.min() < UNKNOWN or self.cells.max() > OCCUPIED:
            raise ValueError("cells are -1 (unknown) or 0..100")
        if not (math.isfinite(self.resolution_m) and self.resolution_m > 0):
            raise ValueError("resolution_m is positive")
        if not all(math.isfinite(value) for value in self.origin):
            raise ValueError("origin is finite")

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """x_min, y_min, x_max, y_max of the grid's outer corners in the map frame."""
        rows, cols = self.cells.shape
        corners = self._map_from_grid(np.array([[0, 0], [cols, 0], [0, rows], [cols, rows]], np.float64))
        (x_min, y_min), (x_max, y_max) = corners.min(axis=0), corners.max(axis=0)
        return float(x_min), float(y_min), float(x_max), float(y_max)

    def map_from_cell(self, cells: NDArray[np.integer]) -> NDArray[np.float64]:
        """Centres (N, 2), x and y in metres, of cells (N, 2) given as row, column."""
        return self._map_from_grid(cells[:, ::-1].astype(np.float64) + 0.5)

    def cell_from_map(self, points_m: NDArray[np.float64]) -> NDArray[np.int64]:
        """Row, column (N, 2) of points (N, 2) in metres; may lie outside the grid (see `occupancy_at`)."""
        x_m, y_m, yaw_rad = self.origin
        along = points_m - (x_m, y_m)
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        grid = along @ np.array([[c, -s], [s, c]]) / self.resolution_m
        cells: NDArray[np.int64] = np.floor(grid[:, ::-1]).astype(np.int64)
        return cells

    def occupancy_at(self, points_m: NDArray[np.float64]) -> NDArray[np.int8]:
        """Cell values (N,) int8 at points (N, 2) in metres; unknown outside the grid."""
        row, col = self.cell_from_map(points_m).T
        rows, cols = self.cells.shape
        inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
        values = np.full(len(row), UNKNOWN, np.int8)
        values[inside] = self.cells[row[inside], col[inside]]
        return values

    def room_at(self, x_m: float, y_m: float) -> str | None:
        """The name of the room at a point in the map frame, if it is in one."""
        return next((room.name for room in self.rooms if room.contains(x_m, y_m)), None)

    def _map_from_grid(self, grid: NDArray[np.float64]) -> NDArray[np.float64]:
        """Grid coordinates (N, 2), columns and rows from the origin's corner, to metres in the map frame."""
        x_m, y_m, yaw_rad = self.origin
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        turned: NDArray[np.float64] = grid * self.resolution_m @ np.array([[c, s], [-s, c]]) + (x_m, y_m)
        return turned
