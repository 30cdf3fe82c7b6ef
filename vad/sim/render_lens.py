"""Frames of a scenario through a lens with radial distortion: pin-hole pictures, bent."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from vad.geometry import Intrinsics, undistort
from vad.sim.render import Renderer
from vad.sim.render_shapes import Image
from vad.sim.scenario import Scenario

# A lens may show more than this much of the pin-hole picture's size to each side; beyond it the edge repeats.
_WIDEST = 1.8


class LensRenderer:
    """Draws raw frames as a camera at the scenario's place sees them through `lens`.

    Args:
        scenario: its camera's place counts; the picture's size and focal length are the lens's.
        lens: pixels counted from the middle of the first one.
    """

    def __init__(self, scenario: Scenario, lens: Intrinsics, *, seed: int = 0) -> None:
        u, v = np.meshgrid(np.arange(lens.width_px, dtype=np.float64), np.arange(lens.height_px))
        straight = undistort(np.column_stack([u.ravel(), v.ravel()]), lens)
        rays = (straight - (lens.cx_px, lens.cy_px)) / (lens.fx_px, lens.fy_px)
        reach = np.minimum(np.nanmax(np.abs(rays), axis=0) * lens.fx_px, _WIDEST * lens.width_px / 2)
        # Whole, even sizes keep the pin-hole's principal point in the middle.
        width, height = (2 * int(np.ceil(side) + 2) for side in reach)
        pinhole = replace(scenario.camera, width_px=width, height_px=height, focal_px=lens.fx_px)
        self._renderer = Renderer(replace(scenario, camera=pinhole), seed=seed)
        at = rays * lens.fx_px + ((width - 1) / 2, (height - 1) / 2)
        grid = np.nan_to_num(at, nan=-1.0).reshape(lens.height_px, lens.width_px, 2).astype(np.float32)
        self._columns, self._rows = np.ascontiguousarray(grid[..., 0]), np.ascontiguousarray(grid[..., 1])

    def frame(self, t_s: float) -> Image:
        """The raw picture at t_s, (height, width, 3) uint8 BGR."""
        straight = self._renderer.frame(t_s)
        bent = cv2.remap(
            straight, self._columns, self._rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(bent, dtype=np.uint8)
