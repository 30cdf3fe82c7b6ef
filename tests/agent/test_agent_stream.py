"""The agent's stream: whatever the network does, every packet arrives once, in order, or is counted."""

from __future__ import annotations

from collections import deque

import msgspec
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from vad.agent.frames import (
    MAX_FRAME_BYTES,
    MAX_RAW_BYTES,
    VERSION,
    Ack,
    Frame,
    decode_command,
    decode_frame,
    encode_command,
    encode_frame,
)
from vad.agent.inbox import Inbox
from vad.agent.info import AgentInfo, decode_info, encode_info
from vad.agent.outbox import AGAIN_NS, WINDOW_FRAMES, Draft, Outbox
from vad.capture.handshake import Abort, Going, Start, Started, Stop, Stopped
from vad.errors import ProtocolError

pytestmark = pytest.mark.timeout(600)
"""Much work for the processor: a busy machine takes many times as long as an idle one."""

RECORD = 213
STREAM = 77
MAC = "00:16:ea:00:00:01"
LATER_NS = 20_000_000_000


def frame_of(box: Outbox, draft: Draft) -> Frame:
    return Frame(
        version=VERSION,
        stream=box.stream,
        seq=draft.seq,
        oldest=box.oldest,
        before=draft.before,
        given_up=box.dropped_packets,
        offset_ns=5,
        error_ns=7,
        mac=MAC,
        carrier_hz=5.24e9,
        bandwidth_mhz=20,
        arrival_ns=draft.arrival_ns,
        raw=draft.raw,
        answers=draft.answers,
        trouble=draft.trouble,
    )


def following(box: Outbox) -> Draft:
    """The next draft, which there must be."""
    draft = box.next(0)
    assert draft is not None
    return draft


def put(box: Outbox, n: int, first: int) -> None:
    """n records whose arrivals say which packets they are."""
    box.add_packets(bytes(RECORD * n), RECORD * np.arange(n), np.arange(first, first + n))


@pytest.mark.parametrize(
    "answers", [(), (Started("s", 1, 2), Stopped("s", 3, 4, 2), Abort("s", "no packet came for 5 s"))]
)
def test_a_frame_is_read_as_it_was_written(answers: tuple[Started | Stopped | Abort, ...]) -> None:
    box = Outbox(STREAM, 1 << 20)
    put(box, 3, 10)
    box.add_answers(answers, 11, "no driver")
    first, second = following(box), following(box)
    for draft in (first, second):
        frame = frame_of(box, draft)
        assert decode_frame(encode_frame(frame)) == frame
    assert frame_of(box, first).arrivals().tolist() == [15, 16, 17]
    assert (second.answers, second.trouble, second.before) == (answers, "no driver", 3)


@pytest.mark.parametrize("command", [Start("s", 5), Going("s"), Stop("s"), Abort("s", "why"), Ack(1, 2)])
def test_a_command_is_read_as_it_was_written(command: Start | Going | Stop | Abort | Ack) -> None:
    assert decode_command(encode_command(command)) == command


@given(st.binary(max_size=300))
def test_foreign_bytes_are_refused_by_their_own_error(payload: bytes) -> None:
    for decode in (decode_frame, decode_command, decode_info):
        with pytest.raises(ProtocolError):
            decode(payload)


def test_frames_that_contradict_themselves_are_refused() -> None:
    box = Outbox(STREAM, 1 << 20)
    put(box, 1, 0)
    good = frame_of(box, following(box))
    for change in (
        {"oldest": 1},
        {"version": 2},
        {"mac": "nobody"},
        {"mac": MAC.upper()},
        {"arrival_ns": b"1234567"},
        {"offset_ns": 1 << 63},
        {"raw": bytes(MAX_FRAME_BYTES)},
    ):
        with pytest.raises(ProtocolError):
            decode_frame(msgspec.msgpack.encode(msgspec.structs.replace(good, **change)))


def test_an_agents_description() -> None:
    info = AgentInfo(id="attic", mac=MAC.upper(), name="Attic")
    assert decode_info(encode_info(info)) == msgspec.structs.replace(info, mac=MAC)
    for wrong in ({"mac": "x"}, {"id": "a/b"}, {"schema": "vad.agent/9"}):
        with pytest.raises(ProtocolError):
            decode_info(encode_info(msgspec.structs.replace(info, **wrong)))


