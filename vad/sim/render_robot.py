"""The robot vacuum as solid parts: a dark disc with bumper, lid and laser turret."""

from __future__ import annotations

import numpy as np

from vad.geometry import FloatArray
from vad.sim.render_shapes import Part
from vad.sim.scenario import ROBOT_HEIGHT_M, ROBOT_RADIUS_M

_BODY, _BUMPER, _LID, _TURRET, _BUTTON = (
    (44.0, 44.0, 48.0),
    (26.0, 26.0, 28.0),
    (70.0, 70.0, 76.0),
    (30.0, 30.0, 33.0),
    (210.0, 215.0, 220.0),
)
_EDGE_M = 0.012


def robot_parts(x_m: float, y_m: float, yaw_rad: float) -> list[Part]:
    """The parts of the robot at a pose in the map; its bumper is ahead."""
    angles = yaw_rad + np.linspace(0.0, 2 * np.pi, 28, endpoint=False)
    front = yaw_rad + np.linspace(-1.2, 1.2, 12)
    ahead = np.array([np.cos(yaw_rad), np.sin(yaw_rad)])
    middle = np.array([x_m, y_m])
    lid_m = ROBOT_HEIGHT_M - 0.02

    def disc(
        turn: FloatArray, radius_m: float, low_m: float, high_m: float, centre: FloatArray
    ) -> FloatArray:
        ring = centre + radius_m * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        return np.concatenate([np.column_stack([ring, np.full(len(ring), z)]) for z in (low_m, high_m)])

    def part(points: FloatArray, radius_m: float, rgb: tuple[float, float, float], order_m: float) -> Part:
        return Part(points, np.full(len(points), radius_m), rgb, order_m)

    rim_m = ROBOT_RADIUS_M - _EDGE_M
    behind = middle - 0.04 * ahead
    return [
        part(disc(angles, rim_m, 0.015, lid_m - _EDGE_M, middle), _EDGE_M, _BODY, 0.0),
        part(disc(front, rim_m + 0.002, 0.02, lid_m - 0.025, middle), _EDGE_M, _BUMPER, 0.0),
        part(disc(angles, rim_m - 0.01, lid_m, lid_m, middle), 0.004, _LID, -0.5),
        part(disc(angles, 0.045, lid_m, ROBOT_HEIGHT_M - 0.004, behind), 0.004, _TURRET, -0.7),
        part(disc(angles, 0.012, lid_m, lid_m, middle + 0.09 * ahead), 0.003, _BUTTON, -0.7),
    ]
