"""What the camera of a simulated home would know of itself after a perfect drive."""

from __future__ import annotations

import numpy as np

from vad.geometry import floor_homography
from vad.mapping.camera_calibration import PARAMETERS, CameraCalibration
from vad.sim.render_shapes import View
from vad.sim.scenario import Scenario


def true_calibration(scenario: Scenario) -> CameraCalibration:
    """What a perfect drive would tell of the scenario's camera, with centimetres of doubt."""
    view = View.of(scenario.camera)
    doubt = np.array([2e-3, 2e-3, 2e-3, 0.02, 0.02, 0.02, 5e-3, 1e-3, 1e-3, 1.0, 1.0])
    assert len(doubt) == PARAMETERS
    return CameraCalibration(
        "valid",
        100,
        "",
        pairs=60,
        camera_from_map=view.camera_from_map,
        intrinsics=view.intrinsics,
        map_from_image=floor_homography(view.intrinsics, view.camera_from_map),
        deviation_m=0.02,
        time_offset_s=0.0,
        time_offset_sigma_s=0.01,
        parameter_covariance=np.diag(doubt**2),
    )
