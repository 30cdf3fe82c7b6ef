"""The radio channel of a simulated home: what a packet's waves meet between a device and the hub.

Ray model: line of sight, first-order reflections by image sources, static scatterers, and the person as a
handful of moving point scatterers, also seen by way of the walls. Every path has length L and amplitude a;
the channel at frequency f is the sum of a exp(-j 2 pi f L / c). Doppler is not put in: it comes from L at
each packet's time. Amplitudes are relative to free space at 1 m.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vad.sim.radio_body import LIMBS, BodyState, BodyTrack
from vad.sim.scenario import CARRIER_HZ, Scenario

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex64]

LIGHT_MPS = 299_792_458.0
WAVELENGTH_M = LIGHT_MPS / CARRIER_HZ
SUBCARRIERS = np.array([*range(-28, 0, 2), -1, *range(1, 29, 2), 28])
"""HT20 with grouping 2 (formats.md section 2)."""
SUBCARRIER_HZ = 312_500.0
CEILING_M = 2.5
WALL_LOSS = 0.5
"""Amplitude left behind the wall to the next room (6 dB)."""
TORSO_RCS_M2 = 0.3
_SHADOW_DEPTH, _SHADOW_WIDTH_M = 0.75, 0.2
_NEAR_M = 0.3  # scatterers are not points: amplitudes stop growing nearer than this


@dataclass(frozen=True, slots=True)
class Surroundings:
    """How strongly a room speaks back: ranges from which each wall and each thing is drawn.

    reflection: amplitude that a wall, floor or ceiling keeps; things: how many still scatterers, the upper
    end left out; thing_rcs_m2: their radar cross sections. The defaults are a furnished home.
    """

    reflection: tuple[float, float] = (0.25, 0.5)
    things: tuple[int, int] = (5, 11)
    thing_rcs_m2: tuple[float, float] = (0.1, 1.5)


FURNISHED = Surroundings()


def _distance(a: FloatArray, b: FloatArray) -> FloatArray:
    out: FloatArray = np.sqrt(((a - b) ** 2).sum(axis=-1))
    return out


def _scatter_gain(rcs_m2: FloatArray | float, d1_m: FloatArray, d2_m: FloatArray) -> FloatArray:
    """Bistatic radar equation against free space at 1 m: sqrt(rcs / 4 pi) / (d1 d2)."""
    gain: FloatArray = np.sqrt(np.asarray(rcs_m2) / (4 * np.pi)) / np.sqrt(
        (d1_m**2 + _NEAR_M**2) * (d2_m**2 + _NEAR_M**2)
    )
    return gain


def path_sum(gain: FloatArray, length_m: FloatArray) -> ComplexArray:
    """Channel (N, R, 30) of paths with gain (N, P) and length_m (N, P, R) to each antenna.

    The antennas stand within centimetres of each other, so over the 17.5 MHz one delay serves them all
    (0.006 rad at most); at the carrier each has its own.
    """
    carrier = (-2 * np.pi * np.modf(length_m / WAVELENGTH_M)[0]).astype(np.float32)
    mean_s = length_m.mean(axis=-1) / LIGHT_MPS
    slope = (-2 * np.pi * SUBCARRIER_HZ * mean_s).astype(np.float32)
    a = np.empty(carrier.shape, np.complex64)
    a.real, a.imag = np.cos(carrier), np.sin(carrier)
    a *= gain[..., None].astype(np.float32)
    angle = slope[..., None] * SUBCARRIERS.astype(np.float32)
    e = np.empty(angle.shape, np.complex64)
    e.real, e.imag = np.cos(angle), np.sin(angle)
    out: ComplexArray = np.swapaxes(a, 1, 2) @ e
    return out


class Channel:
    """The channel from one transmitter to the array at the link's other end.

    Args:
        scenario: the home.
        transmitter_m: (3,) the sender's antenna.
        antennas_m: (R, 3) the receiver's antennas.
        rng: draws furniture and what the walls are made of.
        surroundings: what it draws them from.
    """

    def __init__(
        self,
        scenario: Scenario,
        transmitter_m: FloatArray,
        antennas_m: FloatArray,
        rng: np.random.Generator,
        surroundings: Surroundings = FURNISHED,
    ) -> None:
        self._tracks = tuple(BodyTrack(walk) for walk in scenario.walks)
        self._tx, self._rx = transmitter_m, antennas_m
        x0, y0, x1, y1 = scenario.room_m
        behind = bool(max(transmitter_m[0], antennas_m[:, 0].mean()) > x1)
        self._through = WALL_LOSS if behind else 1.0
        far_x = scenario.plan_m[2] if behind else x1
        # A mirror plane: axis, coordinate. Behind the wall the next room's far wall takes this wall's part.
        mirrors = ((0, x0), (0, far_x), (1, y0), (1, y1), (2, 0.0), (2, CEILING_M))
        keep = rng.uniform(*surroundings.reflection, len(mirrors))
        tx_images, rx_images = [], []
        for axis, at_m in mirrors:
            flip = np.ones(3)
            flip[axis] = -1.0
            shift = np.zeros(3)
            shift[axis] = 2 * at_m
            tx_images.append(transmitter_m * flip + shift)
            rx_images.append(antennas_m * flip + shift)
        self._static = self._still(np.array(tx_images), keep, scenario.room_m, rng, surroundings)
        line = _distance(transmitter_m, antennas_m)
        self._sight = path_sum(np.array([[self._through / line.mean()]]), line[None, None])[0]
        # The person is reached directly, or with one bounce before or after: the ghosts of the Doppler.
        self._from_m = np.array([transmitter_m, *tx_images, *[transmitter_m] * len(mirrors)])
        self._to_m = np.array([antennas_m, *[antennas_m] * len(mirrors), *rx_images])
        self._route_gain = np.concatenate([[1.0], keep, keep]) * self._through

    def _still(
        self,
        images_m: FloatArray,
        keep: FloatArray,
        room_m: tuple[float, float, float, float],
        rng: np.random.Generator,
        surroundings: Surroundings,
    ) -> ComplexArray:
        """Reflections and furniture, (R, 30); the line of sight is apart because people block it."""
        walls = _distance(images_m[:, None], self._rx)
        count = int(rng.integers(*surroundings.things))
        x0, y0, x1, y1 = room_m
        things = np.column_stack(
            [
                rng.uniform(x0 + 0.2, x1 - 0.2, count),
                rng.uniform(y0 + 0.2, y1 - 0.2, count),
                rng.uniform(0.1, 1.8, count),
            ]
        )
        to_thing = _distance(self._tx, things)[:, None]
        from_thing = _distance(things[:, None], self._rx)
        rcs = rng.uniform(*surroundings.thing_rcs_m2, count)
        thing_gain = _scatter_gain(rcs, to_thing[:, 0], from_thing.mean(axis=1))
        gain = np.concatenate([keep / walls.mean(axis=1), thing_gain]) * self._through
        lengths = np.concatenate([walls, to_thing + from_thing])
        still: ComplexArray = path_sum(gain[None], lengths[None])[0]
        return still

    @property
    def still_power(self) -> float:
        """Mean power over antennas and subcarriers while nobody is there."""
        return float((np.abs(self._static + self._sight) ** 2).mean())

    def response(self, t_s: FloatArray) -> ComplexArray:
        """The channel at ascending times t_s (N,): complex64 (N, R, 30)."""
        out = np.empty((len(t_s), len(self._rx), len(SUBCARRIERS)), np.complex64)
        out[:] = self._static + self._sight
        for track in self._tracks:
            lo, hi = np.searchsorted(t_s, [track.start_s, track.end_s])
            if lo < hi:
                out[lo:hi] += self._person(track.at(t_s[lo:hi]))
        return out

    def _person(self, body: BodyState) -> ComplexArray:
        """What a person adds: echoes, less what they take from the line of sight."""
        torso, broad = body.torso_m(self._from_m, self._to_m.mean(axis=1))
        d1 = _distance(torso, self._from_m)
        d2 = _distance(torso[:, :, None], self._to_m)
        gain = _scatter_gain(TORSO_RCS_M2, d1, d2.mean(axis=-1)) * broad * self._route_gain
        limbs = body.limbs_m()
        l1 = _distance(limbs, self._tx)
        l2 = _distance(limbs[:, :, None], self._rx)
        rcs = np.array([limb.rcs_m2 for limb in LIMBS])
        limb_gain = _scatter_gain(rcs, l1, l2.mean(axis=-1)) * self._through
        lengths = np.concatenate([d1[..., None] + d2, l1[..., None] + l2], axis=1)
        gains = np.concatenate([gain, limb_gain], axis=1) * body.fade[:, None]
        blocked = (self.shadow(body) * body.fade).astype(np.float32)
        out: ComplexArray = path_sum(gains, lengths) - blocked[:, None, None] * self._sight
        return out

    def shadow(self, body: BodyState) -> FloatArray:
        """Part of the line of sight's amplitude that the body takes, 0..1 (N,)."""
        a, b = self._tx, self._rx.mean(axis=0)
        way = (b - a)[:2]
        off = body.centre_m[:, :2] - a[:2]
        along = np.clip(off @ way / (way @ way), 0.0, 1.0)
        beside_m = np.hypot(off[:, 0] - along * way[0], off[:, 1] - along * way[1])
        ray_m = a[2] + along * (b[2] - a[2])
        under_head = 1 / (1 + np.exp(-(body.height_m - ray_m) / 0.08))
        taken: FloatArray = _SHADOW_DEPTH * np.exp(-0.5 * (beside_m / _SHADOW_WIDTH_M) ** 2) * under_head
        return taken
