"""The Neato protocol without I/O: the real line, any chunking, garbage, bounds, timing."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vad.robot.neato import (
    DRAIN_NS,
    MAX_REPLY_BYTES,
    POSE_COMMAND,
    REPLY_TIMEOUT_NS,
    NeatoPoller,
    NeatoReply,
    ReplyParser,
    position_from_reply,
)

MS = 1_000_000
REPLY = (
    b"GetRobotPos Smooth\r\nRobot Smooth pose: X=1.250, Y=-0.500, Theta=90.000, Time=145559.850836\r\n\x1a"
)


def reply(x: str, y: str, theta: str) -> bytes:
    return f"GetRobotPos Smooth\r\nRobot Smooth pose: X={x}, Y={y}, Theta={theta}, Time=7.5\r\n\x1a".encode()


def test_the_real_line(shared_data: Path) -> None:
    data = (shared_data / "robots/neato/getrobotpos_smooth_real_line.txt").read_bytes()
    (got,) = ReplyParser().feed(data)
    position = position_from_reply(got)
    assert position is not None
    assert (position.x_m, position.y_m, position.robot_time_s) == (0.105, 0.0, 145559.850836)
    assert position.yaw_rad == pytest.approx(math.radians(-0.001), abs=1e-9)
    assert position.localised
    assert got.lines[0] == "GetRobotPos Smooth"


@given(st.lists(st.integers(1, 40), max_size=60))
def test_any_chunking_gives_the_same_replies(cuts: list[int]) -> None:
    data = REPLY * 3
    parser = ReplyParser()
    got: list[NeatoReply] = []
    for cut in cuts:
        got += parser.feed(data[:cut])
        data = data[cut:]
    got += parser.feed(data)
    assert got == ReplyParser().feed(REPLY * 3)
    assert len(got) == 3


@given(st.binary(max_size=200), st.binary(max_size=200))
def test_garbage_around_replies_costs_no_later_reply(before: bytes, between: bytes) -> None:
    parser = ReplyParser()
    got = [
        position_from_reply(item)
        for item in parser.feed(before + b"\x1a" + REPLY + between + b"\x1a" + REPLY)
    ]
    assert sum(p is not None and p.x_m == 1.25 for p in got) >= 2


@given(st.lists(st.binary(max_size=9000), max_size=12))
def test_the_buffer_is_bounded_and_the_parser_recovers(chunks: list[bytes]) -> None:
    parser = ReplyParser()
    for chunk in chunks:
        parser.feed(chunk)
        assert len(parser) <= MAX_REPLY_BYTES
    parser.feed(b"\x1a")
    (got,) = parser.feed(REPLY)
    assert position_from_reply(got) is not None


def test_a_reply_without_end_is_dropped_and_counted() -> None:
    parser = ReplyParser()
    assert parser.feed(b"x" * (MAX_REPLY_BYTES + 1)) == []
    assert parser.overflows == 1
    assert parser.feed(b"y" * 100 + b"\x1a") == []
    assert len(parser.feed(REPLY)) == 1


@pytest.mark.parametrize(
    ("x", "y", "theta", "localised"),
    [
        ("0.000", "0.000", "0.000", False),
        ("-0.000", "0.000", "0.000", False),
        ("0.000", "0.000", "0.001", True),
    ],
)
def test_exact_zeros_are_not_localised(x: str, y: str, theta: str, localised: bool) -> None:
    position = position_from_reply(ReplyParser().feed(reply(x, y, theta))[0])
    assert position is not None
    assert position.localised is localised


@pytest.mark.parametrize(
    "line",
    [
        "Robot Smooth pose: X=0.1, Y=0.2, Theta=3.0",
        "Robot Smooth pose: X=0.1, Y=0.2, Theta=3\ufffd0, Time=1.0",
        "Robot Smooth pose: X=1e9, Y=0.2, Theta=3.0, Time=1.0",
        "Robot Smooth pose: X=9999.0, Y=0.2, Theta=3.0, Time=1.0",
        "Robot Smooth pose: X=0.1, Y=0.2, Theta=730.0, Time=1.0",
        "Unknown Cmd: 'GetRobotPos Smooth'",
        "",
    ],
)
def test_what_is_no_position(line: str) -> None:
    assert position_from_reply(NeatoReply(("GetRobotPos Smooth", line))) is None


def test_labels_count_not_places_and_the_last_pose_line_wins() -> None:
    lines = ("Robot Smooth pose: X=9.0, Y=9.0, Theta=9.0, Time=1.0",)
    lines += ("Robot Smooth pose: Time=2.0, Theta=180.000, Y=0.25, X=-1.5",)
    position = position_from_reply(NeatoReply(lines))
    assert position is not None
    assert (position.x_m, position.y_m, position.robot_time_s) == (-1.5, 0.25, 2.0)
    assert position.yaw_rad == pytest.approx(math.pi)


@given(st.floats(-360, 360))
def test_yaw_is_the_same_angle_wrapped(theta_deg: float) -> None:
    position = position_from_reply(ReplyParser().feed(reply("1.000", "2.000", f"{theta_deg:.6f}"))[0])
    assert position is not None
    assert -math.pi < position.yaw_rad <= math.pi
    assert math.cos(position.yaw_rad) == pytest.approx(math.cos(math.radians(theta_deg)), abs=1e-6)
    assert math.sin(position.yaw_rad) == pytest.approx(math.sin(math.radians(theta_deg)), abs=1e-6)


def test_the_poller_stamps_the_middle_and_keeps_the_rate() -> None:
    poller = NeatoPoller(5.0)
    stamps = []
    sent = []
    for now_ns in range(0, 2_000 * MS, 10 * MS):
        if poller.to_send(now_ns):
            sent.append(now_ns)
            (reading,) = poller.receive(REPLY, now_ns + 6 * MS)
            stamps.append(reading.t_ns)
            assert reading.round_trip_ns == 6 * MS
    assert sent == list(range(0, 2_000 * MS, 200 * MS))
    assert stamps == [t_ns + 3 * MS for t_ns in sent]
    assert poller.bad == 0


def test_commands_never_overlap_and_a_late_reply_is_not_taken_for_the_next() -> None:
    poller = NeatoPoller(5.0)
    assert poller.to_send(0) == POSE_COMMAND
    assert poller.to_send(900 * MS) == b""
    assert poller.to_send(REPLY_TIMEOUT_NS) == b""
    assert poller.receive(REPLY, REPLY_TIMEOUT_NS + 100 * MS) == []
    assert poller.bad == 2
    assert poller.to_send(REPLY_TIMEOUT_NS + DRAIN_NS - 1) == b""
    asked_ns = REPLY_TIMEOUT_NS + DRAIN_NS
    assert poller.to_send(asked_ns) == POSE_COMMAND
    (reading,) = poller.receive(REPLY, asked_ns + 10 * MS)
    assert reading.t_ns == asked_ns + 5 * MS


@given(st.lists(st.tuples(st.integers(0, 400 * MS), st.binary(max_size=40)), max_size=80))
def test_the_poller_survives_anything_and_never_stamps_outside_the_exchange(
    steps: list[tuple[int, bytes]],
) -> None:
    poller = NeatoPoller(5.0)
    now_ns = 0
    for wait_ns, noise in steps:
        asked_ns = now_ns
        poller.to_send(now_ns)
        now_ns += wait_ns
        for reading in poller.receive(noise + (REPLY if wait_ns % 2 else b""), now_ns):
            assert asked_ns - REPLY_TIMEOUT_NS <= reading.t_ns <= now_ns


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, math.inf, math.nan])
def test_a_rate_that_is_none_is_refused(rate_hz: float) -> None:
    with pytest.raises(ValueError, match="rate_hz"):
        NeatoPoller(rate_hz)
