"""Why a station has no CSI."""

from __future__ import annotations

import numpy as np
import pytest
from csi_tools import bodies
from hypothesis import given
from hypothesis import strategies as st

from vad.csi.attribution import Attribution
from vad.csi.dot11 import data_frame, frame_facts
from vad.csi.heard import ENCRYPTED, LEGACY, NO_FRAMES, NOT_HEARD, WINDOW_NS, HeardStations
from vad.csi.logfile import LogReader, record
from vad.mac import UNKNOWN_MAC

AP, PHONE, LAMP, PLUG = 0x02_00_00_00_00_FF, 0x02_00_00_00_00_01, 0x02_00_00_00_00_02, 0x02_00_00_00_00_03


def heard_of(log: bytes, now_ns: int = 0) -> HeardStations:
    heard = HeardStations()
    heard.take(LogReader(Attribution()).feed(log), now_ns)
    return heard


def frame(mac: int, *, protected: bool = False) -> bytes:
    whole = bytearray(data_frame(mac, AP, AP, 0, bytes(40)))
    whole[1] |= 0x40 if protected else 0
    return record(0xC1, bytes(whole))


def test_every_reason() -> None:
    csi = [record(0xBB, body) for body in bodies(2)]
    log = frame(PHONE) + csi[0] + 3 * frame(LAMP) + 5 * frame(PLUG, protected=True) + frame(PLUG)
    log += frame(PHONE) + csi[1]
    heard = heard_of(log)
    assert heard.reason(PHONE, 0) == ""
    assert heard.reason(LAMP, 0) == LEGACY
    assert heard.reason(PLUG, 0) == ENCRYPTED
    assert heard.reason(AP, 0) == NOT_HEARD
    tally = heard.tally(PLUG, 0)
    assert (tally.frames, tally.encrypted, tally.plain_data, tally.packets) == (6, 5, 1, 0)
    assert heard.tally(PHONE, 0).packets == 2


def test_csi_without_any_frame_says_so() -> None:
    heard = heard_of(b"".join(record(0xBB, body) for body in bodies(3)))
    assert heard.reason(PHONE, 0) == NO_FRAMES


def test_what_is_old_is_forgotten() -> None:
    heard = heard_of(frame(LAMP))
    nothing = LogReader().feed(b"")
    heard.take(nothing, WINDOW_NS)
    assert heard.reason(LAMP, WINDOW_NS) == LEGACY
    assert heard.reason(LAMP, 2 * WINDOW_NS) == NOT_HEARD
    again = heard_of(frame(LAMP))
    assert again.reason(LAMP, 3 * WINDOW_NS) == NOT_HEARD


def test_a_flood_of_made_up_senders_is_bounded() -> None:
    heard = heard_of(100 * frame(LAMP))
    reader = LogReader()
    for k in range(20):
        heard.take(reader.feed(b"".join(frame(0x02_11_00_00_00_00 + 100 * k + i) for i in range(100))), 1)
    assert len(heard._now) <= 512
    assert heard.reason(LAMP, 1) == LEGACY


@pytest.mark.parametrize(
    ("head", "sender"),
    [(0xD4, False), (0xC4, False), (0xB4, True), (0x94, True), (0x80, True), (0x88, True), (0x0C, False)],
)
def test_frames_without_a_sender(head: int, sender: bool) -> None:
    body = bytes((head, 0)) + bytes(2) + AP.to_bytes(6, "big") + PHONE.to_bytes(6, "big")
    for size, known in ((16, sender), (15, False)):
        facts = frame_facts(body[:size], np.zeros(1, np.int64), np.array([size]))
        assert facts.sender.tolist() == [PHONE if known else UNKNOWN_MAC]


@given(st.lists(st.binary(max_size=40), max_size=20))
def test_any_frames_are_taken(contents: list[bytes]) -> None:
    log = b"".join(record(0xC1, content) for content in contents)
    heard = heard_of(log + record(0xBB, bodies(1)[0]))
    assert sum(t.frames for t in heard._now.values()) == len(contents)
