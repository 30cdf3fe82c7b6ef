"""The occupancy grid as a picture: map_server's greys, so that every image viewer shows a floor plan."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vad.errors import ProtocolError

FREE_GREY, UNKNOWN_GREY, OCCUPIED_GREY = 254, 205, 0


def grid_to_png(occupancy: NDArray[np.int8]) -> bytes:
    """PNG of an occupancy grid (formats.md section 6).

    occupancy: (height, width) int8, row 0 at the bottom (smallest y), 0 free, 100 occupied, -1 unknown; what
    lies between counts as occupied from 65 on, as free up to 19, else as unknown. The picture's first row is
    the top of the plan.
    """
    grey = np.full(occupancy.shape, UNKNOWN_GREY, np.uint8)
    grey[(occupancy >= 0) & (occupancy <= 19)] = FREE_GREY
    grey[occupancy >= 65] = OCCUPIED_GREY
    encoded, data = cv2.imencode(".png", np.ascontiguousarray(grey[::-1]))
    if not encoded:
        raise ValueError(f"a grid of {occupancy.shape} cells cannot become a picture")
    return data.tobytes()


def png_to_grid(png: bytes) -> NDArray[np.int8]:
    """The (height, width) int8 grid that `grid_to_png` wrote, row 0 at the bottom; else ProtocolError."""
    if not png:
        raise ProtocolError("the map grid is empty")
    grey = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
    if grey is None:
        raise ProtocolError("the map grid is not a picture")
    grid = np.full(grey.shape, -1, np.int8)
    grid[grey == FREE_GREY] = 0
    grid[grey == OCCUPIED_GREY] = 100
    return grid[::-1]
