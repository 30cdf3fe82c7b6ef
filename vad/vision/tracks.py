"""People on the map's floor over time: tracks with identities. Pure.

One constant-velocity Kalman filter a person, assignment of least total cost within a gate.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vad.vision.body import Body
from vad.vision.clothes import remembered, unlikeness
from vad.vision.standing import Standing

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
# The cost of not seeing somebody: far off and in other clothes, it is somebody else.
_MISSED = 20.0


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

    def __init__(self, track_id: int, t_ns: int, seen: Standing) -> None:
        self.id = track_id
        self.confirmed = False
        self.ended_ns: int | None = None
        self.history: deque[tuple[int, Standing]] = deque(maxlen=_HISTORY)
        self._t_ns = t_ns
        self._state = np.concatenate([seen.xy_m, [0.0, 0.0]])
        self._p = np.zeros((4, 4))
        self._p[:2, :2] = seen.covariance_m2
        self._p[2:, 2:] = np.eye(2) * _BIRTH_SPEED_MPS**2
        self.history.append((t_ns, seen))
        self._clothes = seen.clothes

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

    def cost(self, seen: Standing) -> float:
        """How ill what was seen fits this person: the squared Mahalanobis distance from where they should be
        now, and how unlike the clothes are; infinite beyond the gate."""
        error = seen.xy_m - self._state[:2]
        apart = float(error @ np.linalg.solve(self._p[:2, :2] + seen.covariance_m2, error))
        return apart + unlikeness(self._clothes, seen.clothes) if apart < _GATE else np.inf

    def take(self, t_ns: int, seen: Standing) -> None:
        s = self._p[:2, :2] + seen.covariance_m2
        gain = np.linalg.solve(s, self._p[:2, :]).T
        self._state = self._state + gain @ (seen.xy_m - self._state[:2])
        left = np.eye(4)
        left[:, :2] -= gain
        self._p = left @ self._p
        self._p = 0.5 * (self._p + self._p.T)
        self._clothes = remembered(self._clothes, seen.clothes)
        self.history.append((t_ns, seen))
        self.confirmed |= len(self.history) >= HITS_TO_CONFIRM

    def track(self) -> Track:
        times, seen = zip(*self.history, strict=True)
        return Track(
            self.id,
            np.array(times, dtype=np.int64),
            np.array([one.xy_m for one in seen]),
            np.array([one.covariance_m2 for one in seen]),
            tuple(one.body for one in seen),
            self.ended_ns is not None,
        )


class Tracker:
    """Gives people identities. A track is born of 3 hits and ends 1.5 s after its last."""

    def __init__(self) -> None:
        self._people: list[_Person] = []
        self._ended: list[_Person] = []
        self._next_id = 1
        self._t_ns = 0

    def update(self, t_ns: int, people: Sequence[Standing]) -> None:
        """Take one frame's people, none to six.

        Places that are not finite are left out. Frames must come in order of time.

        Raises:
            ValueError: t_ns lies before the frame before.
        """
        seen = [one for one in people if np.isfinite(one.xy_m).all() and np.isfinite(one.covariance_m2).all()]
        if t_ns < self._t_ns:
            raise ValueError("frames must come in order of time")
        self._t_ns = t_ns
        self._bury(t_ns)  # first: after a pause in the frames nobody takes up a track that has ended
        for person in self._people:
            person.predict(t_ns)
        costs = np.array([[person.cost(one) for one in seen] for person in self._people])
        taken = _assign(costs.reshape(len(self._people), len(seen)))
        for person, k in zip(self._people, taken, strict=True):
            if k is not None:
                person.take(t_ns, seen[k])
        for k in set(range(len(seen))) - set(taken):
            self._people.append(_Person(self._next_id, t_ns, seen[k]))
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
    """For each row (track) its column (person seen) or None: least total cost, nobody costing _MISSED.

    Exact, by dynamic programming over the points' subsets: fine for the six people a frame can hold.
    """
    tracks, points = costs.shape
    best: dict[int, tuple[float, list[int | None]]] = {0: (0.0, [])}
    for row in range(tracks):
        grown: dict[int, tuple[float, list[int | None]]] = {}
        for used, (total, chosen) in best.items():
            options: list[tuple[int, float, int | None]] = [(used, total + _MISSED, None)]
            for k in range(points):
                if not used >> k & 1 and np.isfinite(costs[row, k]):
                    options.append((used | 1 << k, total + float(costs[row, k]), k))
            for mask, value, choice in options:
                if mask not in grown or value < grown[mask][0]:
                    grown[mask] = (value, [*chosen, choice])
        best = grown
    return min(best.values(), key=lambda option: option[0])[1]
