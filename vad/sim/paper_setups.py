"""The two set-ups in which the paper reports its accuracy, as scenarios (method.md 1).

Office: furniture and walls, T [3.0, 0], R [3.0, 2.4]. Open space: T [2.4, 0], R [2.4, 2.4], weak
reflections only. Walks along an L, a rectangle, a circle and at random, by two people. The paper says how
far T and R are apart and what the walks look like, not where on the floor they were. Here they keep to one
side of the link; in the open space they reach past R, in the office R stands near a corner of the floor
that is walked, so that the open space's geometry is the better one, as the paper's errors say.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from vad.sim.radio import Radio
from vad.sim.radio_channel import Surroundings
from vad.sim.scenario import Box, CameraPlacement, Scenario, Walk

FloatArray = NDArray[np.float64]
Setup = Literal["office", "open"]
Shape = Literal["L", "rectangle", "circle", "random"]

SETUPS: tuple[Setup, ...] = get_args(Setup)
SHAPES: tuple[Shape, ...] = get_args(Shape)

DURATION_S = (10.0, 20.0)
PAUSE_S = 3.0
_STEP_S = 0.05
_TURN_M = 0.7
"""Corners are rounded over this much of the way."""


@dataclass(frozen=True, slots=True)
class Walker:
    """One of the two people: body height (with it the stride and the height of the torso) and pace."""

    height_m: float
    pace_mps: float


WALKERS = (Walker(1.62, 0.75), Walker(1.86, 1.05))


@dataclass(frozen=True, slots=True)
class _Place:
    """transmitter_m, receiver_m: x, y; floor_m: x0, y0, x1, y1 of the floor that is walked."""

    room_m: tuple[float, float, float, float]
    transmitter_m: tuple[float, float]
    receiver_m: tuple[float, float]
    floor_m: tuple[float, float, float, float]
    surroundings: Surroundings
    boxes: tuple[Box, ...]


_GREY = (120, 120, 120)
_PLACES: dict[Setup, _Place] = {
    "office": _Place(
        (-1.0, -1.0, 6.0, 5.0),
        (3.0, 0.0),
        (3.0, 2.4),
        (-0.2, 0.2, 2.6, 2.8),
        Surroundings(reflection=(0.25, 0.5), things=(8, 15)),
        (
            Box(3.2, 2.0, 4.8, 2.8, 0.75, _GREY),
            Box(4.2, 3.9, 5.9, 4.9, 1.2, _GREY),
            Box(-0.9, 3.4, 0.4, 4.9, 0.75, _GREY),
        ),
    ),
    "open": _Place(
        (-2.0, -2.5, 7.0, 6.5),
        (2.4, 0.0),
        (2.4, 2.4),
        (0.2, 0.4, 2.0, 4.0),
        Surroundings(reflection=(0.03, 0.12), things=(1, 3), thing_rcs_m2=(0.05, 0.3)),
        (),
    ),
}


@dataclass(frozen=True, slots=True)
class PaperWalk:
    """Walk `number` of the set-up's scenario: its shape and who walks (index into WALKERS)."""

    number: int
    shape: Shape
    walker: int


def paper_setup(setup: Setup, seed: int) -> tuple[Scenario, tuple[PaperWalk, ...]]:
    """The scenario, in which both walkers walk each shape once, and what its walks are.

    The seed draws directions, durations, starting points, the random paths and the device's height.
    """
    rng = np.random.default_rng([seed, 0x9A9E, SETUPS.index(setup)])
    place = _PLACES[setup]
    device = (*place.receiver_m, float(rng.uniform(0.7, 1.1)))
    start_s = PAUSE_S
    walks: list[Walk] = []
    kinds: list[PaperWalk] = []
    for who, walker in enumerate(WALKERS):
        for shape in SHAPES:
            duration_s = float(rng.uniform(*DURATION_S))
            way = _way(shape, place, duration_s * walker.pace_mps, rng)
            walk = Walk(start_s, _walked(way, walker.pace_mps, duration_s, rng), walker.height_m)
            kinds.append(PaperWalk(len(walks), shape, who))
            walks.append(walk)
            start_s = walk.end_s + PAUSE_S
    x0, y0, x1, y1 = place.floor_m
    eye = (*place.transmitter_m, 1.5)
    scenario = Scenario(
        seed,
        place.room_m,
        place.room_m,
        place.boxes,
        CameraPlacement(eye, ((x0 + x1) / 2, (y0 + y1) / 2, 0.5), 640, 480, 400.0),
        (*place.transmitter_m, 1.4),
        device,
        "f4:f5:d8:00:53:00",
        np.array([[x0, y0], [x1, y0]]),
        0.35,
        0.0,
        0.0,
        tuple(walks),
    )
    return scenario, tuple(kinds)


