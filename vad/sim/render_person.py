"""A walking person as solid parts: planted feet, swinging limbs, clothes.

Body proportions after Drillis and Contini (fractions of the stature); the gait's phase is the scenario's:
2 pi in two steps, the left foot touching down at 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vad.geometry import FloatArray
from vad.sim.render_shapes import Part
from vad.sim.scenario import WalkerState

Colour = tuple[float, float, float]

# A foot is on the floor for this share of the cycle.
_STANCE = 0.6
_HEEL_OFF, _TOE_OFF_RAD, _STRIKE_RAD = 0.42, 0.55, -0.22
_LIFT_M = 0.05
# Fractions of the stature.
_STRIDE, _ANKLE, _KNEE, _HIP, _SHOULDER, _NECK, _HEAD = 0.8, 0.042, 0.285, 0.522, 0.81, 0.848, 0.918
_ELBOW_LENGTH, _HAND_LENGTH = 0.175, 0.15


@dataclass(frozen=True, slots=True)
class Clothes:
    """Colours of one person, RGB 0..255."""

    shirt: Colour
    trousers: Colour
    shoes: Colour
    skin: Colour
    hair: Colour

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Clothes:
        """Somebody's clothes."""

        def colour(low: float, high: float) -> Colour:
            r, g, b = rng.uniform(low, high, 3)
            return float(r), float(g), float(b)

        tone = float(rng.uniform(0.55, 1.0))
        dark = float(rng.uniform(25, 75))
        return cls(
            shirt=colour(60, 215),
            trousers=colour(35, 90),
            shoes=colour(25, 70),
            skin=(228 * tone, 182 * tone, 152 * tone),
            hair=(dark * 1.2, dark * 0.9, dark * 0.7),
        )


@dataclass(frozen=True, slots=True)
class Build:
    """How one person differs from the mean: heights as fractions of the stature; how far they lean ahead."""

    hip: float = _HIP
    shoulder: float = _SHOULDER
    lean_rad: float = 0.0

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Build:
        """Somebody's build."""
        return cls(
            hip=float(_HIP + 0.012 * rng.standard_normal()),
            shoulder=float(_SHOULDER + 0.010 * rng.standard_normal()),
            lean_rad=float(rng.normal(0.03, 0.03)),
        )

    def up(self, fraction: float) -> float:
        """The height of a point of the trunk or head, which is at `fraction` in the mean."""
        return float(np.interp(fraction, [0.0, _HIP, _SHOULDER, 1.0], [0.0, self.hip, self.shoulder, 1.0]))


@dataclass(frozen=True, slots=True)
class Foot:
    """An ankle in the body's frame (ahead, left, up; metres) and the foot's pitch, toes down positive."""

    ankle_m: FloatArray
    pitch_rad: float


def foot_at(cycle: float, side: float, height_m: float) -> Foot:
    """Where a foot is at `cycle` (0..1, touch-down at 0). side: 1 left, -1 right.

    On the floor it stands still: it goes backwards in the body's frame as fast as the body goes on.
    """
    stride_m = _STRIDE * height_m
    if cycle < _STANCE:
        ahead = _STANCE / 2 - cycle
        lift = 0.0
        touch = np.clip(1.0 - cycle / 0.08, 0.0, 1.0) * _STRIKE_RAD
        push = np.clip((cycle - _HEEL_OFF) / (_STANCE - _HEEL_OFF), 0.0, 1.0) ** 2 * _TOE_OFF_RAD
        pitch = touch + push
    else:
        q = (cycle - _STANCE) / (1.0 - _STANCE)
        ahead = -_STANCE / 2 + _STANCE * q * q * (3 - 2 * q)
        lift = _LIFT_M * np.sin(np.pi * q)
        pitch = _TOE_OFF_RAD + (_STRIKE_RAD - _TOE_OFF_RAD) * q
    # The heel rises about the ball of the foot; at touch-down the heel itself carries.
    heel_up = 0.075 * height_m * np.sin(pitch) if pitch > 0 else 0.0
    ankle = np.array([ahead * stride_m, side * 0.045 * height_m, _ANKLE * height_m + heel_up + lift])
    return Foot(ankle, float(pitch))


