"""Where the robot believes to be: wild poses left out, and where it found itself anew. Pure."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vad.geometry import FloatArray

# Valetudo gives one pose in 2 s (formats.md 4); over a longer gap the robot may have gone anywhere.
MAX_GAP_S = 2.6
# No robot vacuum drives faster; a faster step is a wild pose or a relocalisation.
MAX_SPEED_M_S = 0.6
# Beside what the poses' own spread explains, in standard deviations of a step.
_JUMP_SLACK_M = 0.02
_JUMP_SIGMAS = 2.5
# So many poses in a row that go on from each other are a place that the robot believes in.
_BELIEVED = 5
# A smaller jump shows where lines through the poses before and after do not meet. A robot that stops or
# turns bends them by up to 5 cm.
_LINE_S = 0.55
_LINE_POSES, _LINE_REACH = 4, 15
_BEND_M = 0.05
_LINE_SIGMAS = 4.0


def beliefs(
    t_s: FloatArray, xy_m: FloatArray, sigma_m: FloatArray
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of the poses to keep, in order, and the segment of each: another one after each relocalisation.

    Args:
        t_s: (M,) increasing. xy_m: (M, 2). sigma_m: (M,).
    """
    kept, segment = _chains(t_s, xy_m, sigma_m)
    begins = _breaks(t_s[kept], xy_m[kept], sigma_m[kept], segment)
    begins[1:] |= np.diff(segment) != 0
    return kept, np.asarray(np.cumsum(begins), dtype=np.int64)


def _chains(
    t_s: FloatArray, xy_m: FloatArray, sigma_m: FloatArray
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows that go on from each other at a robot's speed, and the chain of each."""

    def goes_on(a: int, b: int) -> bool:
        """Whether the robot may have driven from pose a to the later pose b."""
        reach = MAX_SPEED_M_S * (t_s[b] - t_s[a]) + _JUMP_SLACK_M
        reach += _JUMP_SIGMAS * np.hypot(sigma_m[a], sigma_m[b])
        return bool(np.linalg.norm(xy_m[b] - xy_m[a]) <= reach)

    count = len(t_s)
    segment = np.full(count, -1, dtype=np.int64)
    current, last = 0, -1
    rival: list[int] = []
    for k in range(count):
        if last < 0 or goes_on(last, k):
            segment[k], last, rival = current, k, []
            continue
        rival = [*rival, k] if rival and goes_on(rival[-1], k) else [k]
        if len(rival) >= _BELIEVED or t_s[k] - t_s[last] > MAX_GAP_S:
            current += 1
            segment[rival], last, rival = current, k, []
    kept = np.flatnonzero(segment >= 0)
    return kept, segment[kept]


def _breaks(
    t_s: FloatArray, xy_m: FloatArray, sigma_m: FloatArray, segment: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """(M,) which poses are the first after a jump, among those that speed alone would allow."""
    count = len(t_s)
    begins = np.zeros(count, dtype=np.bool_)
    if count < 2 * _LINE_POSES:
        return begins
    before, enough_before = _line_ends(t_s, xy_m, segment, range(-_LINE_REACH, 0))
    after, enough_after = _line_ends(t_s, xy_m, segment, range(_LINE_REACH))
    same = np.concatenate([[False], np.diff(segment) == 0])
    known = same & enough_before & enough_after
    gap_m = np.where(known, np.linalg.norm(after - before, axis=1), 0.0)
    for k in np.flatnonzero(gap_m > _BEND_M + _LINE_SIGMAS * sigma_m):
        near = np.abs(t_s - t_s[k]) <= _LINE_S
        begins[k] = gap_m[k] == np.max(gap_m[near])
    return begins


def _line_ends(
    t_s: FloatArray, xy_m: FloatArray, segment: NDArray[np.int64], shifts: range
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Lines through the poses on one side, midway between each pose and the one before it, (M, 2); and which
    of them stand on enough poses."""
    count = len(t_s)
    gap_s = np.diff(t_s, prepend=t_s[:1])
    middle_s = t_s - 0.5 * gap_s
    own = np.concatenate([segment[:1], segment[:-1]]) if shifts.start < 0 else segment
    moments, sums = np.zeros((count, 3)), np.zeros((count, 2, 2))
    for shift in shifts:
        other = np.arange(count) + shift
        inside = (other >= 0) & (other < count)
        other = np.clip(other, 0, count - 1)
        t = t_s[other] - middle_s
        inside &= (np.abs(t) <= _LINE_S + 0.5 * gap_s) & (gap_s <= _LINE_S) & (segment[other] == own)
        powers = np.where(inside[:, None], t[:, None] ** np.arange(3), 0.0)
        moments += powers
        sums += powers[:, :2, None] * xy_m[other][:, None, :]
    enough = moments[:, 0] >= _LINE_POSES
    normal = np.where(enough[:, None], moments, (1.0, 0.0, 1.0))[:, [[0, 1], [1, 2]]]
    return np.asarray(np.linalg.solve(normal, sums)[:, 0], dtype=np.float64), enough