def paper_radio(setup: Setup, scenario: Scenario) -> Radio:
    """The set-up's radio: the card with its three antennas is R, the device that is looked for."""
    return Radio(scenario, seed=scenario.seed, array_end="device", surroundings=_PLACES[setup].surroundings)


def _way(shape: Shape, place: _Place, length_m: float, rng: np.random.Generator) -> FloatArray:
    """Corners (K, 2) of a way of at least length_m within the walked floor, around anything in it."""
    x0, y0, x1, y1 = place.floor_m
    middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
    half = np.array([(x1 - x0) / 2, (y1 - y0) / 2])
    if shape == "random":
        return _wander(place, length_m, rng)
    if shape == "circle":
        angle = np.linspace(0, 2 * np.pi, 48, endpoint=False)
        loop = middle + 0.9 * half.min() * np.column_stack([np.cos(angle), np.sin(angle)])
    elif shape == "rectangle":
        loop = middle + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    else:  # there and back along two sides
        loop = middle + half * np.array([[-1, 1], [-1, -1], [1, -1], [-1, -1]])
    if rng.random() < 0.5:
        loop = loop[::-1]
    around_m = np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1).sum()
    laps = int(np.ceil(length_m / around_m)) + 1
    if shape != "L":
        loop = np.roll(loop, int(rng.integers(len(loop))), axis=0)
    return np.tile(loop, (laps, 1))


def _wander(place: _Place, length_m: float, rng: np.random.Generator) -> FloatArray:
    """Random corners: legs of 0.8 m at least, none through the receiver."""
    x0, y0, x1, y1 = place.floor_m
    receiver = np.array(place.receiver_m)
    corners: list[FloatArray] = []
    walked_m = 0.0
    while walked_m < length_m + 1.0:
        corner = rng.uniform((x0, y0), (x1, y1))
        last = corners[-1] if corners else None
        leg = corner[None] if last is None else last + (corner - last) * np.linspace(0, 1, 30)[:, None]
        if np.linalg.norm(leg - receiver, axis=1).min() < 0.4:
            continue
        if last is not None:
            leg_m = float(np.linalg.norm(corner - last))
            if leg_m < 0.8:
                continue
            walked_m += leg_m
        corners.append(corner)
    return np.array(corners)


def _walked(way_m: FloatArray, pace_mps: float, duration_s: float, rng: np.random.Generator) -> FloatArray:
    """Places (N, 2) every 0.05 s along the way: rounded corners, the pace swells and ebbs by an eighth."""
    legs_m = np.linalg.norm(np.diff(way_m, axis=0), axis=1)
    at_corner_m = np.concatenate([[0.0], np.cumsum(legs_m)])
    along = np.arange(0, at_corner_m[-1], 0.02)
    path = np.stack([np.interp(along, at_corner_m, way_m[:, k]) for k in (0, 1)], axis=1)
    path = _averaged(path, round(_TURN_M / 0.02))
    t_s = np.arange(0, duration_s, _STEP_S)
    ramp = np.minimum(1.0, 0.2 + np.minimum(t_s, duration_s - t_s))
    swell = 1 + 0.12 * np.sin(2 * np.pi * rng.uniform(0.08, 0.2) * t_s + rng.uniform(0, 2 * np.pi))
    way_s = np.cumsum(pace_mps * ramp * swell) * _STEP_S
    xy = np.stack([np.interp(way_s, along, path[:, k]) for k in (0, 1)], axis=1)
    return _averaged(xy, round(0.8 / _STEP_S))


def _averaged(xy: FloatArray, width: int) -> FloatArray:
    """Each column of (N, 2) under a Hann window of about `width` rows, the ends held."""
    kernel = np.hanning((width | 1) + 2)[1:-1]
    kernel /= kernel.sum()
    half = len(kernel) // 2
    padded = np.pad(xy, ((half, half), (0, 0)), mode="edge")
    return np.stack([np.convolve(padded[:, k], kernel, mode="valid") for k in (0, 1)], axis=1)
