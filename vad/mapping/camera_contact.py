"""Where a robot's box touches the floor, once it is known from where the camera looks. Pure.

A box alone tells the angle of view only with the robot's height assumed: 1 to 3 px off. With the camera's
place the floor's disc under the robot is projected, and its middle lies in it where geometry says.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vad.geometry import FloatArray, apply_homography, floor_homography, project, undistort
from vad.mapping.camera_consensus import Sightings
from vad.mapping.camera_fit import Start

# A robot vacuum's; both cancel but for the perspective within the robot itself.
_RADIUS_M = 0.17
_SIDE_M = 0.05
_CORNERS = 24


def recontacted(sightings: Sightings, at: Start) -> Sightings:
    """The sightings with the contact of each box as this camera sees it; those without a box as they were."""
    if sightings.box is None:
        return sightings
    lens, pose = at.intrinsics, at.camera_from_map
    rows = np.flatnonzero(np.isfinite(sightings.box).all(axis=1))
    middle_m = apply_homography(floor_homography(lens, pose), undistort(sightings.image_px[rows], lens))
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS, endpoint=False)
    ring = _RADIUS_M * np.column_stack([np.cos(angle), np.sin(angle)])
    corners_m = (middle_m[:, None, :] + ring).reshape(-1, 2)

    def seen(xy_m: FloatArray, height_m: float) -> FloatArray:
        return project(np.column_stack([xy_m, np.full(len(xy_m), height_m)]), lens, pose)

    middle = seen(middle_m, 0.0)
    bottom = seen(corners_m, 0.0).reshape(len(rows), _CORNERS, 2)
    outline = np.concatenate([bottom, seen(corners_m, _SIDE_M).reshape(len(rows), _CORNERS, 2)], axis=1)
    left, right = outline[:, :, 0].min(axis=1), outline[:, :, 0].max(axis=1)
    x0, _, x1, y1 = sightings.box[rows].T
    scale = (x1 - x0) / (right - left)
    contact = np.column_stack(
        [x0 + scale * (middle[:, 0] - left), y1 - scale * (bottom[:, :, 1].max(axis=1) - middle[:, 1])]
    )
    image_px = sightings.image_px.copy()
    image_px[rows] = np.where(np.isfinite(contact).all(axis=1)[:, None], contact, image_px[rows])
    return replace(sightings, image_px=image_px)