def person_parts(walker: WalkerState, clothes: Clothes, build: Build | None = None) -> list[Part]:
    """The parts of a person, in the map; of the mean build if none is given."""
    build = build or Build()
    h = walker.height_m
    cycle = walker.phase_rad / (2 * np.pi)
    c, s = np.cos(walker.heading_rad), np.sin(walker.heading_rad)
    map_from_body = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    origin = np.array([walker.x_m, walker.y_m, 0.0])
    swing = np.cos(2 * np.pi * cycle)
    sway = np.array([0.0, 0.012 * np.sin(2 * np.pi * cycle), 0.012 * np.cos(4 * np.pi * cycle + np.pi)])

    def part(points: list[FloatArray], radii: list[float], rgb: Colour, order_m: float = 0.0) -> Part:
        centres = np.array(points) @ map_from_body.T + origin
        return Part(centres, np.array(radii) * h / 1.75, rgb, order_m)

    def at(ahead: float, left: float, up: float) -> FloatArray:
        """A point of the trunk from fractions of the stature."""
        height = build.up(up)
        ahead += (height - build.hip) * np.tan(build.lean_rad)
        return np.asarray(np.array([ahead, left, height]) * h + sway, dtype=np.float64)

    parts: list[Part] = []
    for side in (1.0, -1.0):
        foot = foot_at((cycle + (0.0 if side > 0 else 0.5)) % 1.0, side, h)
        hip = at(0.012 * side * swing, 0.05 * side, _HIP)
        knee = _knee(hip, foot.ankle_m, (build.hip - build.up(_KNEE)) * h, (build.up(_KNEE) - _ANKLE) * h)
        parts += [
            part([*_shoe(foot, h)], [0.042, 0.036, 0.03], clothes.shoes),
            part([knee, foot.ankle_m], [0.06, 0.043], clothes.trousers),
            part([hip, knee], [0.088, 0.064], clothes.trousers),
        ]
        shoulder = at(-0.012 * side * swing, 0.112 * side, _SHOULDER)
        angle = -0.42 * side * swing
        elbow = shoulder + _ELBOW_LENGTH * h * np.array([np.sin(angle), 0.12 * side, -np.cos(angle)])
        bend = angle + 0.35 + 0.2 * max(angle, 0.0)
        wrist = elbow + _HAND_LENGTH * h * np.array([np.sin(bend), 0.02 * side, -np.cos(bend)])
        grip = wrist + 0.05 * h * np.array([np.sin(bend), 0.0, -np.cos(bend)])
        parts += [
            part([shoulder, elbow], [0.058, 0.046], clothes.shirt),
            part([elbow, wrist], [0.04, 0.03], clothes.skin),
            part([wrist, grip], [0.034, 0.034], clothes.skin),
        ]
    parts.append(
        part(
            [at(0, 0.05, _HIP), at(0, -0.05, _HIP), at(0, 0, _HIP + 0.04)], [0.1, 0.1, 0.11], clothes.trousers
        )
    )
    chest = [at(0, 0.085, 0.8), at(0, -0.085, 0.8), at(0.005, 0.045, 0.72), at(0.005, -0.045, 0.72)]
    waist = [at(0, 0.045, 0.57), at(0, -0.045, 0.57), at(0, 0, 0.835)]
    parts.append(part(chest + waist, [0.062, 0.062, 0.115, 0.115, 0.105, 0.105, 0.05], clothes.shirt))
    nape, crown = at(-0.008, 0, _HEAD + 0.012), at(0.002, 0, _HEAD + 0.026)
    brow, chin = at(0.006, 0, _HEAD), at(0.018, 0, _HEAD - 0.042)
    parts += [
        part([at(-0.004, 0, _NECK - 0.03), at(0, 0, _NECK + 0.03)], [0.058, 0.052], clothes.skin),
        part([brow, chin], [0.082, 0.056], clothes.skin),
        part([nape, crown], [0.088, 0.076], clothes.hair),
        part([at(0.059, 0, _HEAD - 0.01), at(0.066, 0, _HEAD - 0.02)], [0.008, 0.01], clothes.skin),
        part(
            [at(0.045, 0.013, _HEAD - 0.047), at(0.045, -0.013, _HEAD - 0.047)], [0.007, 0.007], (150, 70, 66)
        ),
    ]
    for side in (1.0, -1.0):
        parts.append(part([at(0.047, 0.018 * side, _HEAD)], [0.011], (40, 32, 30)))
        parts.append(part([at(-0.004, 0.048 * side, _HEAD - 0.012)], [0.014], clothes.skin))
    return parts


def _knee(hip: FloatArray, ankle: FloatArray, thigh_m: float, shin_m: float) -> FloatArray:
    """The knee between hip and ankle, bent forwards; a leg that is too short is stretched."""
    line = ankle - hip
    reach = float(np.linalg.norm(line))
    along = line / reach
    stretch = max(1.0, reach / (0.998 * (thigh_m + shin_m)))
    thigh_m, shin_m = thigh_m * stretch, shin_m * stretch
    down = (thigh_m**2 - shin_m**2 + reach**2) / (2 * reach)
    out = np.sqrt(max(thigh_m**2 - down**2, 0.0))
    forward = np.array([1.0, 0.0, 0.0]) - along[0] * along
    return np.asarray(hip + down * along + out * forward / np.linalg.norm(forward))


def _shoe(foot: Foot, height_m: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Heel, ball and toe of a foot in the body's frame."""
    c, s = np.cos(foot.pitch_rad), np.sin(foot.pitch_rad)

    def at(ahead: float, up: float) -> FloatArray:
        offset = np.array([ahead * c + up * s, 0.0, up * c - ahead * s]) * height_m
        return np.asarray(foot.ankle_m + offset)

    return at(-0.018, -0.018), at(0.06, -0.0215), at(0.095, -0.025)
