"""How much work something is, told on any machine: by fixed work that is done beside it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import cv2
import numpy as np

_PICTURE = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
_PHASES = np.linspace(0.0, 50.0, 30_000).reshape(300, 100)


def _unit() -> None:
    """Some of what vad does most: OpenCV on a picture, NumPy on complex numbers, plain Python."""
    blurred = cv2.GaussianBlur(_PICTURE, (0, 0), 3.0)
    cv2.cvtColor(cv2.resize(blurred, (320, 240), interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2LAB)
    np.abs(np.exp(1j * _PHASES).sum(axis=1)).max()
    sum(k * k for k in range(10_000))


@contextmanager
def _one_thread() -> Iterator[None]:
    """OpenCV's own threads spin while they wait: what they spend says how many cores there are."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)


def _spent_s(work: Callable[[], object]) -> float:
    begun_s = time.thread_time()
    work()
    return time.thread_time() - begun_s


def effort(*works: Callable[[], object]) -> float:
    """The processor time of the median of `works`, in units; this thread's only.

    Each is done beside a unit: what slows the one down, another program on the same core or its clock's
    rate, slows the other down, too.
    """
    with _one_thread():
        _unit()
        ratios = []
        for work in works:
            before_s = _spent_s(_unit)
            work_s = _spent_s(work)
            ratios.append(2.0 * work_s / (before_s + _spent_s(_unit)))
    return float(np.median(ratios))
