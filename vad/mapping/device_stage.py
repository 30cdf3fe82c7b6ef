"""The Wi-Fi stage as a whole: one walk's CSI and track -> the device's posterior, or a reason why not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vad.mapping.doppler_likelihood import SPEED_OF_LIGHT_MPS, DopplerModel, doppler_posterior
from vad.mapping.paper import THRESHOLD_OFFICE_M, algorithm_1
from vad.mapping.posterior import Grid, Posterior
from vad.mapping.walk import WalkTrack
from vad.sensing.path_length import PathLength, path_length
from vad.sensing.spectrogram import Spectrogram, spectrogram_from_csi

FloatArray = NDArray[np.float64]

MIN_OVERLAP_S = 3.0
MIN_PACKETS_PER_S = 60.0
"""Below this, walking Doppler (up to 30 Hz at 5 GHz) cannot be told from its alias."""

MIN_WALK_M = 2.0
MIN_BREADTH_M = 0.25
"""A straighter walk leaves the device's mirror image as likely as the device."""

WALK_CORRELATION = 0.25
"""Chosen on the plain-room recordings so that the 90 % region of 2 to 6 walks keeps its word."""

MAX_RADIUS90_M = 2.5
"""A wider 90 % region is no place."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """What one walk says of the device.

    status: `located`; `uncertain` (a region too wide or double: shown, not to be trusted as a point);
    `refused` (nothing can be said: posterior is None). reason: one sentence unless located.
    """

    status: str
    reason: str
    posterior: Posterior | None
    spectrogram: Spectrogram | None
    path: PathLength | None


@dataclass(frozen=True, slots=True)
class PlaceEstimate:
    """Where the device is, from a posterior. xy_m (2,), covariance_m2 (2, 2), map frame."""

    status: str
    reason: str
    xy_m: FloatArray
    covariance_m2: FloatArray
    radius90_m: float
    region90_m: list[FloatArray]


def _refused(reason: str, spectrogram: Spectrogram | None = None) -> Evidence:
    return Evidence("refused", reason, None, spectrogram, None)


def evidence_from_walk(
    t_ns: NDArray[np.int64],
    csi: NDArray[np.complex64],
    walk: WalkTrack,
    anchor_m: FloatArray,
    grid: Grid,
    *,
    carrier_hz: float,
    anchor_z_m: float | None = None,
    model: DopplerModel | None = None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Evidence:
    """Solve one walk.

    t_ns (N,) strictly increasing; csi complex (N, 30, R, T); anchor_m (2,) the known end, map frame.
    """
    reason = _unusable(t_ns, csi, walk)
    if reason:
        return _refused(reason)
    spectrogram = spectrogram_from_csi(t_ns, csi)
    if should_stop():
        return _refused("stopped before the end", spectrogram)
    path = path_length(spectrogram, wavelength_m=SPEED_OF_LIGHT_MPS / carrier_hz)
    posterior = doppler_posterior(
        spectrogram,
        walk,
        anchor_m,
        grid,
        carrier_hz=carrier_hz,
        anchor_z_m=anchor_z_m,
        model=model,
        should_stop=should_stop,
    )
    if posterior is None:
        return _refused("stopped before the end", spectrogram)
    if walk.breadth_m < MIN_BREADTH_M:
        return Evidence(
            "uncertain", "the walk was straight: a mirror image remains", posterior, spectrogram, path
        )
    place = place_from_posterior(posterior)
    return Evidence(place.status, place.reason, posterior, spectrogram, path)


def place_from_posterior(posterior: Posterior) -> PlaceEstimate:
    """The point, its covariance and 90 % region, and whether they make a place."""
    xy_m, covariance = posterior.mean_and_covariance()
    radius = posterior.radius_m(0.9)
    status, reason = "located", ""
    if radius > MAX_RADIUS90_M:
        status, reason = (
            "uncertain",
            f"the 90 % region is {radius:.1f} m wide in radius: more walks are needed",
        )
    return PlaceEstimate(status, reason, xy_m, covariance, radius, posterior.region_polygons_m(0.9))


def joint_posterior(product: Posterior, walks: int) -> Posterior:
    """The posterior from the product of `walks` walks' posteriors.

    Walks through one room share their multipath and the walker's ways, so n walks count as
    n / (1 + (n - 1) WALK_CORRELATION) independent ones.
    """
    return product.tempered(1 / (1 + (walks - 1) * WALK_CORRELATION))


def paper_estimate(
    path: PathLength,
    walk: WalkTrack,
    anchor_m: FloatArray,
    grid: Grid,
    *,
    threshold_m: float = THRESHOLD_OFFICE_M,
) -> FloatArray:
    """The paper's Algorithm 1 on the integrated path length change, at 10 instants a second; (2,) m."""
    inside = np.flatnonzero(walk.covers(path.t_ns))[::2]
    answer, _ = algorithm_1(
        path.plc_m[inside], walk.position_m(path.t_ns[inside]), anchor_m, grid, threshold_m=threshold_m
    )
    return answer


def _unusable(t_ns: NDArray[np.int64], csi: NDArray[np.complex64], walk: WalkTrack) -> str:
    """Why these data cannot be solved; empty when they can."""
    if len(t_ns) < 2 or len(walk.t_ns) < 2:
        return "no CSI packets" if len(t_ns) < 2 else "the walk has fewer than two points"
    if csi.shape[2] < 2:
        return "one receive antenna only; two or more are needed to remove the radio's phase noise"
    start, end = max(t_ns[0], walk.t_ns[0]), min(t_ns[-1], walk.t_ns[-1])
    overlap_s = (end - start) / 1e9
    if overlap_s < MIN_OVERLAP_S:
        return f"walk and CSI overlap in {max(0.0, overlap_s):.1f} s only; {MIN_OVERLAP_S:.0f} s are needed"
    rate = np.count_nonzero((t_ns >= start) & (t_ns <= end)) / overlap_s
    if rate < MIN_PACKETS_PER_S:
        return f"{rate:.0f} packets/s are too few; {MIN_PACKETS_PER_S:.0f} are needed"
    if walk.length_m < MIN_WALK_M:
        return f"the walker moved {walk.length_m:.1f} m only; {MIN_WALK_M:.0f} m are needed"
    return ""
