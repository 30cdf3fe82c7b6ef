"""MJPEG over HTTP, bytes to pictures: response head, chunks, multipart parts and their stamps. No I/O.

There is no standard; this reads what ESP32-CAM (chunked), mjpg-streamer, ustreamer and go2rtc send.
"""

from __future__ import annotations

from dataclasses import dataclass

from vad.errors import ProtocolError

MAX_HEAD_BYTES = 16_384
MAX_PART_BYTES = 16 * 1024 * 1024
_MAX_CHUNK_LINE = 256


@dataclass(frozen=True, slots=True)
class ResponseHead:
    """An HTTP response's status and headers; header names in lower case."""

    status: int
    reason: str
    headers: dict[str, str]


def parse_response_head(data: bytes) -> ResponseHead:
    """`HTTP/1.x status reason` and header lines, up to and with the empty line.

    Raises:
        ProtocolError: not an HTTP response.
    """
    first, _, rest = data.partition(b"\r\n")
    words = first.decode("latin-1").split(" ", 2)
    if len(words) < 2 or not words[0].startswith("HTTP/") or not (words[1].isascii() and words[1].isdigit()):
        raise ProtocolError("the answer is not HTTP", remedy="check the camera's address and port")
    return ResponseHead(int(words[1]), words[2] if len(words) > 2 else "", parse_headers(rest))


def parse_headers(block: bytes) -> dict[str, str]:
    """Header lines to a dict with lower-case names; lines without a colon are skipped."""
    pairs = (line.partition(":") for line in block.decode("latin-1").splitlines())
    return {name.strip().lower(): value.strip() for name, colon, value in pairs if colon}


def boundary_of(head: ResponseHead) -> bytes:
    """The multipart delimiter that a response announces, with its two dashes.

    Some cameras count the dashes as part of the boundary and some do not; both end up the same here.

    Raises:
        ProtocolError: the response is not multipart.
    """
    kind, *parameters = head.headers.get("content-type", "").split(";")
    if not kind.strip().lower().startswith("multipart/"):
        what = f"the address answers with {kind.strip() or 'no content type'}, not with an MJPEG stream"
        raise ProtocolError(what, remedy="use the address of the camera's stream, not of a page or snapshot")
    for parameter in parameters:
        name, _, value = parameter.partition("=")
        bare = value.strip().strip('"').lstrip("-")
        if name.strip().lower() == "boundary" and bare:
            return b"--" + bare.encode("latin-1", "replace")
    raise ProtocolError("the stream names no boundary between its pictures")


class ChunkedDecoder:
    """HTTP/1.1 chunked transfer coding, fed with pieces of any size."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._left = 0
        self._closing = False
        self.ended = False

    def receive(self, data: bytes) -> bytes:
        """The body bytes in `data`.

        Raises:
            ProtocolError: the chunk sizes cannot be read; the connection is lost.
        """
        self._buffer += data
        body = bytearray()
        while self._buffer and not self.ended:
            if self._left:
                body += self._buffer[: self._left]
                taken = min(self._left, len(self._buffer))
                del self._buffer[:taken]
                self._left -= taken
                self._closing = self._left == 0
                continue
            line, newline, _ = self._buffer.partition(b"\n")
            if not newline:
                if len(line) > _MAX_CHUNK_LINE:
                    raise ProtocolError("a chunk of the stream has no readable size")
                break
            del self._buffer[: len(line) + 1]
            self._size_line(bytes(line).strip())
        return bytes(body)

    def _size_line(self, line: bytes) -> None:
        if self._closing and not line:
            self._closing = False
            return
        digits = line.split(b";")[0].strip()
        if not digits or len(digits) > 8 or digits.strip(b"0123456789abcdefABCDEF"):
            raise ProtocolError("a chunk of the stream has no readable size")
        self._left = int(digits, 16)
        self.ended = self._left == 0


@dataclass(frozen=True, slots=True)
class Part:
    """One part of a multipart stream: headers with lower-case names, and the body, usually a JPEG."""

    headers: dict[str, str]
    body: bytes


class MultipartParser:
    """multipart/x-mixed-replace, fed with pieces of any size; Content-Length is used where a part has it.

    `bad` counts parts that were too long or had no readable headers; reading goes on at the next delimiter.

    Args:
        delimiter: with its dashes, see `boundary_of`.
    """

    def __init__(self, delimiter: bytes, max_part_bytes: int = MAX_PART_BYTES) -> None:
        self._delimiter = delimiter
        self._max_part = max_part_bytes
        self._buffer = bytearray()
        self._scanned = 0
        self._headers: dict[str, str] | None = None
        self._length: int | None = None
        self._in_part = False
        self.bad = 0

    def receive(self, data: bytes) -> list[Part]:
        """The parts that `data` completes."""
        self._buffer += data
        parts: list[Part] = []
        while True:
            if not self._in_part:
                progressed = self._find_delimiter()
            elif self._headers is None:
                progressed = self._read_headers()
            else:
                progressed = self._read_body(parts)
            if not progressed:
                return parts

    def _find(self, wanted: bytes) -> int:
        """Index of `wanted`; what was searched before is not searched again."""
        at = self._buffer.find(wanted, max(0, self._scanned - len(wanted) + 1))
        self._scanned = len(self._buffer)
        return at

    def _drop(self, count: int) -> None:
        del self._buffer[:count]
        self._scanned = 0

    def _find_delimiter(self) -> bool:
        at = self._find(self._delimiter)
        if at < 0:
            self._drop(max(0, len(self._buffer) - len(self._delimiter) + 1))
            return False
        self._drop(at + len(self._delimiter))
        self._in_part = True
        return True

    def _read_headers(self) -> bool:
        # Not beyond where a head may end: behind it lies the picture.
        ends = [
            (at, len(gap))
            for gap in (b"\r\n\r\n", b"\n\n")
            if (at := self._buffer.find(gap, 0, MAX_HEAD_BYTES + len(gap))) >= 0
        ]
        if not ends:
            if len(self._buffer) > MAX_HEAD_BYTES:
                self._abandon()
                return True
            return False
        at, gap_length = min(ends)
        block = bytes(self._buffer[:at])
        if block.startswith(b"--"):
            # The closing delimiter: look for the next one.
            self._in_part = False
            return True
        self._drop(at + gap_length)
        self._headers = parse_headers(block)
        announced = self._headers.get("content-length", "")
        self._length = int(announced) if announced.isascii() and announced.isdigit() else None
        if self._length is not None and self._length > self._max_part:
            self._abandon()
        return True

    def _read_body(self, parts: list[Part]) -> bool:
        if self._length is not None:
            if len(self._buffer) < self._length:
                return False
            end = self._length
        else:
            end = self._find(self._delimiter)
            if end < 0:
                if len(self._buffer) > self._max_part:
                    self._abandon()
                    return True
                return False
        body = bytes(self._buffer[:end])
        if self._length is None:
            body = body.removesuffix(b"\r\n")
        parts.append(Part(self._headers or {}, body))
        self._drop(end)
        self._headers, self._in_part = None, False
        return True

    def _abandon(self) -> None:
        self.bad += 1
        self._headers, self._in_part = None, False
        self._scanned = 0
