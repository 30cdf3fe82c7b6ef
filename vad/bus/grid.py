"""The occupancy grid and the posterior as pictures; map_server's greys, so that every viewer shows a plan."""

from __future__ import annotations

import io
import re

import cv2
import numpy as np
from numpy.typing import NDArray

from vad.errors import ProtocolError

MAX_SIDE = 8192
"""Pixels of a picture that is read: a small file must not unpack into the whole memory."""
_NPY = re.compile(
    rb"\x93NUMPY\x01\x00..\{'descr': '<f4', 'fortran_order': False, "
    rb"'shape': \((\d{1,4}), (\d{1,4})\), \} *\n",
    re.DOTALL,
)
"""The one head of a NumPy file that is written here; numpy reads any, and as Python."""
_PNG = b"\x89PNG\r\n\x1a\n"

FREE_GREY, UNKNOWN_GREY, OCCUPIED_GREY = 254, 205, 0


def grid_to_png(occupancy: NDArray[np.int8]) -> bytes:
    """PNG of an occupancy grid (formats.md section 6).

    occupancy: (height, width) int8, row 0 at the bottom (smallest y), 0 free, 100 occupied, -1 unknown; what
    lies between counts as occupied from 65 on, as free up to 19, else as unknown. The picture's first row is
    the top of the plan.
    """
    grey = np.full(occupancy.shape, UNKNOWN_GREY, np.uint8)
    grey[(occupancy >= 0) & (occupancy <= 19)] = FREE_GREY
    grey[occupancy >= 65] = OCCUPIED_GREY
    encoded, data = cv2.imencode(".png", np.ascontiguousarray(grey[::-1]))
    if not encoded:
        raise ValueError(f"a grid of {occupancy.shape} cells cannot become a picture")
    return data.tobytes()


def png_to_grid(png: bytes) -> NDArray[np.int8]:
    """The (height, width) int8 grid that `grid_to_png` wrote, row 0 at the bottom; else ProtocolError."""
    _check_png(png)
    grey = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
    if grey is None:
        raise ProtocolError("the map grid is not a picture")
    grid = np.full(grey.shape, -1, np.int8)
    grid[grey == FREE_GREY] = 0
    grid[grey == OCCUPIED_GREY] = 100
    return grid[::-1]


def _check_png(png: bytes) -> None:
    """ProtocolError for what OpenCV would take memory for that the file does not hold."""
    if not png.startswith(_PNG):
        raise ProtocolError("the map grid is no PNG")
    at = len(_PNG)
    while at < len(png):
        length, kind = int.from_bytes(png[at : at + 4]), png[at + 4 : at + 8]
        if at + 12 + length > len(png):
            raise ProtocolError("the map grid is cut off")
        if kind == b"IHDR":
            sides = int.from_bytes(png[at + 8 : at + 12]), int.from_bytes(png[at + 12 : at + 16])
            if max(sides) > MAX_SIDE:
                raise ProtocolError(f"a map grid of {sides[0]} x {sides[1]} is larger than any home")
        at += 12 + length


def heatmap_to_png(probability: NDArray[np.float32]) -> bytes:
    """PNG of a posterior to lay over the floor plan: warm where the device is, clear where it is not.

    probability: (height, width), row 0 at the bottom. One pixel a cell, colour and opacity by the square root
    of the share of the peak, so that the flanks show; the picture's first row is the top of the plan.
    """
    share = np.sqrt(probability / np.maximum(probability.max(), np.float32(1e-30)))
    level = np.rint(255 * share).astype(np.uint8)[::-1]
    colour = cv2.applyColorMap(np.ascontiguousarray(level), cv2.COLORMAP_INFERNO)
    encoded, data = cv2.imencode(".png", np.dstack([colour, level]))
    if not encoded:
        raise ValueError(f"a heatmap of {probability.shape} cells cannot become a picture")
    return data.tobytes()


def heatmap_to_npy(probability: NDArray[np.float32]) -> bytes:
    """A posterior as a NumPy file, (height, width) little-endian float32, row 0 at y0."""
    file = io.BytesIO()
    np.save(file, np.ascontiguousarray(probability, "<f4"), allow_pickle=False)
    return file.getvalue()


def npy_to_heatmap(payload: bytes) -> NDArray[np.float32]:
    """The (height, width) float32 array that `heatmap_to_npy` wrote; else ProtocolError."""
    head = _NPY.match(payload)
    if head is None:
        raise ProtocolError("the heatmap is no array, or not float32 of two axes")
    height, width = int(head[1]), int(head[2])
    if len(payload) - head.end() != 4 * height * width:
        raise ProtocolError(f"the heatmap is no array of {height} x {width} as it says")
    return np.frombuffer(payload, "<f4", offset=head.end()).astype(np.float32).reshape(height, width)
