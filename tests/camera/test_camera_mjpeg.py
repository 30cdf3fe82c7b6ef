"""The MJPEG parser and the stamps: pieces of any size, all the dialects of real cameras, rubbish."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vad.camera.mjpeg import (
    ChunkedDecoder,
    MultipartParser,
    Part,
    ResponseHead,
    boundary_of,
    parse_response_head,
)
from vad.camera.stamps import StreamClock, parse_seconds_ns
from vad.errors import ProtocolError

S_NS = 1_000_000_000
DELIMITER = b"--frame"


def pieces(data: bytes, cuts: list[int]) -> list[bytes]:
    edges = [0, *sorted(c % (len(data) + 1) for c in cuts), len(data)]
    return [data[a:b] for a, b in pairwise(edges)]


def with_length(body: bytes, stamp: str = "1.5") -> bytes:
    head = f"Content-Type: image/jpeg\r\nContent-Length: {len(body)}\r\nX-Timestamp: {stamp}\r\n\r\n"
    return DELIMITER + b"\r\n" + head.encode() + body + b"\r\n"


def without_length(body: bytes) -> bytes:
    return DELIMITER + b"\r\nContent-Type: image/jpeg\r\n\r\n" + body + b"\r\n"


bodies = st.lists(
    st.binary(min_size=1, max_size=60).filter(lambda b: DELIMITER not in b), min_size=1, max_size=5
)


@given(bodies=bodies, lengths=st.booleans(), cuts=st.lists(st.integers(0, 2000), max_size=12))
def test_parts_come_whole_however_the_bytes_come(bodies: list[bytes], lengths: bool, cuts: list[int]) -> None:
    # A body that ends in a line end cannot be told from the delimiter's own without a length.
    stream = b"preamble\r\n" + b"".join(
        with_length(b) if lengths else without_length(b + b".") for b in bodies
    )
    parser = MultipartParser(DELIMITER)
    got = [part for piece in pieces(stream + DELIMITER, cuts) for part in parser.receive(piece)]
    assert [p.body for p in got] == (bodies if lengths else [b + b"." for b in bodies])
    assert parser.bad == 0
    if lengths:
        assert got[0].headers["x-timestamp"] == "1.5"


def test_one_byte_at_a_time() -> None:
    stream = (
        with_length(b"\xff\xd8abc\xff\xd9") + without_length(b"\xff\xd8xyz\xff\xd9") + DELIMITER + b"--\r\n"
    )
    parser = MultipartParser(DELIMITER)
    got = [part.body for k in range(len(stream)) for part in parser.receive(stream[k : k + 1])]
    assert got == [b"\xff\xd8abc\xff\xd9", b"\xff\xd8xyz\xff\xd9"]


@given(st.lists(st.binary(max_size=200), max_size=20))
def test_rubbish_is_bounded_and_a_picture_after_it_is_read(rubbish: list[bytes]) -> None:
    parser = MultipartParser(DELIMITER, max_part_bytes=100)
    for piece in rubbish:
        parser.receive(piece)
    parser.receive(b"\r\n" + DELIMITER + b"\r\n\r\n" + b"x" * 300)
    got = parser.receive(with_length(b"good") + with_length(b"next"))
    assert Part({"content-type": "image/jpeg", "content-length": "4", "x-timestamp": "1.5"}, b"next") in got


@pytest.mark.parametrize("size", [b"Content-Length: 999999999\r\n", b""])
def test_too_long_a_part_is_counted_and_left(size: bytes) -> None:
    parser = MultipartParser(DELIMITER, max_part_bytes=1000)
    assert parser.receive(DELIMITER + b"\r\nA: b\r\n" + size + b"\r\n" + b"x" * 5000) == []
    assert parser.bad == 1
    assert [p.body for p in parser.receive(b"\r\n" + with_length(b"ok"))] == [b"ok"]


def test_endless_headers_are_counted_and_left() -> None:
    parser = MultipartParser(DELIMITER)
    for _ in range(40):
        assert parser.receive(b"".join([DELIMITER, b"\r\n", b"h" * 1000])) == []
    assert parser.bad >= 1
    assert [p.body for p in parser.receive(b"\r\n\r\n\r\n" + with_length(b"ok"))][-1] == b"ok"


@given(
    chunks=st.lists(st.binary(min_size=1, max_size=50), max_size=6),
    cuts=st.lists(st.integers(0, 900), max_size=9),
)
def test_chunked_body(chunks: list[bytes], cuts: list[int]) -> None:
    coded = b"".join(f"{len(c):x};note=1\r\n".encode() + c + b"\r\n" for c in chunks) + b"0\r\n\r\n"
    decoder = ChunkedDecoder()
    assert b"".join(decoder.receive(p) for p in pieces(coded, cuts)) == b"".join(chunks)
    assert decoder.ended


@pytest.mark.parametrize(
    "bad", [b"zz\r\n", b"\r\n", b"-1\r\n", b"1" * 300, b"123456789\r\n", b"3\r\nabcX\r\n"]
)
def test_bad_chunk_sizes_are_refused(bad: bytes) -> None:
    with pytest.raises(ProtocolError):
        ChunkedDecoder().receive(bad)


@pytest.mark.parametrize(
    ("kind", "delimiter"),
    [
        ("multipart/x-mixed-replace;boundary=frame", b"--frame"),
        ("multipart/x-mixed-replace; boundary=--frame", b"--frame"),
        ('Multipart/X-Mixed-Replace; charset=x; Boundary="frame"', b"--frame"),
    ],
)
def test_boundary(kind: str, delimiter: bytes) -> None:
    assert boundary_of(ResponseHead(200, "OK", {"content-type": kind})) == delimiter


@pytest.mark.parametrize(
    "kind", ["text/html", "", "multipart/x-mixed-replace", "multipart/mixed; boundary=--"]
)
def test_no_boundary(kind: str) -> None:
    with pytest.raises(ProtocolError):
        boundary_of(ResponseHead(200, "OK", {"content-type": kind}))


def test_response_head() -> None:
    head = parse_response_head(b"HTTP/1.0 401 Not Allowed\r\nX: 1\r\nrubbish\r\nY:2\r\n\r\n")
    assert head == ResponseHead(401, "Not Allowed", {"x": "1", "y": "2"})
    for bad in (b"", b"RTSP/1.0 200 OK\r\n", b"HTTP/1.1\r\n", b"HTTP/1.1 abc\r\n"):
        with pytest.raises(ProtocolError):
            parse_response_head(bad)


@given(st.integers(0, 10**11 - 1), st.integers(0, 999_999))
def test_seconds_are_exact(seconds: int, micro: int) -> None:
    assert parse_seconds_ns(f"{seconds}.{micro:06d}") == seconds * S_NS + micro * 1000


@pytest.mark.parametrize("text", ["", "a", "-1.0", "1.x", "1.2.3", "9" * 30, "٣.1", "1e5"])
def test_what_is_no_stamp(text: str) -> None:
    assert parse_seconds_ns(text) is None


ARRIVAL_NS, WALL_NS = 5_000 * S_NS, 1_700_000_000 * S_NS


@pytest.mark.parametrize(
    ("headers", "source", "age_ns"),
    [
        ({"x-timestamp": "4999.900000"}, "monotonic", S_NS // 10),
        ({"x-timestamp": "1699999999.800000"}, "wall", S_NS // 5),
        ({"x-timestamp": "1700000000.0", "x-ustreamer-grab-time": "4999.95"}, "monotonic", S_NS // 20),
        ({"x-timestamp": "77.000000"}, "arrival", 0),
        ({}, "arrival", 0),
        ({"x-timestamp": "5000.010000"}, "monotonic", 0),
    ],
)
def test_clock_is_decided_by_plausibility(headers: dict[str, str], source: str, age_ns: int) -> None:
    clock = StreamClock()
    assert clock.stamp(headers, ARRIVAL_NS, WALL_NS) == ARRIVAL_NS - age_ns
    assert clock.source == source


def test_clock_is_decided_once_and_odd_stamps_are_counted() -> None:
    clock = StreamClock()
    clock.stamp({"x-timestamp": "4999.9"}, ARRIVAL_NS, WALL_NS)
    later = ARRIVAL_NS + S_NS
    assert clock.stamp({"x-timestamp": "1700000000.9"}, later, WALL_NS + S_NS) == later
    assert clock.stamp({}, later, WALL_NS + S_NS) == later
    assert clock.stamp({"x-timestamp": "5000.9"}, later, WALL_NS + S_NS) == later - S_NS // 10
    assert (clock.source, clock.refused) == ("monotonic", 2)
