"""The radio of a simulated home: the packets between its device and its hub as an Intel 5300 hears them.

The card is the hub's, which hears the device; or the device's, which hears the hub: the paper's layout.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vad.csi.bfee import BFEE_CODE, encode_bodies
from vad.csi.dot11 import FRAME_CODE, data_frame
from vad.csi.logfile import record
from vad.mac import mac_from_text
from vad.sim.radio_channel import FURNISHED, WAVELENGTH_M, Channel, Surroundings
from vad.sim.radio_nic import NOISE_DBM, Nic
from vad.sim.scenario import Scenario

FloatArray = NDArray[np.float64]

HUB_MAC = mac_from_text("00:21:6a:0b:5e:40")
OTHER_MAC = mac_from_text("3c:5c:c4:71:0a:99")
"""A second HT station of the network, which stands still somewhere in the room and is not to be mapped."""
NEIGHBOUR_MAC = mac_from_text("9c:3d:cf:22:18:d1")
"""An access point next door; its frames are legacy ones, so the card gives no CSI for them."""

_BLOCK_SLOTS = 40  # device packets generated at once
_OTHERS_PER_BLOCK = 1
_LEGACY_PER_S = 20.0
_LOSS = 0.008
_BURSTS_PER_BLOCK = 0.02
_BURST_SLOTS = (10, 30)
_PAYLOAD = bytes.fromhex("aaaa030000000800") + bytes(range(64))  # LLC/SNAP, then data


@dataclass(frozen=True, slots=True)
class RadioBatch:
    """N CSI packets in order of time, and the legacy frames among them.

    t_s          float64 (N,) when the driver passes the packet on, on the home's timeline
    csi          int8 (N, 30, R, 1, 2), rows by antenna (A, B, C), real then imaginary
    rssi         uint8 (N, 3); noise_dbm int8 (N,); agc, antenna_sel uint8 (N,); rate uint16 (N,)
    bfee_count   uint16 (N,); nic_us uint32 (N,); both wrap
    mac          int64 (N,) the transmitter: the device (the hub where the device listens) or OTHER_MAC
    legacy_t_s   float64 (M,); legacy_frames: M frames without CSI
    """

    t_s: FloatArray
    csi: NDArray[np.int8]
    rssi: NDArray[np.uint8]
    noise_dbm: NDArray[np.int8]
    agc: NDArray[np.uint8]
    antenna_sel: NDArray[np.uint8]
    rate: NDArray[np.uint16]
    bfee_count: NDArray[np.uint16]
    nic_us: NDArray[np.uint32]
    mac: NDArray[np.int64]
    legacy_t_s: FloatArray
    legacy_frames: tuple[bytes, ...]

    def __len__(self) -> int:
        return len(self.t_s)


ArrayEnd = Literal["hub", "device"]

_PACKET_FIELDS = (
    "t_s",
    "csi",
    "rssi",
    "noise_dbm",
    "agc",
    "antenna_sel",
    "rate",
    "bfee_count",
    "nic_us",
    "mac",
)


class Radio:
    """The packets of a home, the same for the same seed however the time is cut into batches.

    Args:
        scenario: the home; the device sends from `join_s` on.
        packets_per_s: the link's rate, before 1-3 % are lost.
        n_rx: antennas of the card, 1..3, half a wavelength apart on a line of random direction.
        seed: of everything the scenario does not fix.
        array_end: where the card and its antennas are; the other end sends.
        surroundings: what walls and furniture are drawn from.

    Not for use by two threads at once.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        packets_per_s: float = 400.0,
        n_rx: int = 3,
        seed: int,
        array_end: ArrayEnd = "hub",
        surroundings: Surroundings = FURNISHED,
    ) -> None:
        if not 1 <= n_rx <= 3:
            raise ValueError("an Intel 5300 has 1 to 3 antennas")
        if packets_per_s <= 0:
            raise ValueError("packets_per_s must be positive")
        rng = np.random.default_rng([seed, 0x5300])
        self._seed, self._rate_hz = seed, packets_per_s
        azimuth, tilt = rng.uniform(0, 2 * np.pi), rng.uniform(-0.35, 0.35)
        line = np.array([np.cos(azimuth) * np.cos(tilt), np.sin(azimuth) * np.cos(tilt), np.sin(tilt)])
        places = (np.arange(n_rx) - (n_rx - 1) / 2) * WAVELENGTH_M / 2
        hub_m, device_m = np.array(scenario.anchor_m), np.array(scenario.device_m)
        array_m, sender_m = (hub_m, device_m) if array_end == "hub" else (device_m, hub_m)
        self.antennas_m: FloatArray = array_m + places[:, None] * line
        x0, y0, x1, y1 = scenario.room_m
        elsewhere = np.array(
            [rng.uniform(x0 + 0.3, x1 - 0.3), rng.uniform(y0 + 0.3, y1 - 0.3), rng.uniform(0.4, 1.4)]
        )
        self._link = Channel(scenario, sender_m, self.antennas_m, rng, surroundings)
        self._other = Channel(scenario, elsewhere, self.antennas_m, rng, surroundings)
        self._nic = Nic(n_rx, rng)
        self._device_mac = mac_from_text(scenario.device_mac)
        self._sender_mac = self._device_mac if array_end == "hub" else HUB_MAC
        self._first_slot = int(np.ceil(scenario.join_s * packets_per_s))
        self._nic_start_s = rng.uniform(0, 4294.0)
        self._nic_ppm = rng.uniform(-15, 15)
        self._blocks: dict[int, RadioBatch] = {}

    def generate(self, t0_s: float, t1_s: float) -> RadioBatch:
        """The packets with t0_s <= t < t1_s; none before 0."""
        block_s = _BLOCK_SLOTS / self._rate_hz
        first, last = int(max(t0_s, 0.0) / block_s), int(np.ceil(max(t1_s, 0.0) / block_s))
        wanted = range(first, max(last, first + 1))
        for old in [b for b in self._blocks if b not in wanted]:
            del self._blocks[old]
        for b in wanted:
            if b not in self._blocks:
                self._blocks[b] = self._block(b)
        parts = [_between(self._blocks[b], t0_s, t1_s) for b in wanted]
        return RadioBatch(
            **{name: np.concatenate([getattr(p, name) for p in parts]) for name in _PACKET_FIELDS},
            legacy_t_s=np.concatenate([p.legacy_t_s for p in parts]),
            legacy_frames=tuple(frame for p in parts for frame in p.legacy_frames),
        )

    def log_bytes(self, batch: RadioBatch) -> list[tuple[float, bytes]]:
        """The driver's records in order of time, as log_to_file writes them: (t_s, record).

        A received frame is its 0xC1 record; one with CSI has its 0xBB record right after it.
        """
        csi = encode_bodies(
            batch.csi,
            nic_us=batch.nic_us,
            bfee_count=batch.bfee_count,
            rssi=batch.rssi,
            noise_dbm=batch.noise_dbm,
            agc=batch.agc,
            antenna_sel=batch.antenna_sel,
            rate=batch.rate,
        )
        out: list[tuple[float, bytes]] = []
        for t_s, mac, count, body in zip(
            batch.t_s.tolist(), batch.mac.tolist(), batch.bfee_count.tolist(), csi, strict=True
        ):
            to = self._device_mac if mac == HUB_MAC else HUB_MAC
            frame = data_frame(mac, to, HUB_MAC, count, _PAYLOAD)
            out.append((t_s, record(FRAME_CODE, frame)))
            out.append((t_s, record(BFEE_CODE, body)))
        out += [
            (t_s, record(FRAME_CODE, frame))
            for t_s, frame in zip(batch.legacy_t_s.tolist(), batch.legacy_frames, strict=True)
        ]
        out.sort(key=lambda timed: timed[0])  # stable: a pair stays together
        return out

    def _block(self, block: int) -> RadioBatch:
        """The packets of one stretch of _BLOCK_SLOTS device slots, seeded by its own number."""
        rng = np.random.default_rng([self._seed, 0xB10C, block])
        start_slot = block * _BLOCK_SLOTS
        slots = np.arange(max(start_slot, self._first_slot), start_slot + _BLOCK_SLOTS)
        n = max(len(slots), 0)
        # The card needs a packet's air time between two: no two nearer than a tenth of a slot.
        link_t = (slots + rng.uniform(0.05, 0.95, _BLOCK_SLOTS)[_BLOCK_SLOTS - n :]) / self._rate_hz
        other_t = (start_slot + np.sort(rng.uniform(0, _BLOCK_SLOTS, _OTHERS_PER_BLOCK))) / self._rate_hz
        order = np.argsort(np.concatenate([link_t, other_t]), kind="stable")
        t_s = np.concatenate([link_t, other_t])[order]
        is_link = order < n

        channel = np.concatenate([self._link.response(link_t), self._other.response(other_t)])[order]
        floor = np.where(is_link, self._link.still_power, self._other.still_power)
        readings = self._nic.read(t_s, channel, floor, rng)
        seen_before = block * _OTHERS_PER_BLOCK + max(0, start_slot - self._first_slot)
        nic_us = np.rint((t_s * (1 + self._nic_ppm * 1e-6) + self._nic_start_s) * 1e6).astype(np.int64)
        rate = np.full(len(t_s), 0x100 | int(rng.integers(3, 8)), np.uint16)
        kept = np.flatnonzero(_survives(len(t_s), rng))
        legacy_t, legacy = _legacy(start_slot / self._rate_hz, _BLOCK_SLOTS / self._rate_hz, rng)
        return RadioBatch(
            t_s=t_s[kept],
            csi=readings.csi[kept],
            rssi=readings.rssi[kept],
            noise_dbm=np.full(len(kept), NOISE_DBM, np.int8),
            agc=readings.agc[kept],
            antenna_sel=readings.antenna_sel[kept],
            rate=rate[kept],
            bfee_count=((seen_before + kept) & 0xFFFF).astype(np.uint16),
            nic_us=(nic_us[kept] & 0xFFFF_FFFF).astype(np.uint32),
            mac=np.where(is_link, self._sender_mac, OTHER_MAC)[kept],
            legacy_t_s=legacy_t,
            legacy_frames=legacy,
        )


