"""The handshake: whatever is lost, repeated or late, and whoever dies, everybody ends, never differently."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

import pytest
from handshake_explorer import ViolationError, explore_many

from vad.capture import handshake
from vad.capture.handshake import (
    FOLLOWER,
    GIVE_UP_NS,
    LEADER,
    REMOTE_GIVE_UP_NS,
    REPEAT_NS,
    STALL_NS,
    Abort,
    CameraSide,
    Follower,
    Going,
    Start,
    Started,
    Stop,
    Stopped,
    WifiSide,
    no_such_session,
)

STEP_NS = 50_000_000
MAX_RECORD_NS = 5_000_000_000


def recording_pair(now_ns: int = 0) -> tuple[WifiSide, CameraSide]:
    """Both sides with a recording under way since `now_ns`."""
    wifi, camera = WifiSide("s"), CameraSide("s", max_record_ns=MAX_RECORD_NS)
    (start,) = wifi.arm(now_ns)
    camera.receive(start, now_ns)
    (started,) = camera.frame(now_ns, now_ns)
    wifi.receive(started, now_ns)
    return wifi, camera


def test_the_plain_course() -> None:
    wifi, camera = WifiSide("s"), CameraSide("s", max_record_ns=MAX_RECORD_NS)
    (start,) = wifi.arm(0)
    assert isinstance(start, Start)
    assert camera.receive(start, 1) == []
    assert camera.frame(0, 2) == [], "a frame from before the start is not the first"
    (started,) = camera.frame(10, 11)
    assert isinstance(started, Started)
    assert started.first_frame_ns == 10
    wifi.receive(started, 12)
    assert wifi.state == "recording"
    camera.frame(20, 21)
    (stop,) = wifi.finish(30)
    (stopped,) = camera.receive(stop, 31)
    wifi.receive(stopped, 32)
    assert (wifi.state, wifi.first_frame_ns, wifi.last_frame_ns) == ("solving", 10, 20)
    assert (camera.state, camera.frames) == ("stopped", 2)
    wifi.solved()
    assert wifi.state == "done"


def test_a_silent_camera_ends_the_session_with_a_reason() -> None:
    wifi = WifiSide("s")
    wifi.arm(0)
    sent = [message for t in range(0, GIVE_UP_NS + STEP_NS, STEP_NS) for message in wifi.tick(t)]
    assert wifi.state == "aborted"
    assert "did not answer" in wifi.reason
    assert [type(m) for m in sent[:-1]] == [Start] * 5
    assert isinstance(sent[-1], Abort)


def test_a_camera_whose_wifi_side_died_stops_by_itself() -> None:
    camera = CameraSide("s", max_record_ns=MAX_RECORD_NS)
    camera.receive(Start("s", 0), 0)
    ticks = range(1, GIVE_UP_NS + 2 * STEP_NS, STEP_NS)
    sent = [message for t in ticks for message in (*camera.frame(t, t), *camera.tick(t))]
    assert [type(m) for m in sent] == [Started, Abort]
    assert camera.over
    assert "silent for 3 s" in camera.reason


def test_a_camera_that_is_never_stopped_stops_by_itself() -> None:
    _, camera = recording_pair()
    for t in range(STEP_NS, MAX_RECORD_NS + STEP_NS, STEP_NS):
        camera.receive(Going("s"), t)
        camera.frame(t, t)
        assert camera.tick(t) == []
    (message,) = camera.tick(MAX_RECORD_NS + 1)
    assert message == Abort("s", "no stop came from the Wi-Fi side")


def test_a_camera_without_frames_says_so() -> None:
    camera = CameraSide("s", max_record_ns=MAX_RECORD_NS)
    camera.receive(Start("s", 0), 0)
    assert camera.tick(STALL_NS) == []
    (message,) = camera.tick(STALL_NS + 1)
    assert message == Abort("s", "no frame came for 2 s")
    wifi, camera = recording_pair()
    (message,) = camera.tick(STALL_NS + 1)
    wifi.receive(message, STALL_NS + 2)
    assert (wifi.state, wifi.reason) == ("aborted", "no frame came for 2 s")


def test_a_camera_that_dies_in_the_middle_ends_the_session() -> None:
    wifi, _ = recording_pair()
    sent = [message for t in range(0, GIVE_UP_NS + STEP_NS, STEP_NS) for message in wifi.tick(t)]
    assert [type(m) for m in sent] == [Going] * 5 + [Abort]
    assert "camera did not answer" in wifi.reason


def test_a_camera_started_anew_does_not_go_on_with_the_record() -> None:
    wifi, _ = recording_pair()
    (going,) = wifi.tick(REPEAT_NS)
    another = CameraSide("s", max_record_ns=MAX_RECORD_NS)
    (answer,) = another.receive(going, REPEAT_NS)
    assert another.receive(Start("s", 0), REPEAT_NS) == [answer], "a late start begins nothing"
    wifi.receive(answer, REPEAT_NS)
    assert wifi.state == "aborted"
    assert "started anew" in wifi.reason


def test_two_records_of_one_follower_are_not_taken_for_one() -> None:
    wifi, _ = recording_pair(now_ns=10)
    (told,) = wifi.receive(Started("s", 20, 15), 20)
    assert told == Abort("s", "the camera began a new record in the middle: it was started anew")


def test_a_remote_follower_has_the_time_of_a_network_break() -> None:
    wifi, camera = WifiSide("s", ("attic",)), CameraSide("s", max_record_ns=60_000_000_000)
    node = Follower(
        "s", thing="packet", max_record_ns=60_000_000_000, silent_ns=REMOTE_GIVE_UP_NS, stall_ns=STALL_NS
    )
    (start,) = wifi.arm(0)
    node.receive(start, 0)
    wifi.receive(node.took(0, 90, 10, 100)[0], 100, "attic")
    assert wifi.state == "armed", "the camera is not there yet"
    camera.receive(start, 100)
    wifi.receive(camera.frame(100, 100)[0], 100)
    assert wifi.state == "recording"
    for t in range(STEP_NS, 4_000_000_000, STEP_NS):  # nothing reaches the node for 4 s
        wifi.receive(camera.receive(Going("s"), t)[0], t)
        wifi.tick(t)
        node.took(t, t, 10, t)
        node.tick(t)
    now_ns = 4_000_000_000
    (stop,) = wifi.finish(now_ns)
    wifi.receive(camera.receive(stop, now_ns)[0], now_ns)
    assert wifi.state == "stopping"
    (stopped,) = node.receive(stop, now_ns)
    wifi.receive(stopped, now_ns, "attic")
    assert wifi.state == "solving"
    assert wifi.recorded("attic") == node.frames == 10 * 80


def test_an_end_that_was_not_heard_is_told_again() -> None:
    wifi, camera = recording_pair()
    wifi.abort("somebody else moved in the picture")
    (started,) = camera.receive(Going("s"), 1)
    (abort,) = wifi.receive(started, 2)
    camera.receive(abort, 3)
    assert (camera.state, camera.reason) == ("aborted", "somebody else moved in the picture")
    (abort,) = no_such_session(Started("of before", 0, 0))
    assert abort.session == "of before"
    assert no_such_session(Stopped("of before", 0, 0, 0)) == []


def test_a_stop_before_the_first_frame_aborts_both() -> None:
    camera = CameraSide("s", max_record_ns=MAX_RECORD_NS)
    camera.receive(Start("s", 0), 0)
    (message,) = camera.receive(Stop("s"), 1)
    assert isinstance(message, Abort)
    wifi = WifiSide("s")
    wifi.arm(0)
    wifi.receive(message, 2)
    assert (wifi.state, wifi.reason) == ("aborted", "stopped before the first frame")


def test_messages_of_another_session_change_nothing() -> None:
    wifi, camera = WifiSide("s"), CameraSide("s", max_record_ns=MAX_RECORD_NS)
    wifi.arm(0)
    camera.receive(Start("other", 0), 0)
    wifi.receive(Started("other", 0, 0), 0)
    wifi.receive(Abort("other", "x"), 0)
    assert (wifi.state, camera.state) == ("armed", "idle")


def test_the_tables_lead_only_to_states_that_have_a_way_on() -> None:
    for table, ends in ((LEADER, {"done", "aborted"}), (FOLLOWER, {"stopped", "aborted"})):
        rows: Any = table.items()
        for (state, event), (after, _) in rows:
            assert state not in ends or after == state, f"{state} is an end, {event} must not leave it"
        for state in {after for _, (after, _) in rows} - ends:
            assert (state, "give up") in table, f"nothing ends {state}"


def test_interleavings() -> None:
    verdicts = explore_many(range(2500))
    assert verdicts["done"] > 500, verdicts
    assert verdicts["aborted"] > 500, verdicts


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_hundred_thousand_interleavings() -> None:
    verdicts = explore_many(range(1_000_000, 1_100_000))
    assert verdicts.total() == 100_000
    assert verdicts["done"] > 20_000, verdicts


@pytest.mark.parametrize(
    ("table", "changes"),
    [
        ("LEADER", {("stopping", "give up"): None}),
        ("LEADER", {("aborted", "solved"): ("done", "")}),
        ("LEADER", {("recording", "solved"): ("done", "")}),
        ("FOLLOWER", {("recording", "give up"): None}),
        ("FOLLOWER", {("armed", "give up"): None}),
        ("FOLLOWER", {("aborted", "start"): ("armed", "")}),
        ("FOLLOWER", {("stopped", "going"): ("recording", "started")}),
        ("FOLLOWER", {("recording", "stop"): ("recording", "stopped")}),
    ],
)
def test_a_wrong_table_is_found(
    monkeypatch: pytest.MonkeyPatch, table: str, changes: dict[tuple[str, str], Any]
) -> None:
    rows = getattr(handshake, table) | changes
    wrong = MappingProxyType({key: step for key, step in rows.items() if step is not None})
    monkeypatch.setattr(handshake, table, wrong)
    with pytest.raises(ViolationError):
        explore_many(range(2500))
