"""What a still camera looks at, kept to notice that it was moved. Pure.

Corners of the still background (ORB) are compared with those of the moment of calibration. Light changes
what they look like and how many there are, not where they are: only corners that are found again elsewhere
say that the camera was moved.
"""

from __future__ import annotations

import base64
import binascii
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from vad.geometry import FloatArray

Verdict = Literal["same", "moved", "other", "unknown"]
"""same: still there. moved: the background is elsewhere in the picture. other: none of the corners is known,
as in another view, or in the dark, where noise has corners. unknown: too few to tell."""

WORK_WIDTH_PX = 480
MOVED_PER_WIDTH = 0.005
"""A background that went this far, of the picture's width, is a camera that was moved: about 3 px of 640."""

# In the dark a sensor's own pattern has corners, too.
_DARK_LEVELS = 2.0
_FEATURES = 400
_FAST_THRESHOLD = 8
_BLUR_PX = 1.0
_CONTRAST_PX = 16.0
_COARSE_PX = 8
# A matched corner's descriptor differs in at most so many of 256 bits.
_MAX_BITS = 60
_FIT_PX = 3.0
_MIN_MATCHED, _MIN_MATCHED_SHARE = 14, 0.3
_NONE_MATCHED = 8
_DESCRIPTOR_BYTES = 32


@dataclass(frozen=True, slots=True)
class ViewChange:
    """A picture against a view. shift: median way of the background, as a share of the picture's width."""

    verdict: Verdict
    shift: float
    matched: int


@dataclass(frozen=True, slots=True)
class CameraView:
    """Corners of a picture. points: (N, 2) as shares of the picture's width; descriptors: (N, 32)."""

    points: FloatArray
    descriptors: NDArray[np.uint8]

    @classmethod
    def of(cls, image: NDArray[np.uint8]) -> CameraView:
        """The view of a picture, (H, W, 3) BGR or (H, W)."""
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
        scale = min(1.0, WORK_WIDTH_PX / grey.shape[1])
        small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        if float(np.std(cv2.GaussianBlur(small, (0, 0), _CONTRAST_PX / 4))) < _DARK_LEVELS:
            return cls(np.empty((0, 2)), np.empty((0, _DESCRIPTOR_BYTES), dtype=np.uint8))
        even = _evenly_lit(np.asarray(small, dtype=np.float32))
        finder = cv2.ORB.create(nfeatures=_FEATURES, fastThreshold=_FAST_THRESHOLD)
        corners, found = finder.detectAndCompute(even, None)
        points = np.array([corner.pt for corner in corners], dtype=np.float64).reshape(-1, 2)
        if found is None:
            found = np.empty((0, _DESCRIPTOR_BYTES), dtype=np.uint8)
        return cls(points / small.shape[1], np.asarray(found, dtype=np.uint8))

    def change_to(self, now: CameraView) -> ViewChange:
        """What became of this view in the picture `now`."""
        if min(len(self.points), len(now.points)) < _MIN_MATCHED:
            return ViewChange("unknown", 0.0, 0)
        matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
        pairs = [m for m in matcher.match(self.descriptors, now.descriptors) if m.distance <= _MAX_BITS]
        matched = 0
        shift = 0.0
        if len(pairs) >= _NONE_MATCHED:
            before = self.points[[m.queryIdx for m in pairs]]
            after = now.points[[m.trainIdx for m in pairs]]
            _, inside = cv2.findHomography(before, after, cv2.RANSAC, _FIT_PX / WORK_WIDTH_PX)
            if inside is not None:
                fits = inside.ravel() > 0
                matched = int(np.count_nonzero(fits))
                shift = float(np.median(np.linalg.norm((after - before)[fits], axis=1))) if matched else 0.0
        if matched >= _MIN_MATCHED and matched >= _MIN_MATCHED_SHARE * len(pairs):
            return ViewChange("moved" if shift > MOVED_PER_WIDTH else "same", shift, matched)
        return ViewChange("other" if matched < _NONE_MATCHED else "unknown", shift, matched)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON; `from_dict` reads them back."""
        return {
            "points": np.round(self.points, 5).tolist(),
            "descriptors": base64.b64encode(self.descriptors.tobytes()).decode("ascii"),
        }

    @staticmethod
    def from_dict(plain: dict[str, Any]) -> CameraView:
        """The inverse of `to_dict`.

        Raises:
            ValueError: no view.
        """
        try:
            points = np.asarray(plain["points"], dtype=np.float64).reshape(-1, 2)
            raw = base64.b64decode(plain["descriptors"], validate=True)
        except (KeyError, TypeError, binascii.Error) as error:
            raise ValueError(f"not a camera's view: {error}") from error
        if len(raw) != _DESCRIPTOR_BYTES * len(points) or not np.all(np.isfinite(points)):
            raise ValueError("not a camera's view: points and descriptors do not go together")
        return CameraView(points, np.frombuffer(raw, dtype=np.uint8).reshape(-1, _DESCRIPTOR_BYTES))


def _evenly_lit(grey: NDArray[np.float32]) -> NDArray[np.uint8]:
    """The picture without slow changes of brightness and contrast: a lamp or the sun leaves it as it was."""
    soft = cv2.GaussianBlur(grey, (0, 0), _BLUR_PX)
    apart = soft - _around(soft)
    even = 128.0 + 48.0 * apart / (np.sqrt(_around(apart**2)) + 3.0)
    return np.asarray(np.clip(even, 0.0, 255.0), dtype=np.uint8)


def _around(values: NDArray[Any]) -> NDArray[Any]:
    """The mean around each pixel. Worked out on a coarse grid, where it costs a twentieth."""
    height, width = values.shape
    coarse = cv2.resize(values, None, fx=1 / _COARSE_PX, fy=1 / _COARSE_PX, interpolation=cv2.INTER_AREA)
    mean = cv2.GaussianBlur(coarse, (0, 0), _CONTRAST_PX / _COARSE_PX)
    return cv2.resize(mean, (width, height), interpolation=cv2.INTER_LINEAR)
