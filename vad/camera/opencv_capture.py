"""A cv2.VideoCapture, grabbed and decoded apart: what V4L2 and RTSP cameras have in common."""

from __future__ import annotations

import time
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from vad.errors import SourceError

BAD_IN_A_ROW = 30
"""Single pictures come damaged from cheap cameras and poor networks; so many one after the other do not."""


class Capture(Protocol):
    """What is used of cv2.VideoCapture."""

    def isOpened(self) -> bool: ...  # noqa: N802
    def grab(self) -> bool: ...
    def retrieve(self) -> tuple[bool, Any]: ...
    def get(self, prop: int, /) -> float: ...
    def set(self, prop: int, value: float, /) -> bool: ...
    def release(self) -> None: ...


class Grabber:
    """Takes pictures from an opened capture. where: the camera's, for what it raises."""

    def __init__(self, capture: Capture, where: str) -> None:
        self._bad_in_a_row = 0
        self._capture = capture
        self._where = where

    def grab(self) -> int:
        """Wait for the next picture; when it came, ns of the timeline.

        Raises:
            SourceError: none comes any more.
        """
        good = self._capture.grab()
        arrival_ns = time.monotonic_ns()
        if not good:
            raise SourceError("the camera has stopped sending", where=self._where)
        return arrival_ns

    def decode(self) -> tuple[NDArray[np.uint8], int] | None:
        """The picture that was grabbed, (height, width, 3) BGR, and how many damaged ones came right before
        it; None where it is damaged itself.

        Raises:
            SourceError: that was so for the last BAD_IN_A_ROW.
        """
        good, image = self._capture.retrieve()
        if good and image is not None and image.size:
            bad, self._bad_in_a_row = self._bad_in_a_row, 0
            return np.asarray(image, dtype=np.uint8), bad
        self._bad_in_a_row += 1
        if self._bad_in_a_row >= BAD_IN_A_ROW:
            remedy = "choose another pixel format, or look at its cable and its network"
            raise SourceError("the camera's pictures cannot be decoded", where=self._where, remedy=remedy)
        return None
