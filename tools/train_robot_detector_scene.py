"""The tables that the ray tracer wants, filled piece by piece."""

from __future__ import annotations

import cv2
import numpy as np
import train_robot_detector_textures as tex
from train_robot_detector_render import BALL, BOX, ROUND

CLEAR_M = 0.12
"""Between a robot and what stands around it, at least."""
_TEXTURES_MOST = 14


class Scene:
    """Tables for the ray tracer, filled piece by piece."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.prims: list[list[float]] = []
        self.mats: list[list[float]] = []
        self.overlays: list[list[float]] = []
        self.windows: list[list[float]] = []
        self.textures: list[np.ndarray] = []
        self.robots: list[tuple[float, float, float, float, float, bool]] = []
        self.clear: list[tuple[float, float, float]] = []
        self._cloths: list[int] = []

    def texture(self, image: np.ndarray) -> int:
        if len(self.textures) >= _TEXTURES_MOST:
            return int(self.rng.integers(len(self.textures)))
        levels = [image, cv2.GaussianBlur(image, (0, 0), 2.0), cv2.GaussianBlur(image, (0, 0), 6.0)]
        self.textures.append(np.stack(levels))
        return len(self.textures) - 1

    def material(
        self,
        rgb: np.ndarray,
        texture: int = -1,
        side: float = 1.0,
        *,
        mirror: float = 0.0,
        rough: float = 0.1,
        gloss: float = 0.0,
        shine: float = 30.0,
        cap: bool = False,
    ) -> int:
        self.mats.append([*map(float, rgb), texture, side, shine, gloss, mirror, rough, float(cap), 0.0, 0.0])
        return len(self.mats) - 1

    def plain(self, low: float = 0.02, high: float = 0.9) -> int:
        rng = self.rng
        shiny = rng.random() < 0.35
        return self.material(
            tex.colour(rng, low, high), mirror=rng.uniform(0.1, 0.6) * shiny, rough=rng.uniform(0.0, 0.3),
            gloss=rng.uniform(0, 0.6) * (rng.random() < 0.4), shine=rng.uniform(5, 200),
        )  # fmt: skip

    def covered(self) -> int:
        """Wood, cloth or plain."""
        rng = self.rng
        pick = rng.random()
        if pick < 0.4:
            return self.plain()
        if pick < 0.7 and len(self._cloths) < 4:
            index = self.texture(tex.cloth(rng))
            self._cloths.append(self.material(np.ones(3), index, rng.uniform(0.3, 1.5)))
        elif pick < 0.9:
            index = self.texture(tex.planks(rng))
            return self.material(
                np.ones(3), index, rng.uniform(0.8, 2.5), mirror=0.3 * rng.random(), rough=0.2
            )
        return self._cloths[rng.integers(len(self._cloths))] if self._cloths else self.plain()

    def box(
        self, x: float, y: float, z: float, yaw: float, a: float, b: float, h: float, m: int, t: int = -1
    ) -> None:
        self.prims.append([BOX, x, y, z, np.cos(yaw), np.sin(yaw), a, b, h, m, m if t < 0 else t, 0.0])

    def round(
        self, x: float, y: float, z: float, r0: float, r1: float, h: float, m: int, t: int = -1
    ) -> None:
        self.prims.append([ROUND, x, y, z, 1.0, 0.0, r0, r1, h, m, m if t < 0 else t, 0.0])

    def ball(self, x: float, y: float, z: float, yaw: float, a: float, b: float, c: float, m: int) -> None:
        self.prims.append([BALL, x, y, z, np.cos(yaw), np.sin(yaw), a, b, c, m, m, 0.0])

    def free(self, x: float, y: float, radius: float) -> bool:
        return all(np.hypot(x - a, y - b) > radius + r for a, b, r in self.clear)

    def bounds(self) -> np.ndarray:
        """(N, 4) centre and squared radius of a sphere around each primitive."""
        out = np.zeros((len(self.prims), 4))
        for row, p in zip(out, self.prims, strict=True):
            row[:3] = p[1:4]
            if p[0] == BALL:
                radius = max(p[6:9])
            else:
                row[2] += 0.5 * p[8]
                flat = np.hypot(p[6], p[7]) if p[0] == BOX else max(p[6], p[7])
                radius = np.hypot(flat, 0.5 * p[8])
            row[3] = radius**2 * 1.001
        return out
