"""The robot's path between its poses, and the time offset between poses and frames. Pure."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vad.geometry import FloatArray, apply_homography

# Valetudo gives one pose in 2 s (formats.md 4); over a longer gap the robot may have gone anywhere.
MAX_GAP_S = 2.6
# No robot vacuum drives faster; a faster step is a relocalisation, nothing between its ends is known.
MAX_SPEED_M_S = 1.0
# How far a robot strays from the curve through its poses, as an acceleration.
_STRAY_M_S2 = 0.1
_JUMP_SLACK_M = 0.15

CONSENSUS_M = 0.12
SEARCH_S = 2.0
_COARSE_STEP_S = 0.2
_FINE_STEP_S = 0.05
# RANSAC draws four pairs at a time until four of the robot are likely among them; 0.7 of the frames show it.
_SHOWN = 0.7
_MISS_CHANCE = 0.01
_MIN_ROUNDS, _MAX_ROUNDS = 100, 1000


class PoseTrack:
    """Robot positions as a curve over time: cubic between neighbours, nothing across gaps and jumps.

    Args:
        t_s: (M,) seconds, any origin, any order; doubles are dropped.
        xy_m: (M, 2) map frame. sigma_m: (M,).
    """

    def __init__(self, t_s: ArrayLike, xy_m: ArrayLike, sigma_m: ArrayLike) -> None:
        times = np.asarray(t_s, dtype=np.float64)
        _, order = np.unique(times, return_index=True)
        self.t_s: FloatArray = times[order]
        self.xy_m: FloatArray = np.asarray(xy_m, dtype=np.float64).reshape(-1, 2)[order]
        self.sigma_m: FloatArray = np.asarray(sigma_m, dtype=np.float64)[order]
        steps = np.diff(self.xy_m, axis=0)
        self._dt = np.diff(self.t_s)
        velocity = steps / self._dt[:, None]
        reach = MAX_SPEED_M_S * self._dt + _JUMP_SLACK_M
        self._usable: NDArray[np.bool_] = (self._dt <= MAX_GAP_S) & (np.linalg.norm(steps, axis=1) <= reach)
        weight = np.where(self._usable, 1.0 / self._dt, 0.0)
        total = np.zeros(len(self.t_s))
        slopes = np.zeros_like(self.xy_m)
        for side in (slice(1, None), slice(None, -1)):
            total[side] += weight
            slopes[side] += weight[:, None] * np.where(self._usable[:, None], velocity, 0.0)
        self._slope: FloatArray = slopes / np.maximum(total, 1e-12)[:, None]

    def at(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Position (N, 2) and sigma (N,) at (N,) times; NaN where the track does not say."""
        if len(self.t_s) < 2:
            return np.full((len(t_s), 2), np.nan), np.full(len(t_s), np.nan)
        i = np.clip(np.searchsorted(self.t_s, t_s, side="right") - 1, 0, len(self._dt) - 1)
        dt, since = self._dt[i], t_s - self.t_s[i]
        known = self._usable[i] & (since >= 0.0) & (since <= dt)
        u = (since / dt)[:, None]
        xy = (
            (1.0 + 2.0 * u) * (1.0 - u) ** 2 * self.xy_m[i]
            + u**2 * (3.0 - 2.0 * u) * self.xy_m[i + 1]
            + u * (1.0 - u) ** 2 * dt[:, None] * self._slope[i]
            + u**2 * (u - 1.0) * dt[:, None] * self._slope[i + 1]
        )
        stray = 0.5 * _STRAY_M_S2 * since * (dt - since)
        sigma = np.sqrt(np.maximum(self.sigma_m[i], self.sigma_m[i + 1]) ** 2 + stray**2)
        return np.where(known[:, None], xy, np.nan), np.where(known, sigma, np.nan)

    def interval(self, t_s: FloatArray) -> NDArray[np.int64]:
        """Index of the pair of poses each (N,) time lies between; times that share one share its noise."""
        return np.asarray(np.searchsorted(self.t_s, t_s, side="right"), dtype=np.int64)


@dataclass(frozen=True, slots=True)
class Sightings:
    """What the camera offers: K candidates of all frames together.

    frame: (K,) index of the frame; t_s: (K,) its time from the track's origin; image_px: (K, 2) raw;
    sigma_px: (K,).
    """

    frame: NDArray[np.int64]
    t_s: FloatArray
    image_px: FloatArray
    sigma_px: FloatArray

    def take(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Sightings:
        """The chosen candidates."""
        return Sightings(self.frame[rows], self.t_s[rows], self.image_px[rows], self.sigma_px[rows])


@dataclass(frozen=True, slots=True)
class Consensus:
    """The plane homography most sightings agree with at one time offset (pose stamp minus frame stamp).

    frames: how many agree; support: the same, each weighted by how well it agrees (MSAC), for a count alone
    is flat within +-0.3 s at the speed of a robot.
    """

    time_offset_s: float
    map_from_image: FloatArray
    frames: int
    support: float


def consensus(
    points_px: FloatArray, sightings: Sightings, track: PoseTrack, offset_s: float
) -> Consensus | None:
    """Consensus at one time offset, by RANSAC in the map (formats.md 11, the paper's eq. 4).

    Args:
        points_px: (K, 2) the sightings' pixels with known distortion removed.
    """
    xy, _ = track.at(sightings.t_s + offset_s)
    known = np.isfinite(xy[:, 0]) & np.isfinite(points_px[:, 0])
    if np.count_nonzero(known) < 8:
        return None
    per_frame = len(sightings.frame) / len(np.unique(sightings.frame))
    good_draw = (_SHOWN / per_frame) ** 4
    rounds = int(np.clip(np.log(_MISS_CHANCE) / np.log1p(-good_draw), _MIN_ROUNDS, _MAX_ROUNDS))
    found, _ = cv2.findHomography(
        points_px[known], xy[known], cv2.RANSAC, CONSENSUS_M, maxIters=rounds, confidence=0.999
    )
    if found is None or not np.all(np.isfinite(found)):
        return None
    homography = np.asarray(found, dtype=np.float64)
    miss = np.linalg.norm(apply_homography(homography, points_px) - xy, axis=1)
    score = np.zeros(int(sightings.frame.max()) + 1)
    close = np.where(miss < CONSENSUS_M, 1.0 - (miss / CONSENSUS_M) ** 2, 0.0)
    np.maximum.at(score, sightings.frame, close)
    return Consensus(offset_s, homography, int(np.count_nonzero(score)), float(np.sum(score)))


def search_time_offset(points_px: FloatArray, sightings: Sightings, track: PoseTrack) -> Consensus | None:
    """The offset within +-2 s with the best supported consensus, coarse to fine; None without any."""
    half = round(SEARCH_S / _COARSE_STEP_S)
    # From zero outwards, so that of equals the smaller offset wins.
    coarse = sorted(range(-half, half + 1), key=abs)
    best = _best(points_px, sightings, track, [k * _COARSE_STEP_S for k in coarse])
    if best is None:
        return None
    reach = round(_COARSE_STEP_S / _FINE_STEP_S)
    fine = [best.time_offset_s + k * _FINE_STEP_S for k in range(-reach, reach + 1)]
    return _best(points_px, sightings, track, fine) or best


def _best(
    points_px: FloatArray, sightings: Sightings, track: PoseTrack, offsets_s: list[float]
) -> Consensus | None:
    found = [c for o in offsets_s if (c := consensus(points_px, sightings, track, o)) is not None]
    return max(found, key=lambda c: c.support, default=None)
