"""Where a person stands, in the picture: the paper's equations 5 and 6 with image y downwards. Pure.

Equation 6 shifts the ankles to the box's bottom. That is the near edge of the shoes, not the place under the
ankles: in renders it lies 3.3 % of the person's height too low, 0.1 m on the floor at 4 m. So where hips
and shoulders are seen, the shift is taken from the body instead: ankles, hips and shoulders are at known
fractions of the stature, a perspective picture maps heights on a vertical line projectively (their
cross-ratio is kept), and that map continued to height 0 is the floor. Equation 6 itself remains for people
whose trunk is hidden.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vad.vision.people import LEFT_ANKLE, RIGHT_ANKLE, Person

FloatArray = NDArray[np.float64]

# Hidden ankles are still given, with scores up to 0.12 (formats.md 10): at least one must be seen. The
# network's guess of the other then still places the middle better (0.09 m) than the one alone (0.33 m).
ANKLE_SCORE_MIN = 0.2
_ANKLE_GUESS_MIN = 0.05
_TRUNK_SCORE_MIN = 0.2
_HIPS, _SHOULDERS = (11, 12), (5, 6)
# Heights as fractions of the stature (Drillis and Contini); the ankles' is the mean over both feet and a
# step: 0.04 standing, and the heel's rise.
_ANKLE_HEIGHT, _HIP_HEIGHT, _SHOULDER_HEIGHT = 0.061, 0.522, 0.81
# Where feet are cut off by the picture's edge the ankle scores still reach 0.77: the edge decides.
_EDGE_SHARE = 0.0135
# Standard deviations as shares of the box's height, stepping included (measured in renders).
_SIGMA_X, _SIGMA_Y, _SIGMA_Y_BOX = 0.029, 0.025, 0.045
_SIGMA_X_GUESS, _SIGMA_Y_GUESS = 0.047, 0.06
_SIGMA_X_ONE, _SIGMA_Y_ONE = 0.1, 0.07
_SIGMA_PX = 1.0


@dataclass(frozen=True, slots=True)
class GroundPoint:
    """The floor contact of a person, midway between the feet.

    x_px, y_px: in the picture the person was found in; covariance_px2: (2, 2).
    ankles: how many ankles were seen, 1 or 2.
    """

    x_px: float
    y_px: float
    covariance_px2: FloatArray
    ankles: int


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a person gives no ground point."""

    reason: str


def ground_point(person: Person, image_size: tuple[int, int]) -> GroundPoint | Refusal:
    """The ground point of a person in a picture of `image_size`, (width, height) px.

    One hidden ankle makes the covariance larger: its place is the network's guess, or it is left out.
    """
    cut = feet_cut(person, image_size)
    if cut is not None:
        return cut
    ankles = person.keypoints[[LEFT_ANKLE, RIGHT_ANKLE]]
    seen = ankles[ankles[:, 2] >= ANKLE_SCORE_MIN]
    if len(seen) == 0:
        return Refusal("no ankle seen")
    size_px = person.box[3] - person.box[1]
    if size_px <= 0 or person.box[3] <= seen[:, 1].max() - 0.5 * size_px:
        return Refusal("box and ankles disagree")
    used = ankles[ankles[:, 2] >= _ANKLE_GUESS_MIN]
    middle = used[:, :2].mean(axis=0)
    offset = _body_offset(person, middle)
    trunk = offset is not None
    if offset is None:
        offset = np.array([0.0, max(person.box[3] - float(used[:, 1].max()), 0.0)])
    if len(seen) == 2:
        sigma_x, sigma_y = _SIGMA_X, _SIGMA_Y if trunk else _SIGMA_Y_BOX
    elif len(used) == 2:
        sigma_x, sigma_y = _SIGMA_X_GUESS, _SIGMA_Y_GUESS
    else:
        sigma_x, sigma_y = _SIGMA_X_ONE, _SIGMA_Y_ONE
    covariance = np.diag([(sigma_x * size_px) ** 2, (sigma_y * size_px) ** 2]) + np.eye(2) * _SIGMA_PX**2
    x, y = middle + offset
    return GroundPoint(float(x), float(y), covariance, len(seen))


def feet_cut(person: Person, image_size: tuple[int, int]) -> Refusal | None:
    """Why a person's feet are not in a picture of `image_size`, (width, height) px; None if they are."""
    width, height = image_size
    margin = _EDGE_SHARE * height
    if person.box[3] > height - margin:
        return Refusal("feet cut off by the picture's lower edge")
    ankles = person.keypoints[[LEFT_ANKLE, RIGHT_ANKLE]]
    seen_x = ankles[ankles[:, 2] >= ANKLE_SCORE_MIN, 0]
    if len(seen_x) and (seen_x.min() < margin or seen_x.max() > width - margin):
        return Refusal("feet cut off by the picture's side")
    return None


def _body_offset(person: Person, ankle_px: FloatArray) -> FloatArray | None:
    """From the ankles to the floor under them, (2,) px, by the body's proportions; None without a trunk."""
    hips, shoulders = person.keypoints[list(_HIPS)], person.keypoints[list(_SHOULDERS)]
    if min(hips[:, 2].min(), shoulders[:, 2].min()) < _TRUNK_SCORE_MIN:
        return None
    hip_px, shoulder_px = hips[:, :2].mean(axis=0), shoulders[:, :2].mean(axis=0)
    if not shoulder_px[1] < hip_px[1] < ankle_px[1]:
        return None  # bent, lying or wrong: nothing stands upright here
    # y(z) = (a + b z) / (1 + c z) through three heights z; the floor is y(0) = a.
    z = np.array([_ANKLE_HEIGHT, _HIP_HEIGHT, _SHOULDER_HEIGHT])
    y = np.array([ankle_px[1], hip_px[1], shoulder_px[1]])
    a = float(np.linalg.solve(np.column_stack([np.ones(3), z, -z * y]), y)[0])
    shift = a - float(ankle_px[1])
    legs = float(ankle_px[1] - hip_px[1])
    if not 0.0 < shift < 0.35 * legs:
        return None
    # Off the picture's middle a standing person leans in it; the floor lies on along that line.
    lean = (ankle_px[0] - shoulder_px[0]) / (ankle_px[1] - shoulder_px[1])
    return np.array([lean * shift, shift])
