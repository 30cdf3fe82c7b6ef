"""Who moves, and whether it is one person alone, each with a probability. Pure.

Only a walk of one person alone tells where a device is: what the radio sees of two cannot be told apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import erf, prod, sqrt

import numpy as np

from vad.vision.tracks import HITS_TO_CONFIRM, LOST_AFTER_S, Track

# Who goes faster than this moves; slower is swaying, and the network's jitter.
MOVING_MPS = 0.25
_WINDOW_S = 1.5
# Neighbouring points err alike for some pictures, so that they count for this many fewer.
_POINTS_FOR_ONE = 4.0
# Somebody seen whose place cannot be told (their feet are cut off, say) is as likely to move as not.
_UNPLACED_MOVES = 0.5


@dataclass(frozen=True, slots=True)
class LoneMover:
    """The person most likely to be the one and only one who moves, and the probability that it is so."""

    track: int
    probability: float


def moving(tracks: Sequence[Track], t_ns: int) -> dict[int, float]:
    """For each person who is there at t_ns the probability that they move; ended tracks are left out."""
    return {track.id: _moves(track) for track in tracks if not track.ended and _there(track, t_ns)}


def lone_mover(tracks: Sequence[Track], t_ns: int, *, unplaced: int = 0) -> LoneMover | None:
    """Who moves alone at t_ns, most likely; None where nobody is there.

    unplaced: people seen in the picture who have no place on the floor and so no track.
    """
    moves = moving(tracks, t_ns)
    if not moves:
        return None
    alone = {
        track: p * prod(1.0 - other for k, other in moves.items() if k != track) for track, p in moves.items()
    }
    best = max(alone, key=lambda track: alone[track])
    return LoneMover(best, alone[best] * (1.0 - _UNPLACED_MOVES) ** unplaced)


def _there(track: Track, t_ns: int) -> bool:
    """Whoever was seen as long ago as the tracker waits for them may have gone behind something."""
    return 0 <= t_ns - int(track.t_ns[-1]) < LOST_AFTER_S * 1e9


def _moves(track: Track) -> float:
    """The probability that the speed is above MOVING_MPS, from a line through the latest points.

    One step's swing is no speed: the line spans two or three of them.
    """
    age_s = (track.t_ns[-1] - track.t_ns) * 1e-9
    lately = age_s < _WINDOW_S
    if np.count_nonzero(lately) < HITS_TO_CONFIRM:
        return 0.0
    t, xy = -age_s[lately], track.xy_m[lately]
    t = t - t.mean()
    weight = t / max(float(t @ t), 1e-9)
    velocity = weight @ (xy - xy.mean(axis=0))
    covariance = np.einsum("n,nij->ij", weight**2, track.covariance_m2[lately]) * _POINTS_FOR_ONE
    speed = float(np.hypot(*velocity))
    along = velocity / max(speed, 1e-9)
    sigma = sqrt(max(float(along @ covariance @ along), 1e-12))
    return 0.5 * (1.0 + erf((speed - MOVING_MPS) / sigma / sqrt(2.0)))
