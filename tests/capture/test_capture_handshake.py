"""The handshake: whatever is lost, repeated or late, both sides end, and never differently."""

from __future__ import annotations

from collections import deque

from hypothesis import given, settings
from hypothesis import strategies as st

from vad.capture.handshake import GIVE_UP_NS, Abort, CameraSide, Message, Start, Started, Stop, WifiSide

STEP_NS = 50_000_000
MAX_RECORD_NS = 5_000_000_000


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
    camera.frame(1, 1)
    assert camera.tick(MAX_RECORD_NS) == []
    (message,) = camera.tick(MAX_RECORD_NS + 1)
    assert isinstance(message, Abort)
    assert camera.over


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


# For each step: is the Wi-Fi's and the camera's next message lost (0), delivered (1), doubled (2) or kept
# back (3); does a frame come; does the Wi-Fi side want to finish.
steps = st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3), st.booleans(), st.booleans()), max_size=60)


@given(steps, st.none() | st.integers(0, 60), st.none() | st.integers(0, 60))
@settings(max_examples=300)
def test_no_interleaving_leaves_a_recording_running(
    course: list[tuple[int, int, bool, bool]], wifi_dies: int | None, camera_dies: int | None
) -> None:
    wifi, camera = WifiSide("s"), CameraSide("s", max_record_ns=MAX_RECORD_NS)
    to_camera: deque[Message] = deque(wifi.arm(0))
    to_wifi: deque[Message] = deque()
    seen: set[str] = set()
    # After the random course the link is good and frames come, for long enough that every time-out passes.
    settled = [(1, 1, True, True)] * ((MAX_RECORD_NS + 2 * GIVE_UP_NS) // STEP_NS)
    for k, (lane_out, lane_in, frame, finish) in enumerate([*course, *settled]):
        now_ns = k * STEP_NS
        wifi_alive = wifi_dies is None or k < wifi_dies
        camera_alive = camera_dies is None or k < camera_dies
        for lane, queue, alive in ((lane_out, to_camera, camera_alive), (lane_in, to_wifi, wifi_alive)):
            if not queue or lane == 3:
                continue
            message = queue.popleft()
            for _ in range(lane if alive else 0):
                if queue is to_camera:
                    to_wifi += camera.receive(message, now_ns)
                else:
                    to_camera += wifi.receive(message, now_ns)
        if wifi_alive:
            to_camera += wifi.tick(now_ns)
            if finish:
                to_camera += wifi.finish(now_ns)
            if wifi.state == "solving":
                wifi.solved()
        if camera_alive:
            to_wifi += camera.tick(now_ns)
            if frame:
                to_wifi += camera.frame(now_ns, now_ns)
        seen.add(wifi.state)
    assert not {"done", "aborted"} <= seen, "a session is never both"
    if wifi_dies is None:
        assert wifi.over
        assert wifi.state == "done" or wifi.reason
    if camera_dies is None:
        assert camera.over or camera.state == "idle"
    if wifi.state == "done":
        assert camera.frames > 0
