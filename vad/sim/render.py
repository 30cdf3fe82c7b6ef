"""What the simulated camera sees: the room, the robot and the person of a scenario at an instant."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vad.geometry import FloatArray
from vad.sim.render_person import Build, Clothes, person_parts
from vad.sim.render_robot import robot_parts
from vad.sim.render_room import draw_room
from vad.sim.render_shapes import Image, Part, Patch, View, draw_parts, draw_shadow
from vad.sim.scenario import ROBOT_RADIUS_M, Box, Scenario, WalkerState

_NOISE_LEVELS = 2.2
# Noise is a window into a larger field, placed anew for each frame: drawing it anew costs 12 ms.
_NOISE_MARGIN_PX = 128
_FLICKER = 0.006


class Renderer:
    """Draws frames of one scenario. A frame depends on its time alone, not on the frames before it."""

    def __init__(self, scenario: Scenario, *, seed: int = 0, build: Build | None = None) -> None:
        """seed: of paint, clothes and noise; build: the walker's; the room's geometry is the scenario's."""
        self.view = View.of(scenario.camera)
        self._scenario = scenario
        self._seed = seed
        rng = np.random.default_rng([seed, scenario.seed, 0xCA3])
        room = draw_room(scenario, self.view, rng)
        self._background = room.image
        self._covers = [_trim(cover) for cover in room.covers]
        self._clothes = Clothes.draw(rng)
        self._build = build
        height, width = self._background.shape[:2]
        shape = (height + _NOISE_MARGIN_PX, width + _NOISE_MARGIN_PX, 3)
        noise = rng.normal(0.0, _NOISE_LEVELS, shape).astype(np.float32)
        self._noise: NDArray[np.int8] = np.round(noise).astype(np.int8)

    def frame(self, t_s: float) -> Image:
        """The picture at t_s, (height, width, 3) uint8 BGR, pin-hole, with sensor noise and flicker."""
        image = self._background.copy()
        actors: list[tuple[FloatArray, WalkerState | None]] = []
        x, y, yaw = self._scenario.robot_at(t_s)
        actors.append((np.array([x, y]), None))
        walker = self._scenario.walker_at(t_s)
        if walker is not None and self._inside(walker):
            actors.append((np.array([walker.x_m, walker.y_m]), walker))
        eye = np.array(self._scenario.camera.eye_m[:2])
        for place, who in sorted(actors, key=lambda actor: -float(np.linalg.norm(actor[0] - eye))):
            if who is None:
                parts = robot_parts(x, y, yaw)
                draw_shadow(image, self.view, (x, y), ROBOT_RADIUS_M * 1.25, 0.5)
            else:
                parts = person_parts(who, self._clothes, self._build)
                self._person_shadow(image, parts, place)
            draw_parts(image, self.view, parts)
            self._put_furniture_before(image, place)
        return self._expose(image, t_s)

    def _inside(self, walker: WalkerState) -> bool:
        x0, y0, x1, y1 = self._scenario.room_m
        return x0 < walker.x_m < x1 and y0 < walker.y_m < y1

    def _person_shadow(self, image: Image, parts: list[Part], place: FloatArray) -> None:
        draw_shadow(image, self.view, (float(place[0]), float(place[1])), 0.45, 0.22)
        for part in parts:
            low = part.centres_m[part.centres_m[:, 2] < 0.1]
            if len(low) == len(part.centres_m):  # a foot near the floor
                x, y = low[:, :2].mean(axis=0)
                draw_shadow(image, self.view, (float(x), float(y)), 0.14, 0.4)

    def _put_furniture_before(self, image: Image, place: FloatArray) -> None:
        """Draw again the furniture that stands between the camera and somebody at `place`."""
        eye = np.array(self._scenario.camera.eye_m[:2])
        for box, cover in zip(self._scenario.boxes, self._covers, strict=True):
            if cover is not None and _hides(box, eye, place):
                target = image[cover.rows, cover.columns]
                still = self._background[cover.rows, cover.columns].astype(np.float32)
                target[:] = target + (still - target) * cover.coverage[:, :, None]

    def _expose(self, image: Image, t_s: float) -> Image:
        """The sensor's noise and the exposure's flicker."""
        rng = np.random.default_rng([self._seed, self._scenario.seed, round(t_s * 1e6) & 0xFFFFFFFF])
        dy, dx = rng.integers(0, _NOISE_MARGIN_PX, 2)
        height, width = image.shape[:2]
        gain = 1.0 + _FLICKER * float(rng.standard_normal())
        noise = self._noise[dy : dy + height, dx : dx + width]
        return np.asarray(cv2.addWeighted(image, gain, noise, 1.0, 0.0, dtype=cv2.CV_8U), dtype=np.uint8)


def _trim(cover: NDArray[np.float32]) -> Patch | None:
    """A picture-sized coverage, (H, W), cut to where it is not zero; None where it is zero everywhere."""
    rows, columns = np.flatnonzero(cover.any(axis=1)), np.flatnonzero(cover.any(axis=0))
    if len(rows) == 0:
        return None
    where = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
    return Patch(*where, np.ascontiguousarray(cover[where]))


def _hides(box: Box, eye: FloatArray, place: FloatArray) -> bool:
    """Whether the box may be in front of `place`: no face of it that the camera sees has both on its side."""
    low, high = np.array([box.x0_m, box.y0_m]), np.array([box.x1_m, box.y1_m])
    before_low = (eye < low) & (place < low)
    before_high = (eye > high) & (place > high)
    return not bool(np.any(before_low | before_high))
