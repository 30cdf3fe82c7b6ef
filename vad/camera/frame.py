"""The one contract of every camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vad.health import Health
from vad.streams import DropOldestQueue

BAD_PICTURES = "bad_pictures"
"""A camera's counter of the pictures that could not be decoded: left out, said once."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One picture. t_ns: exposure on the timeline; image: (height, width, 3) uint8, BGR, raw pixels."""

    t_ns: int
    seq: int
    image: NDArray[np.uint8]


class FrameQueue(DropOldestQueue[Frame]):
    """Frames on their way to one consumer, which says how often it wants one.

    Decoding is most of what a camera costs: a camera leaves the pictures that nobody wants as they came.

    Attributes:
        step_ns: the consumer's: pictures that come sooner than this after the last one wanted are left out.
        unwanted: how many were.
    """

    def __init__(self, maxsize: int) -> None:
        super().__init__(maxsize)
        self.step_ns = 0
        self.unwanted = 0
        self._wanted_ns: int | None = None

    def wants(self, t_ns: int) -> bool:
        """Whether to decode and put the picture of t_ns. For the camera alone, in any one thread, in turn."""
        if self._wanted_ns is not None and 0 <= t_ns - self._wanted_ns < self.step_ns:
            self.unwanted += 1
            return False
        self._wanted_ns = t_ns
        return True


class CameraSource(Protocol):
    """A camera: `run` emits the frames that are wanted until it is cancelled, and reopens by itself."""

    health: Health

    async def run(self, out: FrameQueue) -> None:
        """Emit frames into `out` until cancelled; trouble goes into `health`, never out of here."""
        ...
