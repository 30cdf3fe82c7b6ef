"""PGM pictures, binary (P5) and text (P2): bytes <-> pixels."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from vad.errors import ProtocolError

MAX_PIXELS = 64_000_000
"""A hall of 400 m x 400 m at 5 cm; a larger size is taken for a broken header."""

_GAP = rb"(?:\s|#[^\n]*\n)+"
_HEADER = re.compile(rb"P([25])" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,9})")
_COMMENT = re.compile(rb"#[^\n]*")
_REMEDY = "Save it again as an 8-bit PGM, e.g. with map_saver_cli --fmt pgm or convert map.png map.pgm"


def parse_pgm(data: bytes, *, where: str) -> tuple[NDArray[np.uint16], int]:
    """Pixels (rows, cols) uint16, row 0 at the top, and the value of white; ProtocolError naming `where`."""
    header = _HEADER.match(data)
    if header is None:
        raise _error("this is not a PGM picture (P5 or P2)", where)
    kind, cols, rows, maxval = (int(group) for group in header.groups())
    if not 0 < maxval < 65_536:
        raise _error(f"{maxval} as the value of white is outside 1..65535", where)
    if not 0 < rows * cols <= MAX_PIXELS:
        raise _error(f"a size of {cols} x {rows} pixels cannot be used", where)
    # Exactly one white byte ends a P5 header; what follows may look like white space, too.
    body = data[header.end() + 1 :]
    pixels = _binary(body, rows * cols, maxval) if kind == 5 else _text(body, rows * cols)
    if pixels is None or pixels.size < rows * cols:
        raise _error(f"the picture ends before its {cols} x {rows} pixels, or has text in them", where)
    if pixels.max() > maxval:
        raise _error(f"a pixel is whiter than white ({maxval})", where)
    return pixels.reshape(rows, cols), maxval


def _binary(body: bytes, count: int, maxval: int) -> NDArray[np.uint16] | None:
    dtype = np.dtype(np.uint8) if maxval < 256 else np.dtype(">u2")
    if len(body) < count * dtype.itemsize:
        return None
    return np.frombuffer(body, dtype, count).astype(np.uint16)


def _text(body: bytes, count: int) -> NDArray[np.uint16] | None:
    words = _COMMENT.sub(b"", body).split(None, count)[:count]
    if not all(word.isdigit() and len(word) < 6 for word in words):
        return None
    return np.minimum(np.array(words, np.int64), 65_535).astype(np.uint16)


def pgm_bytes(pixels: NDArray[np.uint8]) -> bytes:
    """A binary PGM (P5) of pixels (rows, cols), row 0 at the top."""
    rows, cols = pixels.shape
    return b"P5\n%d %d\n255\n" % (cols, rows) + pixels.tobytes()


def _error(what: str, where: str) -> ProtocolError:
    return ProtocolError(what, where=where, remedy=_REMEDY)
