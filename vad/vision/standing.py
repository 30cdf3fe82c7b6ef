"""Where somebody stands on the floor, from one picture: by their feet, or by the rest where those are hidden.

The feet give the ground point of the paper's equations 5 and 6 (vad.vision.ground). Behind furniture they are
not seen, or are guessed wrongly: then hips, shoulders and crown and the usual stature say where the body
stands, with the larger covariance that comes of not knowing the stature.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vad.vision.body import (
    ANKLES,
    CROWN,
    HEIGHTS,
    HIPS,
    SHOULDERS,
    STATURE_M,
    STATURE_SIGMA_M,
    Body,
    Camera,
    body_of,
)
from vad.vision.clothes import clothes
from vad.vision.ground import GroundPoint, Refusal, feet_cut, ground_point
from vad.vision.people import Image, Person

FloatArray = NDArray[np.float64]

# Standard deviations of hips, shoulders and crown in one picture and of their heights, shares of the stature.
_SIGMA, _SIGMA_HEIGHT = 0.014, 0.015
# Feet and trunk contradict each other beyond this squared Mahalanobis distance (3 sigma, 2 dimensions).
_CONTRADICTION = 11.8
_STEPS = 3
_DIFFERENCE_M = 1e-3


@dataclass(frozen=True, slots=True)
class Standing:
    """One person on the floor. xy_m: (2,) map; covariance_m2: (2, 2), the camera taken as known exactly;
    body: for the walk's smoother, None where no upright trunk is seen; by_feet: whether the feet are seen;
    clothes: their colours, None where not seen."""

    xy_m: FloatArray
    covariance_m2: FloatArray
    body: Body | None
    by_feet: bool
    clothes: FloatArray | None = None


def standing(person: Person, image: Image, camera: Camera) -> Standing | Refusal:
    """Where a person found in `image`, (height, width, 3) uint8 BGR, stands, or why that cannot be told."""
    found = _place(person, (image.shape[1], image.shape[0]), camera)
    return found if isinstance(found, Refusal) else replace(found, clothes=clothes(image, person))


def _place(person: Person, image_size: tuple[int, int], camera: Camera) -> Standing | Refusal:
    cut = feet_cut(person, image_size)
    if cut is not None:
        return cut
    body = body_of(person)
    feet = ground_point(person, image_size)
    by_feet = _on_floor(feet, camera) if isinstance(feet, GroundPoint) else None
    by_trunk = None if body is None else _by_trunk(body, camera)
    if by_trunk is None:
        if by_feet is None:
            return feet if isinstance(feet, Refusal) else Refusal("the feet are above the horizon")
        return Standing(*by_feet, None, True)
    if by_feet is not None:
        apart = by_feet[0] - by_trunk[0]
        if apart @ np.linalg.solve(by_feet[1] + by_trunk[1], apart) < _CONTRADICTION:
            return Standing(*by_feet, body, True)
    assert body is not None
    spread = body.spread.copy()
    spread[ANKLES] = np.inf
    return Standing(*by_trunk, replace(body, spread=spread), False)


def _on_floor(feet: GroundPoint, camera: Camera) -> tuple[FloatArray, FloatArray] | None:
    half = 0.5
    px = np.array([feet.x_px, feet.y_px]) + np.array([[0, 0], [half, 0], [-half, 0], [0, half], [0, -half]])
    xy = camera.at_height(camera.straight(px), 0.0)
    if not np.isfinite(xy).all():
        return None
    by_pixel = np.column_stack([xy[1] - xy[2], xy[3] - xy[4]])
    return xy[0], by_pixel @ feet.covariance_px2 @ by_pixel.T


def _by_trunk(body: Body, camera: Camera) -> tuple[FloatArray, FloatArray] | None:
    """Place and covariance from all but the feet: least squares over the place and the stature."""
    groups = [g for g in (HIPS, SHOULDERS, CROWN) if np.isfinite(body.spread[g])]
    seen = camera.straight(body.points_px[groups])
    start = camera.at_height(seen[:1], HEIGHTS[HIPS] * STATURE_M)[0]
    if not np.isfinite(start).all():
        return None
    guess = np.array([*start, STATURE_M])

    def pixels(at: FloatArray) -> FloatArray:
        heights = HEIGHTS[groups] * at[2]
        return camera.pixels(np.column_stack([np.tile(at[:2], (len(groups), 1)), heights]))

    # A crown's x is no measurement.
    rows = np.array([[True, True]] * len(groups))
    rows[[k for k, g in enumerate(groups) if g == CROWN], 0] = False
    prior = np.diag([0.0, 0.0, 1.0 / STATURE_SIGMA_M**2])
    information = np.eye(3)
    for _ in range(_STEPS):
        shown = pixels(guess)
        steps = np.eye(3) * _DIFFERENCE_M
        by = np.stack([(pixels(guess + d) - pixels(guess - d)) / (2 * _DIFFERENCE_M) for d in steps], axis=-1)
        ends = camera.pixels(np.array([[*guess[:2], 0.0], [*guess[:2], guess[2]]]))
        tall_px = float(np.linalg.norm(ends[0] - ends[1]))
        sigma = np.array([np.hypot(_SIGMA * body.spread[g], _SIGMA_HEIGHT) for g in groups]) * tall_px
        design = (by / sigma[:, None, None])[rows]
        error = ((seen - shown) / sigma[:, None])[rows]
        information = design.T @ design + prior
        pull = design.T @ error + prior @ (np.array([0.0, 0.0, STATURE_M]) - guess)
        if not (np.isfinite(information).all() and np.isfinite(pull).all()):
            return None
        guess = guess + np.linalg.solve(information, pull)
    return guess[:2], np.asarray(np.linalg.inv(information)[:2, :2], dtype=np.float64)
