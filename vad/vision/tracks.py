"""People on the map's floor over time: tracks with identities, and a track's smooth path. Pure.

Tracking: one constant-velocity Kalman filter a person, assignment of least total cost within a gate.
Smoothing: see `smooth`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
TimeArray = NDArray[np.int64]

# Birth and death of a track.
HITS_TO_CONFIRM = 3
LOST_AFTER_S = 1.5
_DOUBTFUL_AFTER_S = 0.4
# An ended track is kept this long for whoever needs its path, of which the last 2 min at 15 fps are kept.
_KEEP_ENDED_S = 120.0
_HISTORY = 1800

# How people move: spectral density of their acceleration, and the speed of somebody just found.
_ACCELERATION_M2_S3 = 0.5
_BIRTH_SPEED_MPS = 0.8
# Squared Mahalanobis distance that 99.97 % of a track's own points stay under (2 degrees of freedom).
_GATE = 16.0

# lone_mover: seen lately, and this far on the way.
_SEEN_WITHIN_S = 0.6
_MOVING_WINDOW_S = 1.0
_MOVING_MPS = 0.25

# The smoother. Steps: 1.2-2.2 Hz, wherefore a broad resonance. Shares of a point's stated variance.
SMOOTH_HZ = 20.0
_STEP_HZ, _STEP_DAMPING = 1.5, 0.3
_WHITE_SHARE, _SWING_SHARE, _SLOW_SHARE = 0.2, 0.6, 0.2
_HUBER = 3.0


@dataclass(frozen=True, slots=True)
class Track:
    """A person's ground points in the map, as measured.

    t_ns: (N,) int64, rising; xy_m: (N, 2); covariance_m2: (N, 2, 2), as stated by the source of the points.
    """

    id: int
    t_ns: TimeArray
    xy_m: FloatArray
    covariance_m2: FloatArray
    ended: bool


class _Person:
    """One Kalman filter, state x, y, vx, vy, with what it has seen."""

    def __init__(self, track_id: int, t_ns: int, point: FloatArray, covariance: FloatArray) -> None:
        self.id = track_id
        self.confirmed = False
        self.ended_ns: int | None = None
        self.history: deque[tuple[int, FloatArray, FloatArray]] = deque(maxlen=_HISTORY)
        self._t_ns = t_ns
        self._state = np.concatenate([point, [0.0, 0.0]])
        self._p = np.zeros((4, 4))
        self._p[:2, :2] = covariance
        self._p[2:, 2:] = np.eye(2) * _BIRTH_SPEED_MPS**2
        self.history.append((t_ns, point, covariance))

    @property
    def seen_ns(self) -> int:
        return self.history[-1][0]

    def predict(self, t_ns: int) -> None:
        dt = (t_ns - self._t_ns) * 1e-9
        self._t_ns = t_ns
        f = np.eye(4)
        f[0, 2] = f[1, 3] = dt
        self._state = f @ self._state
        self._p = f @ self._p @ f.T + np.kron(_cv_noise(dt), np.eye(2))

    def cost(self, point: FloatArray, covariance: FloatArray) -> float:
        """Squared Mahalanobis distance of a point from where the person should be now."""
        s = self._p[:2, :2] + covariance
        error = point - self._state[:2]
        return float(error @ np.linalg.solve(s, error))

    def take(self, t_ns: int, point: FloatArray, covariance: FloatArray) -> None:
        s = self._p[:2, :2] + covariance
        gain = np.linalg.solve(s, self._p[:2, :]).T
        self._state = self._state + gain @ (point - self._state[:2])
        left = np.eye(4)
        left[:, :2] -= gain
        self._p = left @ self._p
        self._p = 0.5 * (self._p + self._p.T)
        self.history.append((t_ns, point, covariance))
        self.confirmed |= len(self.history) >= HITS_TO_CONFIRM

    def track(self) -> Track:
        times, points, covariances = zip(*self.history, strict=True)
        return Track(
            self.id,
            np.array(times, dtype=np.int64),
            np.array(points),
            np.array(covariances),
            self.ended_ns is not None,
        )


class Tracker:
    """Gives people identities. A track is born of 3 hits and ends 1.5 s after its last."""

    def __init__(self) -> None:
        self._people: list[_Person] = []
        self._ended: list[_Person] = []
        self._next_id = 1
        self._t_ns = 0

    def update(self, t_ns: int, points_m: ArrayLike, covariances_m2: ArrayLike) -> None:
        """Take one frame's ground points in the map: (N, 2) and (N, 2, 2); N may be 0.

        Points that are not finite are left out. Frames must come in order of time.

        Raises:
            ValueError: t_ns lies before the frame before.
        """
        points = np.asarray(points_m, dtype=np.float64).reshape(-1, 2)
        covariances = np.asarray(covariances_m2, dtype=np.float64).reshape(-1, 2, 2)
        finite = np.isfinite(points).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
        points, covariances = points[finite], covariances[finite]
        if t_ns < self._t_ns:
            raise ValueError("frames must come in order of time")
        self._t_ns = t_ns
        self._bury(t_ns)  # first: after a pause in the frames nobody takes up a track that has ended
        for person in self._people:
            person.predict(t_ns)
        costs = np.array(
            [[p.cost(x, c) for x, c in zip(points, covariances, strict=True)] for p in self._people]
        )
        taken = _assign(costs.reshape(len(self._people), len(points)))
        for person, k in zip(self._people, taken, strict=True):
            if k is not None:
                person.take(t_ns, points[k], covariances[k])
        for k in set(range(len(points))) - set(taken):
            self._people.append(_Person(self._next_id, t_ns, points[k], covariances[k]))
            self._next_id += 1

    def _bury(self, t_ns: int) -> None:
        alive = []
        for person in self._people:
            silent_s = (t_ns - person.seen_ns) * 1e-9
            if silent_s < (LOST_AFTER_S if person.confirmed else _DOUBTFUL_AFTER_S):
                alive.append(person)
            elif person.confirmed:
                person.ended_ns = t_ns
                self._ended.append(person)
        self._people = alive
        self._ended = [p for p in self._ended if (t_ns - p.seen_ns) * 1e-9 < _KEEP_ENDED_S]

    def tracks(self) -> list[Track]:
        """The confirmed tracks, alive and lately ended, in order of birth."""
        people = [p for p in self._people if p.confirmed] + self._ended
        return [p.track() for p in sorted(people, key=lambda p: p.id)]


def _cv_noise(dt: float) -> FloatArray:
    """Process noise of a constant-velocity model over dt seconds, (2, 2): white acceleration."""
    return _ACCELERATION_M2_S3 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])


def _assign(costs: FloatArray) -> list[int | None]:
    """For each row (track) its column (point) or None: least total cost, an empty hand costing the gate.

    Exact, by dynamic programming over the points' subsets: fine for the six people a frame can hold.
    """
    tracks, points = costs.shape
    best: dict[int, tuple[float, list[int | None]]] = {0: (0.0, [])}
    for row in range(tracks):
        grown: dict[int, tuple[float, list[int | None]]] = {}
        for used, (total, chosen) in best.items():
            options: list[tuple[int, float, int | None]] = [(used, total + _GATE, None)]
            for k in range(points):
                if not used >> k & 1 and costs[row, k] < _GATE:
                    options.append((used | 1 << k, total + float(costs[row, k]), k))
            for mask, value, choice in options:
                if mask not in grown or value < grown[mask][0]:
                    grown[mask] = (value, [*chosen, choice])
        best = grown
    return min(best.values(), key=lambda option: option[0])[1]


def lone_mover(tracks: Sequence[Track], t_ns: int) -> int | None:
    """The id of the one person who moves at t_ns; None when nobody does, or more than one."""
    moving = movers(tracks, t_ns)
    return moving[0] if len(moving) == 1 else None


def movers(tracks: Sequence[Track], t_ns: int) -> list[int]:
    """The ids of the people who move at t_ns."""
    return [track.id for track in tracks if _moves(track, t_ns)]


def _moves(track: Track, t_ns: int) -> bool:
    age_s = (t_ns - track.t_ns) * 1e-9
    if len(age_s) == 0 or age_s[-1] > _SEEN_WITHIN_S:
        return False
    lately = (age_s >= 0) & (age_s < _MOVING_WINDOW_S)
    if np.count_nonzero(lately) < HITS_TO_CONFIRM:
        return False
    # A line through the last second: one step's swing is no speed.
    t, xy = -age_s[lately], track.xy_m[lately]
    t = t - t.mean()
    spread = float(t @ t)
    velocity = t @ (xy - xy.mean(axis=0)) / max(spread, 1e-6)
    return float(np.hypot(*velocity)) > _MOVING_MPS


@dataclass(frozen=True, slots=True)
class SmoothTrack:
    """A person's path in the map at 20 Hz.

    t_ns: (N,); xy_m: (N, 2), midway between the feet with the stepping removed; velocity_mps: (N, 2);
    covariance_m2: (N, 2, 2) of xy_m, all of it; slow_covariance_m2: (N, 2, 2), that part of it which hardly
    changes during a walk (a bias along the camera's view, say) and so does not average out.
    """

    t_ns: TimeArray
    xy_m: FloatArray
    velocity_mps: FloatArray
    covariance_m2: FloatArray
    slow_covariance_m2: FloatArray


def smooth(track: Track) -> SmoothTrack:
    """A track's smooth path with an honest covariance: a Rauch-Tung-Striebel smoother over the whole track.

    A measured point is the person (nearly constant velocity), plus the swing of the feet (a damped
    oscillation at the step frequency), plus white noise, plus what a track by itself cannot tell from the
    truth: a slow error, which is added to the covariance. The last three are shares of the point's stated
    covariance.

    Raises:
        ValueError: a track of fewer than two points.
    """
    if len(track.t_ns) < 2:
        raise ValueError("a track of fewer than two points has no path")
    grid = np.arange(track.t_ns[0], track.t_ns[-1] + 1, int(1e9 / SMOOTH_HZ))
    times = np.union1d(grid, track.t_ns)
    measured = np.searchsorted(times, track.t_ns)
    at_s, seen_s = (times - times[0]) * 1e-9, (track.t_ns - times[0]) * 1e-9
    stated = np.empty((len(times), 2, 2))
    for i in range(2):
        for j in range(2):
            stated[:, i, j] = np.interp(at_s, seen_s, track.covariance_m2[:, i, j])
    points: dict[int, FloatArray] = {int(k): xy for k, xy in zip(measured, track.xy_m, strict=True)}
    means, covariances = _filter_and_smooth(at_s, points, stated)
    keep = np.searchsorted(times, grid)
    slow = _SLOW_SHARE * stated[keep]
    return SmoothTrack(grid, means[keep, :2], means[keep, 2:4], covariances[keep, :2, :2] + slow, slow)


def _filter_and_smooth(
    at_s: FloatArray, points: dict[int, FloatArray], stated: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Means (N, 8) and covariances (N, 8, 8) of position, velocity, swing and swing rate, (x, y) each."""
    n, eye2 = len(at_s), np.eye(2)
    omega = 2 * np.pi * _STEP_HZ
    rest = np.diag([1.0, omega**2])
    h = np.hstack([eye2, np.zeros((2, 2)), eye2, np.zeros((2, 2))])
    x = np.zeros(8)
    x[:2] = points[0]
    p = np.zeros((8, 8))
    p[:2, :2] = stated[0] * 4.0
    p[2:4, 2:4] = eye2 * _BIRTH_SPEED_MPS**2
    p[4:, 4:] = np.kron(rest, _SWING_SHARE * stated[0])
    before_x, before_p = np.empty((n, 8)), np.empty((n, 8, 8))
    after_x, after_p, moves = np.empty((n, 8)), np.empty((n, 8, 8)), np.empty((n, 8, 8))
    for k in range(n):
        f = np.eye(8)
        if k:
            dt = float(at_s[k] - at_s[k - 1])
            f[:4, :4] = np.kron([[1.0, dt], [0.0, 1.0]], eye2)
            swing = _oscillator(dt, omega)
            f[4:, 4:] = np.kron(swing, eye2)
            x, p = f @ x, f @ p @ f.T
            p[:4, :4] += np.kron(_cv_noise(dt), eye2)
            p[4:, 4:] += np.kron(rest - swing @ rest @ swing.T, _SWING_SHARE * stated[k])
        moves[k], before_x[k], before_p[k] = f, x, p
        if k in points:
            s = h @ p @ h.T + _WHITE_SHARE * stated[k]
            error = points[k] - h @ x
            # A point far off its prediction is believed the less (Huber's weight).
            off = float(np.sqrt(error @ np.linalg.solve(s, error)))
            if off > _HUBER:
                s = s + _WHITE_SHARE * stated[k] * ((off / _HUBER) ** 2 - 1.0) * 4.0
            gain = np.linalg.solve(s, h @ p).T
            x, p = x + gain @ error, p - gain @ s @ gain.T
            p = 0.5 * (p + p.T)
        after_x[k], after_p[k] = x, p
    for k in range(n - 2, -1, -1):
        back = np.linalg.solve(before_p[k + 1], moves[k + 1] @ after_p[k]).T
        after_x[k] += back @ (after_x[k + 1] - before_x[k + 1])
        after_p[k] += back @ (after_p[k + 1] - before_p[k + 1]) @ back.T
    return after_x, after_p


def _oscillator(dt: float, omega: float) -> FloatArray:
    """Transition (2, 2) over dt of x'' = -omega^2 x - 2 damping omega x'."""
    decay, turn = _STEP_DAMPING * omega, omega * np.sqrt(1.0 - _STEP_DAMPING**2)
    c, s = np.cos(turn * dt), np.sin(turn * dt) / turn
    return np.asarray(np.exp(-decay * dt) * np.array([[c + decay * s, s], [-(omega**2) * s, c - decay * s]]))
