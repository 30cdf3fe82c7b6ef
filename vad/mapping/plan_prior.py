"""Where devices are before anything is measured: near walls and furniture, hardly ever outside the plan."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vad.mapping.posterior import Grid, Posterior

FloatArray = NDArray[np.float64]

NEAR_M = 0.35
OPEN_FLOOR_SD_M = 0.5
OPEN_FLOOR_NATS = 1.1
"""On free floor up to NEAR_M from anything solid nothing is held against a place; farther out it grows, as
a lamp or a robot's own dock may stand anywhere."""

DEEP_M = 0.5
OUTSIDE_SD_M = 0.3
OUTSIDE_NATS = 4.0
"""So far into what is not free (furniture, a wall's inside, rooms the robot never saw) likewise."""


def plan_log_prior(free: NDArray[np.bool_], fine: Grid, grid: Grid) -> FloatArray:
    """log p(device), (rows, columns) of `grid`, up to a constant; 0 at the best places.

    free (fine.rows, fine.columns): where the plan shows free floor, on a grid fine enough to show walls.
    All 0 where the plan shows no free floor, or nothing else.
    """
    if free.all() or not free.any():
        return np.zeros((grid.rows, grid.columns))
    to_solid_m = cv2.distanceTransform(free.astype(np.uint8), cv2.DIST_L2, 5) * fine.step_m
    to_free_m = cv2.distanceTransform((~free).astype(np.uint8), cv2.DIST_L2, 5) * fine.step_m
    open_floor = 0.5 * (np.maximum(to_solid_m - NEAR_M, 0) / OPEN_FLOOR_SD_M) ** 2
    outside = 0.5 * (np.maximum(to_free_m - DEEP_M, 0) / OUTSIDE_SD_M) ** 2
    against = np.minimum(open_floor, OPEN_FLOOR_NATS) + np.minimum(outside, OUTSIDE_NATS)
    return Posterior(fine, -against.astype(np.float64)).on(grid).log_density
