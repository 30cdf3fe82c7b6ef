"""A person's path on the floor from all that was seen of their body: a smoother over a whole walk. Pure.

One estimate of everything at once. The person moves with nearly constant velocity. Stature, proportions and
how far they lean ahead are the same in every picture, and are found from the walk itself: the crown tells
the stature, for its height in the picture hardly depends on where somebody stands below a camera that hangs
little higher. Ankles, hips, shoulders and crown each say where the body's axis is, each with an error that
lasts some tenths of a second (the network's), the ankles with the swing of the steps besides, a damped
oscillation. That makes a Kalman filter and a Rauch-Tung-Striebel smoother, linearised anew round its own
result a few times (Gauss-Newton), a point far off counting less (Huber).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

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
)
from vad.vision.tracks import Track

FloatArray = NDArray[np.float64]
TimeArray = NDArray[np.int64]

SMOOTH_HZ = 20.0
# In a gap between pictures the path is computed every so often: there its covariance grows.
_FILL_S = 0.11
_ROUNDS = 5
_SETTLED_M = 2e-3

# The person's own motion: spectral density of the acceleration, and the speed in the beginning.
_ACCELERATION_M2_S3 = 0.2
_SPEED_MPS, _PLACE_M = 0.8, 2.0
# Below this speed nobody has a direction of walking.
_HEADING_MPS = 0.3

# Errors across and along the body as shares of its height in the picture; from renders through the network.
# New in each picture, by point (a crown's x is no measurement):
_WHITE = np.array([[0.010, 0.008], [0.005, 0.005], [0.005, 0.005], [np.inf, 0.003]])
# The steps' swing of the ankles (1.2-2.2 Hz, wherefore a broad resonance):
_STEP_HZ, _STEP_DAMPING = 1.5, 0.3
_SWING = (0.028, 0.017)
# Lasting some tenths of a second: ankles' y, hips' x and y, shoulders' x and y, crown's y, and the y of all
# three (the body's bob):
_LASTING_S = 0.4
_LASTING = np.array([0.012, 0.010, 0.009, 0.010, 0.009, 0.006, 0.005])
# The same in every picture: the points' heights in shares of the stature, how much lower ankles look from
# ahead than from behind, the lean.
_PROPORTION = np.array([0.006, 0.010, 0.010, 0.008])
_FEET_AHEAD = 0.010
_LEAN, _LEAN_SIGMA = 0.03, 0.03
# A guessed ankle's error beyond the usual, for a spread of 1.
_GUESS = 0.025
_HUBER, _HUBER_UNIT = 2.0, 0.04

# The variance of the usual errors together, by row; a crown's x aside.
_USUAL = np.array(
    [
        _SWING[0] ** 2,
        _SWING[1] ** 2 + _LASTING[0] ** 2,
        _LASTING[1] ** 2,
        _LASTING[2] ** 2 + _LASTING[6] ** 2,
        _LASTING[3] ** 2,
        _LASTING[4] ** 2 + _LASTING[6] ** 2,
        0.0,
        _LASTING[5] ** 2 + _LASTING[6] ** 2,
    ]
)

# The state: place, velocity, swing and its rate (x; y), lasting errors; stature, proportions, feet, lean.
_AT, _SPEED, _SWINGS, _LASTS, _STATURE, _SHARES, _FEET, _LEANS = 0, 2, 4, 8, 15, 16, 20, 21
_SIZE = 22
_MOTION_AND_FIXED = np.r_[0:4, 15:22]
_ROWS = 8  # per picture: across and along the body, of each point


@dataclass(frozen=True, slots=True)
class SmoothTrack:
    """A person's path in the map at 20 Hz.

    t_ns: (N,); xy_m: (N, 2), the body's axis at the floor, midway between the feet with the stepping removed;
    velocity_mps: (N, 2); covariance_m2: (N, 2, 2) of xy_m, all of it; slow_covariance_m2: (N, 2, 2), the part
    of it that hardly changes during a walk and so does not average out; stature_m, stature_sigma_m: the
    person's height as the walk shows it.
    """

    t_ns: TimeArray
    xy_m: FloatArray
    velocity_mps: FloatArray
    covariance_m2: FloatArray
    slow_covariance_m2: FloatArray
    stature_m: float
    stature_sigma_m: float

    def widened(self, covariance_m2: FloatArray) -> SmoothTrack:
        """The same path where the camera itself is uncertain: (N, 2, 2) more, all of it slow."""
        return replace(
            self,
            covariance_m2=self.covariance_m2 + covariance_m2,
            slow_covariance_m2=self.slow_covariance_m2 + covariance_m2,
        )


def smooth(track: Track, camera: Camera) -> SmoothTrack:
    """A track's smooth path with an honest covariance, the camera taken as known exactly.

    Raises:
        ValueError: a track with fewer than two bodies.
    """
    seen = [k for k, body in enumerate(track.bodies) if body is not None]
    if len(seen) < 2:
        raise ValueError("a track of fewer than two bodies has no path")
    bodies = [body for body in track.bodies if body is not None]
    seen_ns = track.t_ns[seen]
    seen_s = (seen_ns - seen_ns[0]) * 1e-9
    fill = [
        np.arange(1, n) / n * (b - a) + a
        for a, b in pairwise(seen_s.tolist())
        if (n := int(np.ceil((b - a) / _FILL_S))) > 1
    ]
    times = np.sort(np.concatenate([seen_s, *fill]))
    walk = _Walk(times, np.searchsorted(times, seen_s), bodies, camera, track.xy_m[seen])
    states, covariances = walk.solve()
    return _sampled(seen_ns[0], times, states, covariances)


class _Walk:
    """The measurements of one walk and the estimate of its states (N, _SIZE) at `times`, seconds."""

    def __init__(
        self, times: FloatArray, rows: TimeArray, bodies: list[Body], camera: Camera, start_m: FloatArray
    ) -> None:
        self._times, self._rows, self._camera = times, rows, camera
        self._points = np.array([camera.straight(body.points_px) for body in bodies])
        self._spread = np.array([body.spread for body in bodies])
        self._states = np.zeros((len(times), _SIZE))
        for axis in (0, 1):
            at = np.interp(times, times[rows], start_m[:, axis])
            self._states[:, axis] = at
            self._states[:, _SPEED + axis] = np.gradient(_averaged(at), times)
        self._states[:, _STATURE], self._states[:, _LEANS] = STATURE_M, _LEAN
        omega = 2 * np.pi * _STEP_HZ
        self._rest = np.diag([1.0, omega**2])
        sigma = np.concatenate(
            [
                [_PLACE_M, _PLACE_M, _SPEED_MPS, _SPEED_MPS],
                [_SWING[0], _SWING[0] * omega, _SWING[1], _SWING[1] * omega],
                _LASTING,
                [STATURE_SIGMA_M],
                _PROPORTION,
                [_FEET_AHEAD, _LEAN_SIGMA],
            ]
        )
        self._prior = np.diag(sigma**2)
        self._prior_state = np.zeros(_SIZE)
        self._prior_state[:2] = start_m[0]
        self._prior_state[[_STATURE, _LEANS]] = STATURE_M, _LEAN

    def solve(self) -> tuple[FloatArray, FloatArray]:
        """States (N, _SIZE) and covariances (N, _SIZE, _SIZE)."""
        for k in range(_ROUNDS):
            design, target, variance = self._linearised(robust=k > 0)
            states, covariances = self._smoothed(design, target, variance)
            moved = float(np.abs(states[:, :2] - self._states[:, :2]).max())
            self._states = states
            if moved < _SETTLED_M:
                break
        return self._states, covariances

    def _linearised(self, *, robust: bool) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Design (M, _ROWS, _SIZE), targets (M, _ROWS) and variances (M, _ROWS) round the present states."""
        state = self._states[self._rows]
        count = len(state)
        xy, velocity, stature = state[:, :2], state[:, _SPEED : _SPEED + 2], state[:, _STATURE]
        heading = velocity / np.maximum(np.linalg.norm(velocity, axis=1), _HEADING_MPS)[:, None]
        view = xy - self._camera.eye_m[:2]
        away = (heading * view).sum(axis=1) / np.maximum(np.linalg.norm(view, axis=1), 1e-3)
        foot, crown = self._pixels(xy, np.zeros(count)), self._pixels(xy, stature)
        tall_px = np.linalg.norm(crown - foot, axis=1)[:, None]
        along = (foot - crown) / tall_px
        axes = (np.column_stack([along[:, 1], -along[:, 0]]), along)  # to the right, and down
        design = np.zeros((count, _ROWS, _SIZE))
        misfit = np.zeros((count, _ROWS))
        for point in (ANKLES, HIPS, SHOULDERS, CROWN):
            share = HEIGHTS[point] + state[:, _SHARES + point]
            arm = max(HEIGHTS[point] - HEIGHTS[HIPS], 0.0) * stature[:, None]
            place, z = xy + state[:, _LEANS, None] * arm * heading, share * stature
            shown = self._pixels(place, z)
            by = self._slopes(place, z)
            for axis, direction in enumerate(axes):
                row = 2 * point + axis
                by_x, by_y, by_z = (np.sum(slope * direction, axis=1) / tall_px[:, 0] for slope in by)
                design[:, row, 0], design[:, row, 1] = by_x, by_y
                design[:, row, _STATURE], design[:, row, _SHARES + point] = by_z * share, by_z * stature
                turn = by_x * heading[:, 0] + by_y * heading[:, 1]
                design[:, row, _LEANS] = arm[:, 0] * turn
                misfit[:, row] = ((self._points[:, point] - shown) * direction).sum(axis=1) / tall_px[:, 0]
        fixed = design[:, :, _MOTION_AND_FIXED]
        target = misfit + np.einsum("mrs,ms->mr", fixed, state[:, _MOTION_AND_FIXED])
        design[:, 0, _SWINGS] = design[:, 1, _SWINGS + 2] = 1.0
        design[:, (1, 2, 3, 4, 5, 7), np.arange(_LASTS, _LASTS + 6)] = 1.0
        design[:, (3, 5, 7), _LASTS + 6] = 1.0
        design[:, 1, _FEET] = -away
        misfit[:, 1] += away * state[:, _FEET]
        return design, target, self._variances(misfit if robust else np.zeros_like(misfit))

    def _variances(self, misfit: FloatArray) -> FloatArray:
        """Of the targets, in (M, _ROWS); larger where a misfit is too large to be one of the usual errors."""
        variance = (_WHITE.ravel() * np.repeat(self._spread, 2, axis=1)) ** 2
        variance[:, :2] += np.maximum(self._spread[:, :1] ** 2 - 1.0, 0.0) * _GUESS**2
        off = np.abs(misfit) / np.sqrt(variance + _USUAL)
        far = np.where(np.isfinite(variance), np.maximum((off / _HUBER) ** 2 - 1.0, 0.0), 0.0)
        return np.asarray(variance + far * _HUBER_UNIT**2)

    def _smoothed(
        self, design: FloatArray, target: FloatArray, variance: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The linearised walk's Kalman filter forwards and Rauch-Tung-Striebel smoother backwards."""
        n = len(self._times)
        row_of = dict(zip(self._rows.tolist(), range(len(self._rows)), strict=True))
        before_x, before_p = np.empty((n, _SIZE)), np.empty((n, _SIZE, _SIZE))
        after_x, after_p, moves = np.empty_like(before_x), np.empty_like(before_p), np.empty_like(before_p)
        x, p = self._prior_state, self._prior
        for k in range(n):
            if k:
                moves[k], noise = self._motion(float(self._times[k] - self._times[k - 1]))
                x, p = moves[k] @ x, moves[k] @ p @ moves[k].T + noise
            before_x[k], before_p[k] = x, p
            if k in row_of:
                m = row_of[k]
                use = np.isfinite(variance[m])
                h = design[m, use]
                s = h @ p @ h.T + np.diag(variance[m, use])
                gain = np.linalg.solve(s, h @ p).T
                x, p = x + gain @ (target[m, use] - h @ x), p - gain @ s @ gain.T
                p = 0.5 * (p + p.T)
            after_x[k], after_p[k] = x, p
        floor = np.eye(_SIZE) * 1e-14
        for k in range(n - 2, -1, -1):
            back = np.linalg.solve(before_p[k + 1] + floor, moves[k + 1] @ after_p[k]).T
            after_x[k] += back @ (after_x[k + 1] - before_x[k + 1])
            after_p[k] += back @ (after_p[k + 1] - before_p[k + 1]) @ back.T
        return after_x, after_p

    def _motion(self, dt: float) -> tuple[FloatArray, FloatArray]:
        """Transition and noise, (_SIZE, _SIZE) each, over dt seconds."""
        move, noise = np.eye(_SIZE), np.zeros((_SIZE, _SIZE))
        drift = _ACCELERATION_M2_S3 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        swing = _oscillator(dt)
        fresh = self._rest - swing @ self._rest @ swing.T
        for axis in (0, 1):
            motion = np.ix_([_AT + axis, _SPEED + axis], [_AT + axis, _SPEED + axis])
            move[_AT + axis, _SPEED + axis] = dt
            noise[motion] = drift
            steps = slice(_SWINGS + 2 * axis, _SWINGS + 2 * axis + 2)
            move[steps, steps], noise[steps, steps] = swing, fresh * _SWING[axis] ** 2
        kept = np.exp(-dt / _LASTING_S)
        lasts = np.arange(_LASTS, _LASTS + len(_LASTING))
        move[lasts, lasts], noise[lasts, lasts] = kept, (1.0 - kept**2) * _LASTING**2
        return move, noise

    def _pixels(self, xy_m: FloatArray, z_m: FloatArray) -> FloatArray:
        return self._camera.pixels(np.column_stack([xy_m, z_m]))

    def _slopes(self, xy_m: FloatArray, z_m: FloatArray) -> list[FloatArray]:
        """Pixels (M, 2) per metre along the map's x, y and z."""
        at, step = np.column_stack([xy_m, z_m]), 1e-3
        moves = np.eye(3) * step
        return [(self._camera.pixels(at + d) - self._camera.pixels(at - d)) / (2.0 * step) for d in moves]


def _averaged(values: FloatArray) -> FloatArray:
    """(N,) under a window of about a second, the ends held."""
    half = 8
    padded = np.pad(values, half, mode="edge")
    return np.convolve(padded, np.full(2 * half + 1, 1.0 / (2 * half + 1)), mode="valid")


def _oscillator(dt: float) -> FloatArray:
    """Transition (2, 2) over dt of x'' = -omega^2 x - 2 damping omega x'."""
    omega = 2 * np.pi * _STEP_HZ
    decay, turn = _STEP_DAMPING * omega, omega * np.sqrt(1.0 - _STEP_DAMPING**2)
    c, s = np.cos(turn * dt), np.sin(turn * dt) / turn
    return np.asarray(np.exp(-decay * dt) * np.array([[c + decay * s, s], [-(omega**2) * s, c - decay * s]]))


def _sampled(first_ns: int, times: FloatArray, states: FloatArray, covariances: FloatArray) -> SmoothTrack:
    """The estimate at SMOOTH_HZ; between two of its times a cubic through places and velocities."""
    step_ns = int(1e9 / SMOOTH_HZ)
    t_ns = first_ns + np.arange(0, int(times[-1] * 1e9) + 1, step_ns)
    at = (t_ns - first_ns) * 1e-9
    k = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
    dt = times[k + 1] - times[k]
    u = (at - times[k]) / dt
    before, after = 1.0 - u, u
    ends = (
        states[k, :2] * ((1 + 2 * u) * before**2)[:, None]
        + states[k + 1, :2] * (after**2 * (3 - 2 * u))[:, None]
    )
    bends = (
        states[k, 2:4] * (u * before**2 * dt)[:, None]
        - states[k + 1, 2:4] * (after**2 * before * dt)[:, None]
    )
    velocity = states[k, 2:4] * before[:, None] + states[k + 1, 2:4] * after[:, None]
    whole = covariances[:, :2, :2]
    # What the things that stay the same would move, were they known better.
    fixed, shared = covariances[:, _STATURE:, _STATURE:], covariances[:, :2, _STATURE:]
    slow = shared @ np.linalg.solve(fixed, shared.transpose(0, 2, 1))

    def between(values: FloatArray) -> FloatArray:
        return values[k] * before[:, None, None] + values[k + 1] * after[:, None, None]

    return SmoothTrack(
        t_ns,
        ends + bends,
        velocity,
        between(whole),
        between(slow),
        float(states[0, _STATURE]),
        float(np.sqrt(covariances[0, _STATURE, _STATURE])),
    )
