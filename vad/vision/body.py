"""What of a person's body tells where they stand: four points on the body's axis, and their errors. Pure.

The ankles swing with every step and are the first to be hidden; hips, shoulders and the crown hardly swing
but stand higher, where a pixel is more of the floor. With a stature that stays the same during a walk they
complete each other (vad.vision.path).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vad.geometry import Intrinsics, Rigid, project, undistort
from vad.vision.ground import ANKLE_SCORE_MIN
from vad.vision.people import LEFT_ANKLE, RIGHT_ANKLE, Person

FloatArray = NDArray[np.float64]

ANKLES, HIPS, SHOULDERS, CROWN = range(4)
# Heights over the floor as shares of the stature (Drillis and Contini); the ankles' is the mean over both
# feet and a step, the crown's is the upper edge of the network's box.
HEIGHTS = np.array([0.061, 0.522, 0.81, 0.994])
STATURE_M, STATURE_SIGMA_M = 1.70, 0.10

_TRUNK = {HIPS: (11, 12), SHOULDERS: (5, 6)}
_TRUNK_SCORE_MIN = 0.2
_ANKLE_GUESS_MIN = 0.05
# How much worse the ankles' middle is where one of them is the network's guess, or is left out.
_GUESSED, _ALONE = 2.0, 3.5
# A crown nearer to the picture's upper edge is cut off.
_EDGE_PX = 4.0


@dataclass(frozen=True, slots=True)
class Camera:
    """A calibrated camera: raw pixels <-> map."""

    intrinsics: Intrinsics
    camera_from_map: Rigid

    def straight(self, points_px: FloatArray) -> FloatArray:
        """(N, 2) raw pixels without the lens's distortion."""
        return undistort(points_px, self.intrinsics)

    def pixels(self, points_m: FloatArray) -> FloatArray:
        """(N, 3) map points -> (N, 2) undistorted pixels; NaN behind the camera."""
        return project(points_m, replace(self.intrinsics, k1=0.0, k2=0.0), self.camera_from_map)

    def at_height(self, points_px: FloatArray, height_m: float) -> FloatArray:
        """(N, 2) undistorted pixels -> (N, 2) map places at a height; NaN where a ray does not get there."""
        lens, back = self.intrinsics, self.camera_from_map.inverse()
        rays = (points_px - (lens.cx_px, lens.cy_px)) / (lens.fx_px, lens.fy_px)
        rays = np.column_stack([rays, np.ones(len(rays))]) @ back.rotation.T
        drop = height_m - back.translation[2]
        with np.errstate(divide="ignore"):
            reach = drop / rays[:, 2:]
        return np.where(reach > 0.0, back.translation[:2] + reach * rays[:, :2], np.nan)

    @property
    def eye_m(self) -> FloatArray:
        """Where it is in the map, (3,)."""
        return self.camera_from_map.inverse().translation


@dataclass(frozen=True, slots=True)
class Body:
    """points_px: (4, 2), raw pixels, of ankles' middle, hips' middle, shoulders' middle, crown (its x means
    nothing); spread: (4,), how much larger than usual each one's error is; inf where it was not seen."""

    points_px: FloatArray
    spread: FloatArray


def body_of(person: Person) -> Body | None:
    """The body's points of a person in a picture; None where no upright trunk is seen."""
    points, spread = np.zeros((4, 2)), np.full(4, np.inf)
    for group, pair in _TRUNK.items():
        both = person.keypoints[list(pair)]
        if both[:, 2].min() < _TRUNK_SCORE_MIN:
            return None
        points[group], spread[group] = both[:, :2].mean(axis=0), 1.0
    if points[SHOULDERS, 1] >= points[HIPS, 1]:
        return None
    ankles = person.keypoints[[LEFT_ANKLE, RIGHT_ANKLE]]
    used = ankles[ankles[:, 2] >= _ANKLE_GUESS_MIN]
    seen = int(np.count_nonzero(ankles[:, 2] >= ANKLE_SCORE_MIN))
    if seen and used[:, 1].mean() > points[HIPS, 1]:
        points[ANKLES] = used[:, :2].mean(axis=0)
        spread[ANKLES] = 1.0 if seen == 2 else _GUESSED if len(used) == 2 else _ALONE
    points[CROWN] = points[SHOULDERS, 0], person.box[1]
    if person.box[1] > _EDGE_PX:
        spread[CROWN] = 1.0
    return Body(points, spread)
