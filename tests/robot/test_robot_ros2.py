"""ROS 2: topic names, TF composition, stamps on the timeline, floor plans, what is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
import ros2_messages as ros
from hypothesis import given
from hypothesis import strategies as st

from vad.errors import ConfigError, ProtocolError
from vad.robot.cdr import Transform
from vad.robot.ros2 import Frames, RobotClock, Ros2Reader
from vad.robot.ros2_keys import key_expression, topic_name
from vad.robot.tf_tree import compose

S = 1_000_000_000
WALL_NS = 1_800_000_000 * S


def test_topics_become_both_kinds_of_keys() -> None:
    kind = "nav_msgs/msg/OccupancyGrid"
    full = topic_name("map", "kitchen/robot1")
    assert full == "kitchen/robot1/map"
    assert key_expression(full, kind, style="bridge", domain=3) == "kitchen/robot1/map"
    assert (
        key_expression(full, kind, style="rmw_zenoh", domain=3)
        == "3/kitchen/robot1/map/nav_msgs::msg::dds_::OccupancyGrid_/*"
    )
    assert topic_name("/tf", "robot1") == "tf"
    assert topic_name("tf", "/robot1") == "robot1/tf"
    for bad in ("", "a//b", "a b", "map/*", "1map"):
        with pytest.raises(ConfigError):
            topic_name(bad, "")


angles = st.floats(-math.pi, math.pi)
metres = st.floats(-50, 50)


def planar(x: float, y: float, yaw: float) -> Transform:
    return Transform(x, y, 0.0, 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))


def matrix(t: Transform) -> np.ndarray:
    x, y, z, w = t.qx, t.qy, t.qz, t.qw
    m = np.eye(4)
    m[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    m[:3, 3] = t[:3]
    return m


spatial = st.builds(
    lambda p, q: Transform(*p, *(np.array(q) / np.linalg.norm(q))),
    st.tuples(metres, metres, metres),
    st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
)


@given(spatial, spatial)
def test_composition_is_the_product_of_matrices(a: Transform, b: Transform) -> None:
    np.testing.assert_allclose(matrix(compose(a, b)), matrix(a) @ matrix(b), atol=1e-9)


def test_map_odom_base_give_the_pose_of_the_wheels_newest_message() -> None:
    reader = Ros2Reader(Frames(base=("base_footprint", "base_link")), epoch=4)
    static = ros.tf(("base_link", "base_footprint", 0.1, 0.0, 0.0), stamp_ns=0)
    assert reader.pose("tf_static", static, 0) is None
    assert reader.pose("tf", ros.tf(("odom", "base_link", 1.0, 0.0, 0.5), stamp_ns=WALL_NS), S) is None
    assert reader.status == "not_localised"
    assert "SLAM" in reader.reason
    # AMCL dates its correction into the future; the wheels' stamp is the pose's.
    ahead = ros.tf(("map", "odom", 2.0, 3.0, math.pi / 2), stamp_ns=WALL_NS + S)
    assert reader.pose("tf", ahead, S + 10) is not None
    pose = reader.pose(
        "tf", ros.tf(("odom", "base_link", 1.0, 0.0, 0.5), stamp_ns=WALL_NS + S // 10), 11 * S // 10
    )
    assert pose is not None
    assert (pose.quality, pose.frame, pose.epoch, reader.status) == ("slam", "map", 4, "localised")
    assert pose.x_m == pytest.approx(2.0 - 0.1 * math.sin(0.5))
    assert pose.y_m == pytest.approx(3.0 + 1.0 + 0.1 * math.cos(0.5))
    assert pose.yaw_rad == pytest.approx(math.pi / 2 + 0.5)
    # The same wheels again, with a fresh correction, are no new pose.
    assert reader.pose("tf", ahead, 12 * S // 10) is None


def test_a_correction_that_stopped_makes_the_robot_lost() -> None:
    reader = Ros2Reader(Frames(), epoch=0)
    reader.pose("tf", ros.tf(("map", "odom", 0, 0, 0), stamp_ns=WALL_NS), 0)
    for k in range(8):
        wheels = ros.tf(("odom", "base_link", 0.1 * k, 0, 0), stamp_ns=WALL_NS + k * S)
        last = reader.pose("tf", wheels, k * S)
    assert last is None
    assert reader.status == "lost"


def test_frames_with_a_leading_slash_and_loops_do_no_harm() -> None:
    reader = Ros2Reader(Frames(), epoch=0)
    both = ros.tf(("/map", "/odom", 1, 0, 0), ("/odom", "/base_link", 1, 0, 0), stamp_ns=WALL_NS)
    pose = reader.pose("tf", both, S)
    assert pose is not None
    assert pose.x_m == 2.0
    loop = ros.tf(("base_link", "odom", 1, 0, 0), stamp_ns=WALL_NS + 1)
    assert reader.pose("tf", loop, S) is None
    assert reader.status == "not_localised"


def test_pose_topics() -> None:
    reader = Ros2Reader(Frames(), epoch=0)
    plain = reader.pose("pose", ros.pose_stamped(1, 2, 3, stamp_ns=WALL_NS), S)
    assert plain is not None
    assert (plain.x_m, plain.y_m) == (1, 2)
    assert plain.yaw_rad == pytest.approx(3)
    wheels = reader.pose("odometry", ros.odometry(1, 2, 3, stamp_ns=WALL_NS), S)
    assert wheels is not None
    assert (wheels.quality, wheels.frame) == ("odometry", "odom")
    good = reader.pose("pose_covariance", ros.with_covariance(1, 2, 3, stamp_ns=WALL_NS), S)
    assert good is not None
    assert good.sigma_m == pytest.approx(0.1)
    assert good.sigma_yaw_rad == pytest.approx(0.02)
    wide = ros.with_covariance(1, 2, 3, stamp_ns=WALL_NS, xx=9.0)
    assert reader.pose("pose_covariance", wide, S) is None
    assert reader.status == "not_localised"


@pytest.mark.parametrize("x", [math.nan, math.inf, 1e7])
def test_poses_outside_any_home_are_refused(x: float) -> None:
    with pytest.raises(ProtocolError):
        Ros2Reader(Frames(), epoch=0).pose("pose", ros.pose_stamped(x, 0, 0, stamp_ns=0), 0)


def test_stamps_of_another_clock_come_onto_the_timeline() -> None:
    clock = RobotClock()
    rng = np.random.default_rng(3)
    errors = []
    for k in range(600):
        sent_ns = 50 * S + k * 20_000_000
        delay_ns = 2_000_000 + int(rng.exponential(15e6))
        stamp_ns = WALL_NS + int((sent_ns - 50 * S) * 1.00005)
        errors.append(clock.time_ns(stamp_ns, sent_ns + delay_ns) - sent_ns)
    # What stays is the least delay, not the jitter of 15 ms.
    assert np.abs(np.array(errors[300:]) - 2_000_000).max() < 3_000_000
    assert clock.time_ns(0, 70 * S) == 70 * S


def test_a_clock_that_is_set_while_running_is_followed() -> None:
    clock = RobotClock()
    for k in range(100):
        clock.time_ns(WALL_NS + k * S // 20, k * S // 20 + 5_000_000)
    # NTP sets the robot's clock forward by an hour: from 5 s late it is a new line at once.
    after = [clock.time_ns(WALL_NS + (3600 * 20 + k) * S // 20, k * S // 20) for k in range(100, 160)]
    assert abs(after[-1] - 159 * S // 20) < 50_000_000


def test_a_grid_is_a_floor_plan() -> None:
    cells = np.array([[0, 100, -1], [50, 0, 0]], np.int8)
    plan = Ros2Reader(Frames(), epoch=9).floor_plan(ros.grid(cells))
    assert plan.epoch == 9
    assert plan.origin == (-1.0, -2.0, 0.0)
    assert plan.resolution_m == pytest.approx(0.05)
    np.testing.assert_array_equal(plan.cells, cells)


def test_grids_that_are_no_floor_plan_are_refused() -> None:
    reader = Ros2Reader(Frames(), epoch=0)
    with pytest.raises(ProtocolError, match="odom"):
        reader.floor_plan(ros.grid(np.zeros((2, 2), np.int8), frame="odom"))
    with pytest.raises(ProtocolError, match="outside"):
        reader.floor_plan(ros.grid(np.full((2, 2), 101, np.int8)))
    with pytest.raises(ProtocolError):
        reader.floor_plan(ros.grid(np.zeros((0, 2), np.int8)))
