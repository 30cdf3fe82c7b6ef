"""How fast echo requests go out, and what they look like."""

from __future__ import annotations

import contextlib
import heapq
import random
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vad.csi.echo import MAX_BURST, EchoPacer, checksum, echo_request, reply_sequence
from vad.errors import ProtocolError

S = 1_000_000_000


def reply_to(request: bytes, ip_words: int = 5) -> bytes:
    body = b"\0" + request[1:2] + b"\0\0" + request[4:]
    body = body[:2] + checksum(body).to_bytes(2, "big") + body[4:]
    return bytes((0x40 | ip_words,)) + bytes(4 * ip_words - 1) + body


def test_the_example_of_rfc_1071() -> None:
    assert checksum(bytes.fromhex("0001f203f4f5f6f7")) == 0xFFFF - 0xDDF2


@given(st.integers(0, 0xFFFF), st.integers(0, 0xFFFF), st.binary(max_size=99), st.integers(5, 15))
def test_requests_and_replies(identifier: int, sequence: int, payload: bytes, ip_words: int) -> None:
    request = echo_request(identifier, sequence, payload)
    assert checksum(request) == 0
    reply = reply_to(request, ip_words)
    assert reply_sequence(reply, identifier) == sequence
    assert reply_sequence(reply[4 * ip_words :], None) == sequence
    with pytest.raises(ProtocolError):
        reply_sequence(reply, identifier ^ 1)
    with pytest.raises(ProtocolError):
        reply_sequence(request, None)


@given(st.binary(max_size=80), st.sampled_from([None, 7]))
def test_any_datagram_is_a_reply_or_refused(datagram: bytes, identifier: int | None) -> None:
    with contextlib.suppress(ProtocolError):
        assert 0 <= reply_sequence(datagram, identifier) <= 0xFFFF


def play(pacer: EchoPacer, seconds: float, delay_ns: Callable[[int], int | None], start_ns: int = 0) -> None:
    """Let time pass by the millisecond; `delay_ns(now)` is what a reply takes, None where it gets lost."""
    coming: list[tuple[int, int]] = []
    for now_ns in range(start_ns, start_ns + int(seconds * S), S // 1000):
        while coming and coming[0][0] <= now_ns:
            pacer.replied(heapq.heappop(coming)[1], now_ns)
        for sequence in pacer.due(now_ns):
            delay = delay_ns(now_ns)
            if delay is not None:
                heapq.heappush(coming, (now_ns + delay, sequence))


def test_the_wanted_rate_where_all_is_well() -> None:
    pacer = EchoPacer(400, 0)
    play(pacer, 10, lambda now: 3_000_000)
    assert pacer.sent == pytest.approx(4000, abs=5)
    assert pacer.rate_per_s == 400
    assert (pacer.lost, pacer.backed_off, pacer.reply_share) == (0, 0, 1.0)


def test_more_than_65536_requests() -> None:
    pacer = EchoPacer(1000, 0)
    play(pacer, 70, lambda now: 3_000_000)
    assert pacer.sent > 0x10000
    assert pacer.sent - pacer.replies <= 4
    assert pacer.lost == 0


def test_loss_brings_the_rate_down_and_its_end_up_again() -> None:
    rng = random.Random(1)
    pacer = EchoPacer(400, 0)
    play(pacer, 10, lambda now: None if rng.random() < 0.3 else 3_000_000)
    assert pacer.rate_per_s < 40
    assert pacer.backed_off > 5
    assert pacer.sent < 1500
    play(pacer, 20, lambda now: 3_000_000, 10 * S)
    assert pacer.rate_per_s == 400


def test_a_little_loss_changes_nothing() -> None:
    rng = random.Random(1)
    pacer = EchoPacer(400, 0)
    play(pacer, 10, lambda now: None if rng.random() < 0.03 else 3_000_000)
    assert pacer.rate_per_s == 400
    assert pacer.reply_share == pytest.approx(0.97, abs=0.03)


def test_full_air_is_left_alone() -> None:
    """A bottleneck of 200/s with a deep queue: the rate settles below it without much loss."""
    free_at = 0
    pacer = EchoPacer(400, 0)

    def queued(now: int) -> int:
        nonlocal free_at
        free_at = max(free_at, now) + S // 200
        return free_at - now

    play(pacer, 60, queued)
    assert 100 < pacer.replies / 60 <= 201
    assert pacer.backed_off > 3


def test_a_device_that_never_answers_gets_little() -> None:
    pacer = EchoPacer(400, 0)
    play(pacer, 20, lambda now: None)
    assert pacer.rate_per_s == 10
    assert pacer.reply_share == 0.0
    assert pacer.sent < 1200


def test_a_stall_is_not_made_up_for() -> None:
    pacer = EchoPacer(400, 0)
    assert len(pacer.due(0)) == 1
    assert len(pacer.due(5 * S)) == MAX_BURST
    assert pacer.due(5 * S) == []
    pacer.replied(60_000, 5 * S)  # never sent
    assert pacer.replies == 0
