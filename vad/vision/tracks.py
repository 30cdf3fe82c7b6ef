"""People on the map's floor over time: tracks with identities. Pure.

One constant-velocity Kalman filter a person, assignment of least total cost within a gate.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vad.vision.body import Body

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


@dataclass(frozen=True, slots=True)
class Track:
    """A person's ground points in the map, as measured.

    t_ns: (N,) int64, rising; xy_m: (N, 2); covariance_m2: (N, 2, 2), as stated by the source of the points;
    bodies: N times what was seen of the body, None where that was not given.
    """

    id: int
    t_ns: TimeArray
    xy_m: FloatArray
    covariance_m2: FloatArray
    bodies: tuple[Body | None, ...]
    ended: bool

    def within(self, from_ns: int, to_ns: int) -> Track:
        """The part of the track between two times, both included."""
        inside = np.flatnonzero((self.t_ns >= from_ns) & (self.t_ns <= to_ns))
        bodies = tuple(self.bodies[k] for k in inside.tolist())
        return replace(
            self,
            t_ns=self.t_ns[inside],
            xy_m=self.xy_m[inside],
            covariance_m2=self.covariance_m2[inside],
            bodies=bodies,
        )


class _Person:
    """One Kalman filter, state x, y, vx, vy, with what it has seen."""

    def __init__(
        self, track_id: int, t_ns: int, point: FloatArray, covariance: FloatArray, body: Body | None
    ) -> None:
        self.id = track_id
        self.confirmed = False
        self.ended_ns: int | None = None
        self.history: deque[tuple[int, FloatArray, FloatArray, Body | None]] = deque(maxlen=_HISTORY)
        self._t_ns = t_ns
        self._state = np.concatenate([point, [0.0, 0.0]])
        self._p = np.zeros((4, 4))
        self._p[:2, :2] = covariance
        self._p[2:, 2:] = np.eye(2) * _BIRTH_SPEED_MPS**2
        self.history.append((t_ns, point, covariance, body))

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

    def take(self, t_ns: int, point: FloatArray, covariance: FloatArray, body: Body | None) -> None:
        s = self._p[:2, :2] + covariance
        gain = np.linalg.solve(s, self._p[:2, :]).T
        self._state = self._state + gain @ (point - self._state[:2])
        left = np.eye(4)
        left[:, :2] -= gain
        self._p = left @ self._p
        self._p = 0.5 * (self._p + self._p.T)
        self.history.append((t_ns, point, covariance, body))
        self.confirmed |= len(self.history) >= HITS_TO_CONFIRM

    def track(self) -> Track:
        times, points, covariances, bodies = zip(*self.history, strict=True)
        return Track(
            self.id,
            np.array(times, dtype=np.int64),
            np.array(points),
            np.array(covariances),
            tuple(bodies),
            self.ended_ns is not None,
        )


class Tracker:
    """Gives people identities. A track is born of 3 hits and ends 1.5 s after its last."""

    def __init__(self) -> None:
        self._people: list[_Person] = []
        self._ended: list[_Person] = []
        self._next_id = 1
        self._t_ns = 0

    def update(
        self,
        t_ns: int,
        points_m: ArrayLike,
        covariances_m2: ArrayLike,
        bodies: Sequence[Body | None] | None = None,
    ) -> None:
        """Take one frame's ground points in the map: (N, 2) and (N, 2, 2); N may be 0; and their bodies.

        Points that are not finite are left out. Frames must come in order of time.

        Raises:
            ValueError: t_ns lies before the frame before.
        """
        points = np.asarray(points_m, dtype=np.float64).reshape(-1, 2)
        covariances = np.asarray(covariances_m2, dtype=np.float64).reshape(-1, 2, 2)
        finite = np.asarray(np.isfinite(points).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2)))
        given = bodies if bodies is not None else [None] * len(points)
        bodies = [body for body, use in zip(given, finite.tolist(), strict=True) if use]
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
                person.take(t_ns, points[k], covariances[k], bodies[k])
        for k in set(range(len(points))) - set(taken):
            self._people.append(_Person(self._next_id, t_ns, points[k], covariances[k], bodies[k]))
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
