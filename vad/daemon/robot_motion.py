"""Whether the robot drives, told from poses that are noisy even while it stands."""

from __future__ import annotations

import numpy as np

from vad.robot.pose import RobotPose

RESTS_AFTER_NS = 3_000_000_000

# Two poses in a row so far from where it stood: away by this, or by so many standard deviations of the poses.
_AWAY_M, _AWAY_SIGMAS, _AWAY_MOST_M = 0.03, 3.0, 0.10
# Where it stands is the mean of what was said over about this long.
_MEMORY_NS = 3e9


class RobotMotion:
    """Feed every pose; `moves` says whether the robot drove within the last RESTS_AFTER_NS."""

    def __init__(self) -> None:
        self._stands_m = np.full(2, np.inf)
        self._away = True
        self._last_ns = 0
        self._moved_ns: int | None = None

    def add(self, pose: RobotPose) -> None:
        """One pose, map frame, at its own stamp."""
        xy_m = np.array([pose.x_m, pose.y_m])
        since_ns, self._last_ns = pose.t_ns - self._last_ns, pose.t_ns
        away_m = min(max(_AWAY_M, _AWAY_SIGMAS * pose.sigma_m), _AWAY_MOST_M)
        if np.linalg.norm(xy_m - self._stands_m) <= away_m:
            self._stands_m += (xy_m - self._stands_m) * min(since_ns / _MEMORY_NS, 0.5)
            self._away = False
        elif self._away:
            self._stands_m, self._moved_ns = xy_m, pose.t_ns
        else:
            self._away = True

    def moves(self, now_ns: int) -> bool:
        """Whether it drives, or stopped only just before `now_ns`."""
        return self._moved_ns is not None and now_ns - self._moved_ns < RESTS_AFTER_NS
