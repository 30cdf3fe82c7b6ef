"""What an Intel 5300 makes of a channel: the errors and the number formats of its CSI.

Modelled on public recordings of the card: the phase of every packet is new; the symbol timing drifts with
the sampling clocks' difference and jumps by one 40 MHz sample when it is a sample late; the largest of the
8-bit components of a packet with one stream is about 45 (35..70), not 127; RSSI and AGC are whole
decibels; antenna_sel orders the chains and may change from one packet to the next.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vad.sim.radio_channel import SUBCARRIER_HZ, SUBCARRIERS, WAVELENGTH_M, ComplexArray

FloatArray = NDArray[np.float64]

NOISE_DBM = -92
_TX_DBM = 15.0
_FREE_SPACE_1M_DB = 20 * np.log10(WAVELENGTH_M / (4 * np.pi))
_RSSI_TARGET = 40.0  # the AGC brings the antennas' sum to about this
_RSSI_OFFSET_DB = 44.0  # dBm = RSSI - 44 - AGC (formats.md section 2)
_AGC_MAX = 63
_CSI_RMS = 30.0
_SAMPLE_S = 25e-9
_TIMING_S = 150e-9  # the card's window starts this much ahead of the first path


@dataclass(frozen=True, slots=True)
class Readings:
    """N packets as the card reports them.

    csi int8 (N, 30, R, 1, 2), rows by antenna, real then imaginary; rssi uint8 (N, 3), 0 = no antenna;
    agc, antenna_sel uint8 (N,).
    """

    csi: NDArray[np.int8]
    rssi: NDArray[np.uint8]
    agc: NDArray[np.uint8]
    antenna_sel: NDArray[np.uint8]


class Nic:
    """One card with its own chains, clock error and chain order.

    Args:
        n_rx: antennas, 1..3.
        rng: draws the card.
    """

    def __init__(self, n_rx: int, rng: np.random.Generator) -> None:
        self._n_rx = n_rx
        self._clock_ppm = float(rng.uniform(1.0, 8.0) * rng.choice([-1, 1]))
        self._snr_db = rng.uniform(20.0, 27.0) + rng.uniform(-1.0, 1.0, n_rx)
        phase = rng.uniform(0, 2 * np.pi, n_rx)
        gain_db = rng.uniform(-1.5, 1.5, n_rx)
        skew_s = rng.uniform(-4e-9, 4e-9, n_rx)
        # The channel filter is not flat: a slow ripple over the band, another for each chain.
        ripple_phase = rng.uniform(0, 2 * np.pi, n_rx)
        ripple = 1 + 0.08 * np.cos(2 * np.pi * SUBCARRIERS / 40.0 + ripple_phase[:, None])
        turn = phase[:, None] - 2 * np.pi * SUBCARRIER_HZ * SUBCARRIERS * skew_s[:, None]
        self._chain = (10 ** (gain_db / 20)[:, None] * ripple * np.exp(1j * turn)).astype(np.complex64)
        order = rng.permutation(n_rx)
        other = order.copy()
        other[-2:] = other[-2:][::-1]
        self._orders = tuple(_antenna_sel(o) for o in (order, other))

    def read(
        self, t_s: FloatArray, channel: ComplexArray, floor: FloatArray, rng: np.random.Generator
    ) -> Readings:
        """Receive packets.

        Args:
            t_s: (N,) when.
            channel: (N, R, 30) relative to free space at 1 m.
            floor: (N,) the power of `channel` against which the card's signal to noise ratio holds: it keeps
                when a body weakens the signal.
            rng: the noise of these packets.
        """
        n = len(t_s)
        h = channel * self._chain
        power = (h.real**2 + h.imag**2).mean(axis=2)
        noise = rng.standard_normal((n, self._n_rx, len(SUBCARRIERS), 2), dtype=np.float32)
        sigma = np.sqrt(floor / 2)[:, None] * 10 ** (-self._snr_db / 20)
        h += noise.view(np.complex64)[..., 0] * sigma[..., None].astype(np.float32)

        late_s = _SAMPLE_S * np.mod(self._clock_ppm * 1e-6 * t_s / _SAMPLE_S, 1.0)
        slip = rng.choice([-1.0, 0.0, 1.0], n, p=[0.02, 0.96, 0.02])
        timing_s = _TIMING_S + late_s + slip * _SAMPLE_S + rng.normal(0.0, 0.4e-9, n)
        slope = -2 * np.pi * SUBCARRIER_HZ * timing_s
        turn = rng.uniform(0, 2 * np.pi, n)[:, None] + slope[:, None] * SUBCARRIERS
        h *= np.exp(1j * turn).astype(np.complex64)[:, None]

        level = _CSI_RMS * 10 ** (rng.normal(0.0, 0.4, n) / 20)
        rms = np.sqrt((h.real**2 + h.imag**2).mean(axis=(1, 2)))
        h *= (level / np.maximum(rms, 1e-12)).astype(np.float32)[:, None, None]
        parts = np.swapaxes(h, 1, 2).copy().view(np.float32).reshape(n, len(SUBCARRIERS), self._n_rx, 1, 2)
        csi = np.clip(np.rint(parts), -127, 127).astype(np.int8)

        dbm = _TX_DBM + _FREE_SPACE_1M_DB + 10 * np.log10(np.maximum(power, 1e-12))
        total_dbm = 10 * np.log10((10 ** (dbm / 10)).sum(axis=1)) + rng.normal(0.0, 0.25, n)
        agc = np.clip(np.rint(_RSSI_TARGET - _RSSI_OFFSET_DB - total_dbm), 0, _AGC_MAX)
        rssi = np.zeros((n, 3), np.uint8)
        read = dbm + _RSSI_OFFSET_DB + agc[:, None] + rng.normal(0.0, 0.3, dbm.shape)
        rssi[:, : self._n_rx] = np.clip(np.rint(read), 1, 127)
        which = (rng.random(n) < 0.05).astype(np.intp)
        return Readings(csi, rssi, agc.astype(np.uint8), np.array(self._orders, np.uint8)[which])


def _antenna_sel(order: NDArray[np.int64]) -> int:
    """The field that says that chain j is antenna order[j]."""
    return sum(int(antenna) << 2 * chain for chain, antenna in enumerate(order))
