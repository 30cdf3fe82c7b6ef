"""The CDR decoders against `rosbags`, on generated messages and on the recorded ones, and against damage."""

from __future__ import annotations

import contextlib
import functools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vad.errors import ProtocolError
from vad.robot import cdr

rosbags = pytest.importorskip("rosbags.typesys")


@functools.cache
def store() -> Any:
    return rosbags.get_typestore(rosbags.Stores.ROS2_HUMBLE)


def kind(name: str) -> Any:
    return store().types[name]


def oracle(name: str, data: bytes) -> Any:
    return store().deserialize_cdr(data, name)


def packed(name: str, message: Any) -> bytes:
    return bytes(store().serialize_cdr(message, name, little_endian=True))


texts = st.text(st.characters(exclude_characters="\0", exclude_categories=("Cs",)), max_size=20)
doubles = st.floats(allow_nan=False)
stamps = st.tuples(st.integers(-(2**31), 2**31 - 1), st.integers(0, 2**32 - 1))
poses = st.lists(doubles, min_size=7, max_size=7)
covariances = st.lists(doubles, min_size=36, max_size=36)


def header(stamp: tuple[int, int], frame: str) -> Any:
    time = kind("builtin_interfaces/msg/Time")(sec=stamp[0], nanosec=stamp[1])
    return kind("std_msgs/msg/Header")(stamp=time, frame_id=frame)


def pose_of(v: list[float]) -> Any:
    return kind("geometry_msgs/msg/Pose")(
        position=kind("geometry_msgs/msg/Point")(x=v[0], y=v[1], z=v[2]),
        orientation=kind("geometry_msgs/msg/Quaternion")(x=v[3], y=v[4], z=v[5], w=v[6]),
    )


def stamp_ns(head: Any) -> int:
    return int(head.stamp.sec) * 10**9 + int(head.stamp.nanosec)


def seven(pose: Any) -> tuple[float, ...]:
    p, q = pose.position, pose.orientation
    return p.x, p.y, p.z, q.x, q.y, q.z, q.w


def check_pose(name: str, data: bytes) -> None:
    theirs = oracle(name, data)
    if name.endswith("Odometry"):
        ours, inner = cdr.odometry(data), theirs.pose
        assert ours.child_frame == theirs.child_frame_id
    elif name.endswith("CovarianceStamped"):
        ours, inner = cdr.pose_with_covariance_stamped(data), theirs.pose
    else:
        ours, inner = cdr.pose_stamped(data), None
    assert (ours.stamp_ns, ours.frame) == (stamp_ns(theirs.header), theirs.header.frame_id)
    assert tuple(ours.pose) == seven(theirs.pose if inner is None else inner.pose)
    if inner is not None:
        assert ours.covariance == tuple(inner.covariance)


@settings(max_examples=150, deadline=None)
@given(stamps, texts, poses)
def test_pose_stamped_is_what_rosbags_reads(stamp: tuple[int, int], frame: str, v: list[float]) -> None:
    name = "geometry_msgs/msg/PoseStamped"
    check_pose(name, packed(name, kind(name)(header=header(stamp, frame), pose=pose_of(v))))


@settings(max_examples=150, deadline=None)
@given(stamps, texts, texts, poses, covariances)
def test_odometry_and_covariance_are_what_rosbags_reads(
    stamp: tuple[int, int], frame: str, child: str, v: list[float], c: list[float]
) -> None:
    pose = kind("geometry_msgs/msg/PoseWithCovariance")(pose=pose_of(v), covariance=np.array(c))
    name = "geometry_msgs/msg/PoseWithCovarianceStamped"
    check_pose(name, packed(name, kind(name)(header=header(stamp, frame), pose=pose)))
    vector = kind("geometry_msgs/msg/Vector3")(x=v[0], y=v[1], z=v[2])
    twist = kind("geometry_msgs/msg/TwistWithCovariance")(
        twist=kind("geometry_msgs/msg/Twist")(linear=vector, angular=vector), covariance=np.array(c)
    )
    name = "nav_msgs/msg/Odometry"
    whole = kind(name)(header=header(stamp, frame), child_frame_id=child, pose=pose, twist=twist)
    check_pose(name, packed(name, whole))


