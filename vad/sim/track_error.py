"""What a camera makes of a walker's place: errors that are new in each frame and errors that last."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vad.mapping.bound import TrackNoise
from vad.mapping.walk import WalkTrack
from vad.sim.scenario import Walk

FloatArray = NDArray[np.float64]

TRACK_HZ = 10.0


def track_error_m(noise: TrackNoise, t_s: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Errors (N, 2) m at increasing times t_s (N,): along both axes alike and independent."""
    fresh = rng.standard_normal((len(t_s), 2))
    keep = np.exp(-np.diff(t_s) / noise.correlation_s)
    slow = fresh.copy()
    for k, kept in enumerate(keep, start=1):
        slow[k] = kept * slow[k - 1] + np.sqrt(1 - kept**2) * fresh[k]
    return noise.white_m * rng.standard_normal((len(t_s), 2)) + noise.slow_m * slow


def seen_walk(walk: Walk, noise: TrackNoise, rng: np.random.Generator) -> WalkTrack:
    """The walk as a camera's track: TRACK_HZ places a second on the home's timeline, with their errors."""
    t_s = np.arange(walk.start_s, walk.end_s, 1 / TRACK_HZ)
    xy_m = true_places_m(walk, t_s) + track_error_m(noise, t_s, rng)
    return WalkTrack(np.rint(t_s * 1e9).astype(np.int64), xy_m, np.full(len(t_s), noise.sigma_m))


def true_places_m(walk: Walk, t_s: FloatArray) -> FloatArray:
    """Where the walker is at t_s (N,); (N, 2) m, held at the walk's ends."""
    table_s = np.linspace(walk.start_s, walk.end_s, len(walk.xy_m))
    return np.stack([np.interp(t_s, table_s, walk.xy_m[:, k]) for k in (0, 1)], axis=1)
