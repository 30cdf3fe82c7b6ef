"""The one contract of every camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vad.health import Health
from vad.streams import DropOldestQueue


@dataclass(frozen=True, slots=True)
class Frame:
    """One picture. t_ns: exposure on the timeline; image: (height, width, 3) uint8, BGR, raw pixels."""

    t_ns: int
    seq: int
    image: NDArray[np.uint8]


class CameraSource(Protocol):
    """A camera: `run` emits frames until it is cancelled and reopens by itself."""

    health: Health

    async def run(self, out: DropOldestQueue[Frame]) -> None:
        """Emit frames into `out` until cancelled; trouble goes into `health`, never out of here."""
        ...