def _between(batch: RadioBatch, t0_s: float, t1_s: float) -> RadioBatch:
    a, b = np.searchsorted(batch.t_s, [t0_s, t1_s])
    c, d = np.searchsorted(batch.legacy_t_s, [t0_s, t1_s])
    return RadioBatch(
        **{name: getattr(batch, name)[a:b] for name in _PACKET_FIELDS},
        legacy_t_s=batch.legacy_t_s[c:d],
        legacy_frames=batch.legacy_frames[c:d],
    )


def _survives(n: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Which packets reach the reader: single losses and, now and then, a burst of them."""
    kept = rng.random(n) >= _LOSS
    if rng.random() < _BURSTS_PER_BLOCK:
        start, length = int(rng.integers(_BLOCK_SLOTS)), int(rng.integers(*_BURST_SLOTS))
        kept[start : start + length] = False
    return kept


def _legacy(t0_s: float, length_s: float, rng: np.random.Generator) -> tuple[FloatArray, tuple[bytes, ...]]:
    """Frames at legacy rates: beacons, data and acknowledgements of the network next door."""
    t_s = np.sort(rng.uniform(t0_s, t0_s + length_s, int(rng.poisson(_LEGACY_PER_S * length_s))))
    return t_s, tuple(_legacy_frame(int(rng.integers(3)), int(rng.integers(4096))) for _ in t_s)


def _legacy_frame(kind: int, sequence: int) -> bytes:
    neighbour = NEIGHBOUR_MAC.to_bytes(6, "big")
    seq = (sequence << 4).to_bytes(2, "little")
    if kind == 0:  # beacon
        head = (
            b"\x80\x00\x00\x00" + b"\xff" * 6 + neighbour + neighbour + seq + bytes(8) + b"\x64\x00\x01\x04"
        )
    elif kind == 1:  # data from that access point to everybody
        head = b"\x08\x02\x00\x00" + b"\xff" * 6 + neighbour + neighbour + seq + _PAYLOAD
    else:  # acknowledgement: it has no transmitter
        head = b"\xd4\x00\x00\x00" + neighbour
    return head + zlib.crc32(head).to_bytes(4, "little")
