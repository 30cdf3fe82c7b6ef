"""How long a walk is recorded: until the place is sharp, the ground is covered, or time is up. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

GONE_S = 1.5
"""A walker unseen for so long has left the picture."""
SILENT_S = 3.0
"""Devices unheard for so long have ceased to send."""
LATE_S = 1.0
"""A second person is noticed at most so late: that much of the walk is not used."""
CELL_M = 0.5
STALE_GROUND_S = 8.0
"""A walker who came to no new place for so long walks in circles."""
MIN_BREADTH_M = 0.35
"""Narrower ground leaves a mirror image: it is not covered however long somebody paces there."""


class Ground:
    """The floor that a walker has covered, in cells of CELL_M."""

    def __init__(self) -> None:
        self._cells: dict[tuple[int, int], None] = {}
        self._new_ns: int | None = None

    def add(self, t_ns: int, x_m: float, y_m: float) -> None:
        """The walker is there."""
        cell = int(np.floor(x_m / CELL_M)), int(np.floor(y_m / CELL_M))
        if cell not in self._cells:
            self._cells[cell] = None
            self._new_ns = t_ns

    def covered(self, now_ns: int) -> bool:
        """Whether the walker covers broad ground and comes to nothing new any more."""
        if self._new_ns is None or now_ns - self._new_ns < STALE_GROUND_S * 1e9:
            return False
        places: FloatArray = (np.array(list(self._cells), dtype=np.float64) + 0.5) * CELL_M
        if len(places) < 4:
            return False
        return float(np.sqrt(max(0.0, np.linalg.eigvalsh(np.cov(places.T))[0]))) >= MIN_BREADTH_M


@dataclass(frozen=True, slots=True)
class Progress:
    """How a record stands.

    seconds: since it began; unseen_s: since the walker was last seen; alone: nobody else moves; unheard_s:
    since any of the devices was last heard well; sharp: every device's place would be sharp by now; covered:
    see Ground.
    """

    seconds: float
    unseen_s: float = 0.0
    alone: bool = True
    unheard_s: float = 0.0
    sharp: bool = False
    covered: bool = False


@dataclass(frozen=True, slots=True)
class Judgement:
    """go on; finish: solve what there is; abort: nothing can be made of it. its_fault: the devices'."""

    act: Literal["go on", "finish", "abort"]
    reason: str = ""
    its_fault: bool = False


GO_ON = Judgement("go on")


def judge(progress: Progress, *, min_s: float, max_s: float) -> Judgement:
    """What to do with a record that stands so. min_s, max_s: of walking, seconds."""
    p = progress
    if not p.alone:
        if p.seconds - LATE_S >= min_s:
            return Judgement("finish", "somebody else came: the walk up to there is used")
        return Judgement("abort", "somebody else moved in the picture")
    if p.unseen_s > GONE_S:
        if p.seconds - p.unseen_s >= min_s:
            return Judgement("finish", "the walker left")
        return Judgement("abort", "the walker left after a few seconds")
    if p.unheard_s > SILENT_S:
        if p.seconds - p.unheard_s >= min_s:
            return Judgement("finish", "the packets ceased: the walk up to there is used")
        return Judgement("abort", "it ceased to send", its_fault=True)
    if p.seconds >= max_s:
        return Judgement("finish", "time is up")
    if p.seconds >= min_s and p.sharp:
        return Judgement("finish", "sharp enough")
    if p.seconds >= min_s and p.covered:
        return Judgement("finish", "the ground is covered")
    return GO_ON
