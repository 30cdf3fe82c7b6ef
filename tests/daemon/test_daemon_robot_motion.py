"""Whether the robot drives, from noisy poses: it comes to rest, and stays at rest."""

from __future__ import annotations

import numpy as np
import pytest

from vad.daemon.robot_motion import RESTS_AFTER_NS, RobotMotion
from vad.robot.pose import RobotPose

S_NS = 1_000_000_000


def pose(t_s: float, x_m: float, y_m: float, sigma_m: float) -> RobotPose:
    return RobotPose(round(t_s * S_NS), x_m, y_m, 0.0, sigma_m, 0.02, 1, "slam")


def driven(rate_hz: float, noise_m: float, sigma_m: float, speed_m_s: float) -> list[tuple[float, bool]]:
    """(time, whether it drives) of a robot that stands for 30 s, drives for 20 s, and stands for 60 s."""
    rng = np.random.default_rng(1)
    motion, said = RobotMotion(), []
    for t_s in np.arange(0.0, 110.0, 1.0 / rate_hz).tolist():
        x, y = np.array([speed_m_s * np.clip(t_s - 30.0, 0.0, 20.0), 1.0]) + rng.normal(0.0, noise_m, 2)
        motion.add(pose(t_s, float(x), float(y), sigma_m))
        said.append((t_s, motion.moves(round(t_s * S_NS))))
    return said


@pytest.mark.parametrize(
    ("rate_hz", "noise_m", "sigma_m", "speed_m_s"),
    [(10.0, 0.015, 0.02, 0.3), (10.0, 0.0, 0.02, 0.05), (0.5, 0.01, 0.05, 0.2), (30.0, 0.03, 0.05, 0.2)],
)
def test_it_rests_while_it_stands_and_drives_while_it_drives(
    rate_hz: float, noise_m: float, sigma_m: float, speed_m_s: float
) -> None:
    said = driven(rate_hz, noise_m, sigma_m, speed_m_s)
    # Not before the second pose that is elsewhere; and while it drives slowly, not every pose is news.
    late_s = 2.0 / rate_hz + 0.15 / speed_m_s
    assert all(moves for t, moves in said if 30.0 + late_s < t <= 50.0)
    standing = [moves for t, moves in said if 5.0 < t < 30.0 or t > 50.0 + 2.0 / rate_hz + 4.0]
    assert not any(standing)


def test_one_wild_pose_is_no_drive() -> None:
    motion = RobotMotion()
    for t_s, x in enumerate((0.0, 0.0, 0.01, 0.0, 0.0, 7.0, 0.0, 0.01)):
        motion.add(pose(float(t_s), x, 0.0, 0.02))
    assert not motion.moves(7 * S_NS)
    assert motion.moves(RESTS_AFTER_NS - 1)


def test_without_poses_nothing_moves() -> None:
    assert not RobotMotion().moves(0)
