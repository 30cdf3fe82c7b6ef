"""Which of what moves in the pictures is the robot, and the time offset of its poses. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vad.geometry import FloatArray, apply_homography
from vad.mapping.camera_track import PoseTrack

CONSENSUS_M = 0.12
SEARCH_S = 2.0
_COARSE_STEP_S = 0.2
_FINE_STEP_S = 0.05
_RIVALS = 3
_RIVAL_SUPPORT = 0.85
# RANSAC draws four pairs at a time until four of the robot are likely among them; 0.7 of the frames show it.
_SHOWN = 0.7
_MISS_CHANCE = 0.01
_MIN_ROUNDS, _MAX_ROUNDS = 100, 1000


@dataclass(frozen=True, slots=True)
class Sightings:
    """What the camera offers: K candidates of all frames together.

    frame: (K,) index of the frame; t_s: (K,) its time from the track's origin; image_px: (K, 2) raw;
    sigma_px: (K,). box: (K, 4) x0, y0, x1, y1 where the contact was made from a box, raw, NaN elsewhere.
    """

    frame: NDArray[np.int64]
    t_s: FloatArray
    image_px: FloatArray
    sigma_px: FloatArray
    box: FloatArray | None = None

    def take(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Sightings:
        """The chosen candidates."""
        box = None if self.box is None else self.box[rows]
        return Sightings(self.frame[rows], self.t_s[rows], self.image_px[rows], self.sigma_px[rows], box)


@dataclass(frozen=True, slots=True)
class Candidates:
    """What may be the robot in one frame: px (N, 2), sigma_px (N,), box (N, 4), as in Sightings."""

    t_ns: int
    px: FloatArray
    sigma_px: FloatArray
    box: FloatArray

    @classmethod
    def of(cls, t_ns: int, image_px: ArrayLike, sigma_px: ArrayLike, box_px: ArrayLike | None) -> Candidates:
        """From what `CameraMapper.add_candidates` takes."""
        px = np.asarray(image_px, dtype=np.float64).reshape(-1, 2)
        sigma = np.broadcast_to(np.asarray(sigma_px, dtype=np.float64), (len(px),)).copy()
        box = np.full((len(px), 4), np.nan) if box_px is None else np.asarray(box_px, dtype=np.float64)
        return cls(t_ns, px, sigma, box.reshape(-1, 4))


def sightings_of(frames: Sequence[Candidates], origin_ns: int) -> Sightings:
    """The candidates of frames, one after the other; times from `origin_ns` on."""
    counts = [len(frame.px) for frame in frames]
    box = np.concatenate([np.empty((0, 4)), *(frame.box for frame in frames)])
    return Sightings(
        np.repeat(np.arange(len(frames)), counts),
        np.repeat(np.array([1e-9 * (frame.t_ns - origin_ns) for frame in frames]), counts),
        np.concatenate([np.empty((0, 2)), *(frame.px for frame in frames)]),
        np.concatenate([np.empty(0), *(frame.sigma_px for frame in frames)]),
        box if np.isfinite(box).any() else None,
    )


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


def search_time_offset(points_px: FloatArray, sightings: Sightings, track: PoseTrack) -> list[Consensus]:
    """The offsets within +-2 s with the best supported consensus, the best first, coarse to fine.

    Several where support has several tops nearly as high: a robot that drives in circles looks late as it
    looks turned.
    """
    half = round(SEARCH_S / _COARSE_STEP_S)
    coarse = [_best(points_px, sightings, track, [k * _COARSE_STEP_S]) for k in range(-half, half + 1)]
    support = np.array([0.0, *(0.0 if c is None else c.support for c in coarse), 0.0])
    top = (
        (support[1:-1] >= support[:-2])
        & (support[1:-1] > support[2:])
        & (support[1:-1] > _RIVAL_SUPPORT * support.max())
    )
    tops = [coarse[k] for k in np.flatnonzero(top)]
    # Of equals the smaller offset wins.
    ranked = sorted((c for c in tops if c is not None), key=lambda c: (-c.support, abs(c.time_offset_s)))
    reach = round(_COARSE_STEP_S / _FINE_STEP_S)
    steps = [k * _FINE_STEP_S for k in range(-reach, reach + 1)]
    fine = [
        _best(points_px, sightings, track, [c.time_offset_s + step for step in steps])
        for c in ranked[:_RIVALS]
    ]
    return [c for c in fine if c is not None]


def _best(
    points_px: FloatArray, sightings: Sightings, track: PoseTrack, offsets_s: list[float]
) -> Consensus | None:
    found = [c for o in offsets_s if (c := consensus(points_px, sightings, track, o)) is not None]
    return max(found, key=lambda c: c.support, default=None)