def test_many_packets_become_frames_that_travel_in_one_piece() -> None:
    box = Outbox(STREAM, 10 << 20)
    put(box, 1000, 0)
    drafts = [box.next(0) for _ in range(len(box))]
    sizes = [len(draft.raw) for draft in drafts if draft is not None]
    assert len(sizes) == len(drafts)
    assert max(sizes) <= MAX_RAW_BYTES
    assert sum(sizes) == 1000 * RECORD
    assert all(size % RECORD == 0 for size in sizes)
    assert [d.before for d in drafts if d is not None] == list(np.cumsum([0, *sizes[:-1]]) // RECORD)


def test_no_more_than_the_window_is_under_way_and_what_is_unanswered_goes_out_again() -> None:
    box = Outbox(STREAM, 10 << 20)
    for k in range(WINDOW_FRAMES + 5):
        put(box, 1, k)
    sent = 0
    while box.next(0) is not None:
        sent += 1
    assert sent == WINDOW_FRAMES
    box.confirmed(Ack(STREAM, 3), 1)
    assert [d.seq for d in (box.next(1), box.next(1), box.next(1)) if d is not None] == [64, 65, 66]
    assert box.next(AGAIN_NS) is None
    again = box.next(1 + AGAIN_NS)
    assert again is not None
    assert again.seq == 3
    box.confirmed(Ack(STREAM + 1, 60), 0)
    box.confirmed(Ack(STREAM, 1000), 0)
    assert box.oldest == 3, "an answer to something else confirms nothing"


# A course: at each step what happens to the next frame and the next ack (0 lost, 1 there, 2 twice, 3 late),
# how many packets are made, whether the link comes back.
steps = st.tuples(st.integers(0, 3), st.integers(0, 3), st.integers(0, 30), st.booleans())
courses = st.lists(steps, max_size=80)


@given(courses, st.integers(2_000, 60_000))
@example([(0, 0, 2, False), (3, 0, 1, False), (1, 0, 1, False)], 2000)
@settings(max_examples=200)
def test_every_packet_arrives_once_and_in_order_or_is_counted(
    course: list[tuple[int, int, int, bool]], limit_bytes: int
) -> None:
    box, inbox = Outbox(STREAM, limit_bytes), Inbox()
    arrived: list[int] = []
    late: deque[Frame] = deque()
    made = now_ns = 0

    def to_hub(frame: Frame) -> None:
        if inbox.take(frame):
            arrived.extend((frame.arrivals() - frame.offset_ns).tolist())

    for sent, acked, packets, back in course:
        now_ns += 100_000_000
        if packets:
            put(box, packets, made)
            made += packets
        if back:
            box.begin_again(now_ns)
        draft = box.next(now_ns)
        if draft is not None:
            frame = frame_of(box, draft)
            if sent == 3:
                late.append(frame)
            for _ in range(sent % 3):
                to_hub(frame)
        if late and sent == 1:
            to_hub(late.popleft())
        if acked % 3 and inbox.ack is not None:
            box.confirmed(inbox.ack, now_ns)
    while len(box):
        now_ns += LATER_NS
        while (draft := box.next(now_ns)) is not None:
            to_hub(frame_of(box, draft))
        if inbox.ack is not None:
            box.confirmed(inbox.ack, now_ns)
    assert arrived == sorted(set(arrived)), "each once and in order"
    assert len(arrived) == inbox.packets
    if made:
        assert inbox.packets + inbox.lost == made
        assert inbox.lost <= box.dropped_packets, "what the agent gave up may have arrived after all"


def test_a_hub_started_anew_takes_over_and_an_agent_started_anew_begins_again() -> None:
    box, first, second = Outbox(STREAM, 1 << 20), Inbox(), Inbox()
    for k in range(4):
        put(box, 2, 2 * k)
    drafts = [following(box) for _ in range(4)]
    frames = [frame_of(box, draft) for draft in drafts]
    assert first.take(frames[0])
    assert first.ack == Ack(STREAM, 1)
    box.confirmed(Ack(STREAM, 1), 0)
    assert not second.take(frame_of(box, drafts[2])), "it is not the oldest"
    assert second.ack == Ack(STREAM, 1)
    for draft in drafts[1:]:
        assert second.take(frame_of(box, draft))
    assert (second.packets, second.lost, second.early) == (6, 0, 1)

    anew = Outbox(STREAM + 1, 1 << 20)
    put(anew, 5, 0)
    assert second.take(frame_of(anew, following(anew)))
    assert not second.take(frames[3]), "a late frame of the former run changes nothing"
    assert (second.streams, second.packets, second.lost) == (2, 11, 0)


def test_what_was_given_up_before_the_hub_was_there_is_counted() -> None:
    box, inbox = Outbox(STREAM, 3 * (RECORD + 408)), Inbox()
    for k in range(5):
        put(box, 1, k)
    assert box.dropped_packets == 2
    while (draft := box.next(0)) is not None:
        assert inbox.take(frame_of(box, draft))
    assert (inbox.packets, inbox.lost) == (3, 2)
