"""Server-sent events over HTTP/1.1: bytes -> events, no I/O (WHATWG HTML 9.2; RFC 9112, 7.1)."""

from __future__ import annotations

from dataclasses import dataclass

from vad.errors import ProtocolError

MAX_LINE_BYTES = 32_000_000
MAX_HEAD_BYTES = 65_536
_MAX_SIZE_LINE = 256


@dataclass(frozen=True, slots=True)
class Event:
    """One event: its name (`message` where the server gives none) and its data."""

    name: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Head:
    """A response's head: status and header fields, names in lower case."""

    status: int
    fields: dict[str, str]


def parse_head(data: bytes) -> Head:
    """The head of a response, without the empty line; ProtocolError for what is no HTTP."""
    lines = data.decode("latin-1").split("\r\n")
    words = lines[0].split(" ", 2)
    if len(words) < 2 or not words[0].startswith("HTTP/1.") or not words[1].isdecimal():
        raise ProtocolError("this is no HTTP response")
    fields = {}
    for line in lines[1:]:
        name, _, value = line.partition(":")
        fields[name.strip().lower()] = value.strip()
    return Head(int(words[1]), fields)


class ChunkedDecoder:
    """Takes the chunked transfer coding off a body; `ended` after the last chunk."""

    def __init__(self) -> None:
        self.ended = False
        self._line = bytearray()
        self._left = 0
        self._between = False

    def feed(self, data: bytes) -> bytes:
        """The body's bytes in `data`; ProtocolError for a size that is none."""
        body = bytearray()
        at = 0
        while at < len(data) and not self.ended:
            if self._left:
                piece = data[at : at + self._left]
                body += piece
                at += len(piece)
                self._left -= len(piece)
                self._between = not self._left
                continue
            end = data.find(b"\n", at)
            stop = len(data) if end < 0 else end + 1
            self._line += data[at:stop]
            at = stop
            if len(self._line) > _MAX_SIZE_LINE:
                raise ProtocolError("a chunk without a size")
            if end >= 0:
                self._take_line(bytes(self._line).strip())
                self._line.clear()
        return bytes(body)

    def _take_line(self, line: bytes) -> None:
        if self._between and not line:
            self._between = False
            return
        try:
            self._left = int(line.partition(b";")[0], 16)
        except ValueError:
            raise ProtocolError("a chunk without a size") from None
        if self._left < 0:
            raise ProtocolError("a chunk without a size")
        self._between = False
        self.ended = self._left == 0


class SseParser:
    """Splits a body into events; comments (keep-alives) give none. Never keeps more than MAX_LINE_BYTES."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._searched = 0
        self._name = ""
        self._data: list[bytes] = []
        self._kept = 0

    def feed(self, data: bytes) -> list[Event]:
        """The events that end in `data`, in order; ProtocolError for one that is too long."""
        self._buffer += data
        events = []
        while (end := self._buffer.find(b"\n", self._searched)) >= 0:
            line = bytes(self._buffer[:end]).removesuffix(b"\r")
            del self._buffer[: end + 1]
            self._searched = 0
            if (event := self._take(line)) is not None:
                events.append(event)
        self._searched = len(self._buffer)
        if len(self._buffer) + self._kept > MAX_LINE_BYTES:
            raise ProtocolError(f"an event of more than {MAX_LINE_BYTES} bytes")
        return events

    def _take(self, line: bytes) -> Event | None:
        if not line:
            event = Event(self._name or "message", b"\n".join(self._data)) if self._data else None
            self._name, self._data, self._kept = "", [], 0
            return event
        field, _, value = line.partition(b":")
        value = value.removeprefix(b" ")
        if field == b"event":
            self._name = value.decode("utf-8", "replace")
        elif field == b"data":
            self._data.append(value)
            self._kept += len(value)
        return None
