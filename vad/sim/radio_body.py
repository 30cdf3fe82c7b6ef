"""Where a walking person scatters radio waves: torso, legs and arms as smooth functions of time.

The scenario's path is a table with 20 rows a second; a cubic B-spline through it is twice continuously
differentiable, so that the phase of an echo (110 rad per metre at 5.24 GHz) has no kinks which would ring
through a Doppler spectrogram. The spline stays within 1 mm of the table.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vad.sim.scenario import Walk

FloatArray = NDArray[np.float64]

FADE_S = 1.0
"""A person comes and goes by the door: the echo fades in and out over this time."""
TORSO_HALF_WIDTH_M, TORSO_HALF_DEPTH_M = 0.18, 0.13
TORSO_HEIGHT = 0.62
"""Height of the torso's scattering centre as a part of the body's height (1.05 m of 1.70 m)."""
_STRIDE = 0.8  # two steps, as a part of the height: the scenario's own gait
_HEADING_STEPS = 4  # rows either side over which the direction of travel is taken


@dataclass(frozen=True, slots=True)
class Limb:
    """A limb's scatterer: a pendulum along the heading, in step with the gait.

    along_m: swing; gait_rad: its phase against the gait; across_m: left of the centre line; height: as a
    part of the body's height; rcs_m2: radar cross section.
    """

    along_m: float
    gait_rad: float
    across_m: float
    height: float
    rcs_m2: float


LIMBS = (
    Limb(0.26, 0.0, 0.09, 0.20, 0.07),  # shanks
    Limb(0.26, np.pi, -0.09, 0.20, 0.07),
    Limb(0.12, 0.0, 0.10, 0.40, 0.08),  # thighs
    Limb(0.12, np.pi, -0.10, 0.40, 0.08),
    Limb(0.18, np.pi, 0.26, 0.60, 0.03),  # arms swing against the leg of their side
    Limb(0.18, 0.0, -0.26, 0.60, 0.03),
    Limb(0.04, np.pi, 0.18, 0.80, 0.10),  # shoulders turn with the arms
    Limb(0.04, 0.0, -0.18, 0.80, 0.10),
)


@dataclass(frozen=True, slots=True)
class BodyState:
    """A person at N instants: centre_m (N, 3) of the torso, heading (N, 2) unit, gait_rad (N,), fade (N,)."""

    centre_m: FloatArray
    heading: FloatArray
    gait_rad: FloatArray
    fade: FloatArray
    height_m: float

    def limbs_m(self) -> FloatArray:
        """Scattering centres of LIMBS, (N, len(LIMBS), 3)."""
        along, across = self.heading, np.stack([-self.heading[:, 1], self.heading[:, 0]], axis=1)
        out = np.empty((len(along), len(LIMBS), 3))
        for k, limb in enumerate(LIMBS):
            swing = limb.along_m * np.sin(self.gait_rad + limb.gait_rad)
            out[:, k, :2] = self.centre_m[:, :2] + swing[:, None] * along + limb.across_m * across
            out[:, k, 2] = limb.height * self.height_m
        return out

    def torso_m(self, transmitters_m: FloatArray, receivers_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Where the torso reflects from each transmitter (Q, 3) to each receiver (Q, 3).

        The torso is an upright elliptic cylinder; its reflecting point is where its surface is square to the
        bisector of both directions, 0.13-0.18 m in front of its centre. Returns points (N, Q, 3) and how
        broad the body is seen from there, 0..1 (N, Q). Straight between both ends there is no such point:
        it moves smoothly to the axis.
        """
        centre = self.centre_m[:, None, :]
        bisector = _unit(transmitters_m - centre)[..., :2] + _unit(receivers_m - centre)[..., :2]
        along = self.heading[:, None, :]
        forward = bisector[..., 0] * along[..., 0] + bisector[..., 1] * along[..., 1]
        left = bisector[..., 1] * along[..., 0] - bisector[..., 0] * along[..., 1]
        reach = np.sqrt((TORSO_HALF_DEPTH_M * forward) ** 2 + (TORSO_HALF_WIDTH_M * left) ** 2 + 0.02**2)
        ahead = TORSO_HALF_DEPTH_M**2 * forward / reach
        aside = TORSO_HALF_WIDTH_M**2 * left / reach
        points = np.repeat(centre, len(transmitters_m), axis=1)
        points[..., 0] += ahead * along[..., 0] - aside * along[..., 1]
        points[..., 1] += ahead * along[..., 1] + aside * along[..., 0]
        broad = np.abs(forward) / np.sqrt(forward**2 + left**2 + 0.05**2)
        return points, 0.7 + 0.3 * broad**2


def _unit(v: FloatArray) -> FloatArray:
    out: FloatArray = v / np.sqrt((v * v).sum(axis=-1, keepdims=True) + 1e-6)
    return out


class BodyTrack:
    """One walk as a function of time."""

    def __init__(self, walk: Walk) -> None:
        self.start_s, self.end_s, self._height_m = walk.start_s, walk.end_s, walk.height_m
        xy = walk.xy_m
        self._step_s = (walk.end_s - walk.start_s) / (len(xy) - 1)
        rows = np.arange(len(xy))
        travel = xy[np.minimum(rows + _HEADING_STEPS, len(xy) - 1)] - xy[np.maximum(rows - _HEADING_STEPS, 0)]
        heading = travel / np.maximum(np.linalg.norm(travel, axis=1, keepdims=True), 1e-9)
        way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
        table = np.column_stack([xy, heading, 2 * np.pi * way_m / (_STRIDE * walk.height_m)])
        self._table = np.concatenate([table[:1], table, table[-1:], table[-1:]])

    def at(self, t_s: FloatArray) -> BodyState:
        """The body at t_s (N,), all within start_s..end_s."""
        u = np.clip((t_s - self.start_s) / self._step_s, 0.0, len(self._table) - 4.0)
        i = u.astype(np.int64)
        f = (u - i)[:, None]
        p0, p1, p2, p3 = (self._table[i + k] for k in range(4))
        g = 1 - f
        rows = (p0 * g**3 + p1 * (3 * f**3 - 6 * f**2 + 4) + p2 * (3 * g**3 - 6 * g**2 + 4) + p3 * f**3) / 6
        gait = rows[:, 4]
        heading = rows[:, 2:4] / np.maximum(np.linalg.norm(rows[:, 2:4], axis=1, keepdims=True), 1e-9)
        # In a stride the trunk swings sideways once, and rises and hurries ahead twice.
        sway, surge = 0.015 * np.sin(gait), 0.012 * np.sin(2 * gait)
        centre = np.column_stack(
            [
                rows[:, 0] + surge * heading[:, 0] - sway * heading[:, 1],
                rows[:, 1] + surge * heading[:, 1] + sway * heading[:, 0],
                TORSO_HEIGHT * self._height_m + 0.015 * np.cos(2 * gait),
            ]
        )
        edge = np.clip(np.minimum(t_s - self.start_s, self.end_s - t_s) / FADE_S, 0.0, 1.0)
        return BodyState(centre, heading, gait, edge**2 * (3 - 2 * edge), self._height_m)