@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(stamps, texts, texts, poses), max_size=5))
def test_tf_is_what_rosbags_reads(links: list[tuple[tuple[int, int], str, str, list[float]]]) -> None:
    transforms = [
        kind("geometry_msgs/msg/TransformStamped")(
            header=header(stamp, frame),
            child_frame_id=child,
            transform=kind("geometry_msgs/msg/Transform")(
                translation=kind("geometry_msgs/msg/Vector3")(x=v[0], y=v[1], z=v[2]),
                rotation=kind("geometry_msgs/msg/Quaternion")(x=v[3], y=v[4], z=v[5], w=v[6]),
            ),
        )
        for stamp, frame, child, v in links
    ]
    name = "tf2_msgs/msg/TFMessage"
    check_tf(packed(name, kind(name)(transforms=transforms)))


def check_tf(data: bytes) -> None:
    ours, theirs = cdr.tf_message(data), oracle("tf2_msgs/msg/TFMessage", data).transforms
    assert len(ours) == len(theirs)
    for a, b in zip(ours, theirs, strict=True):
        assert (a.stamp_ns, a.frame, a.child_frame) == (
            stamp_ns(b.header),
            b.header.frame_id,
            b.child_frame_id,
        )
        t, q = b.transform.translation, b.transform.rotation
        assert tuple(a.transform) == (t.x, t.y, t.z, q.x, q.y, q.z, q.w)


@settings(max_examples=100, deadline=None)
@given(stamps, texts, poses, st.integers(0, 9), st.integers(0, 9), st.floats(0, 10, width=32), st.randoms())
def test_a_grid_is_what_rosbags_reads(
    stamp: tuple[int, int], frame: str, v: list[float], rows: int, cols: int, resolution: float, rng: Any
) -> None:
    cells = np.array([rng.randint(-128, 127) for _ in range(rows * cols)], np.int8)
    info = kind("nav_msgs/msg/MapMetaData")(
        map_load_time=kind("builtin_interfaces/msg/Time")(sec=1, nanosec=2),
        resolution=resolution,
        width=cols,
        height=rows,
        origin=pose_of(v),
    )
    name = "nav_msgs/msg/OccupancyGrid"
    check_grid(packed(name, kind(name)(header=header(stamp, frame), info=info, data=cells)))


def check_grid(data: bytes) -> None:
    ours, theirs = cdr.occupancy_grid(data), oracle("nav_msgs/msg/OccupancyGrid", data)
    assert (ours.stamp_ns, ours.frame) == (stamp_ns(theirs.header), theirs.header.frame_id)
    assert ours.resolution_m == theirs.info.resolution
    assert tuple(ours.origin) == seven(theirs.info.origin)
    assert ours.cells.shape == (theirs.info.height, theirs.info.width)
    np.testing.assert_array_equal(ours.cells.ravel(), theirs.data)


def test_the_recorded_messages_are_what_rosbags_reads(shared_data: Path) -> None:
    folder = shared_data / "robots" / "ros2_cdr"
    for name in ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"):
        check_pose(name, (folder / f"cdr_{name.rsplit('/')[-1]}.bin").read_bytes())
    check_pose("nav_msgs/msg/Odometry", (folder / "cdr_Odometry.bin").read_bytes())
    check_tf((folder / "cdr_TFMessage3.bin").read_bytes())
    check_grid((folder / "cdr_OccupancyGrid.bin").read_bytes())


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=400), st.booleans())
def test_any_bytes_are_read_or_refused(data: bytes, with_head: bool) -> None:
    payload = b"\x00\x01\x00\x00" + data if with_head else data
    for read in (
        cdr.pose_stamped,
        cdr.pose_with_covariance_stamped,
        cdr.odometry,
        cdr.tf_message,
        cdr.occupancy_grid,
    ):
        with contextlib.suppress(ProtocolError):
            read(payload)  # type: ignore[operator]


def test_every_cut_is_refused(shared_data: Path) -> None:
    data = (shared_data / "robots" / "ros2_cdr" / "cdr_TFMessage3.bin").read_bytes()
    for end in range(len(data)):
        with pytest.raises(ProtocolError):
            cdr.tf_message(data[:end])


def test_yaw_is_counter_clockwise() -> None:
    half = cdr.Transform(0, 0, 0, 0, 0, math.sin(0.6), math.cos(0.6))
    assert half.yaw_rad == pytest.approx(1.2)
