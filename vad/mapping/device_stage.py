"""The Wi-Fi stage as a whole: one walk's CSI and track -> the device's posterior, or a reason why not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vad.mapping.arrival_likelihood import arrival_sums
from vad.mapping.doppler_likelihood import SPEED_OF_LIGHT_MPS, DopplerModel, log_heard
from vad.mapping.doppler_search import OFFSETS_S, DopplerSearch
from vad.mapping.evidence import Terms
from vad.mapping.height import height_log_likelihood
from vad.mapping.loudness import loudness_log_likelihood
from vad.mapping.paper import THRESHOLD_OFFICE_M, algorithm_1
from vad.mapping.posterior import Grid, Posterior
from vad.mapping.walk import WalkTrack
from vad.sensing.arrival import ArrivalPhases, arrival_phases
from vad.sensing.path_length import PathLength, path_length
from vad.sensing.resample import antenna_ratio, to_uniform
from vad.sensing.spectrogram import Spectrogram, combined, spectrogram
from vad.sensing.template import moving_part

FloatArray = NDArray[np.float64]

MIN_OVERLAP_S = 3.0
MIN_PACKETS_PER_S = 60.0
"""Below this, walking Doppler (up to 30 Hz at 5 GHz) cannot be told from its alias."""

MIN_WALK_M = 2.0
MIN_BREADTH_M = 0.25
"""A straighter walk leaves the device's mirror image as likely as the device."""

SOLVE_STEP_M = 0.2
"""Likelihoods are computed this finely and interpolated: no region is sharper than a few such steps."""

MAX_RADIUS90_M = 2.5
"""A wider 90 % region is no place."""


ArrayEnd = Literal["device", "anchor"]
"""Which end of the link has the receive antennas: the unknown one (the paper's layout) or the known one."""


@dataclass(frozen=True, slots=True)
class Recording:
    """What one walk left behind.

    t_ns (N,) strictly increasing; csi complex (N, 30, R, T); anchor_m (2,) the known end, map frame, its
    height anchor_z_m where known; array_end: whose antennas the R rows are.
    """

    t_ns: NDArray[np.int64]
    csi: NDArray[np.complex64]
    walk: WalkTrack
    anchor_m: FloatArray
    anchor_z_m: float | None = None
    carrier_hz: float = 5.24e9
    bandwidth_mhz: int = 20
    array_end: ArrayEnd = "device"

    @property
    def wavelength_m(self) -> float:
        """Of the carrier."""
        return SPEED_OF_LIGHT_MPS / self.carrier_hz


@dataclass(frozen=True, slots=True)
class Evidence:
    """What one walk says of the device.

    status: `located`; `uncertain` (a region too wide or double: shown, not to be trusted as a point);
    `refused` (nothing can be said: posterior and terms are None). reason: one sentence unless located.
    """

    status: str
    reason: str
    posterior: Posterior | None
    terms: Terms | None
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
    return Evidence("refused", reason, None, None, spectrogram, None)


def evidence_from_walk(
    recording: Recording,
    grid: Grid,
    *,
    model: DopplerModel | None = None,
    offsets_s: tuple[float, ...] = OFFSETS_S,
    should_stop: Callable[[], bool] = lambda: False,
) -> Evidence:
    """Solve one walk: Doppler of the whole spectrogram; where the device has the antennas, their phases.

    offsets_s: by how much the walk's stamps may be early.
    """
    reason = _unusable(recording)
    if reason:
        return _refused(reason)
    walk, wavelength_m = recording.walk, recording.wavelength_m
    moving = moving_part(recording.csi, bandwidth_mhz=recording.bandwidth_mhz)
    aligned = to_uniform(recording.t_ns, moving.reshape(len(moving), -1))
    spectra = spectrogram(aligned)
    antennas = recording.csi.shape[2]
    if antennas > 1:
        ratio = to_uniform(recording.t_ns, antenna_ratio(recording.csi))
        spectra = combined(spectrogram(ratio), spectra)
    if should_stop():
        return _refused("stopped before the end", spectra)
    path = path_length(spectra, wavelength_m=wavelength_m)
    phases = None
    if antennas > 1 and recording.array_end == "device":
        phases = arrival_phases(aligned, antennas, spectra.t_ns, path.f_hz)
    search = DopplerSearch(
        spectra,
        walk,
        recording.anchor_m,
        wavelength_m,
        recording.anchor_z_m,
        model or DopplerModel(),
        should_stop,
    )
    terms = _terms(search, phases, grid, offsets_s)
    if terms is None:
        return _refused("stopped before the end", spectra)
    posterior = terms.posterior(grid)
    if walk.breadth_m < MIN_BREADTH_M:
        return Evidence(
            "uncertain", "the walk was straight: a mirror image remains", posterior, terms, spectra, path
        )
    place = place_from_posterior(posterior)
    return Evidence(place.status, place.reason, posterior, terms, spectra, path)


def _terms(
    search: DopplerSearch, phases: ArrivalPhases | None, bounds: Grid, offsets_s: tuple[float, ...]
) -> Terms | None:
    """The evidence over the extent of `bounds`; None when asked to stop."""
    offset_s = search.time_offset_s(bounds, offsets_s)
    if offset_s is None:
        return None
    grid = Grid.over(bounds.bounds_m, max(SOLVE_STEP_M, bounds.step_m))
    doppler = search.over(grid, offset_s)
    if doppler is None:
        return None
    points, walk = grid.points_m, search.walk.later(offset_s)
    sums = None
    if phases is not None:
        sums = arrival_sums(phases, walk, points, wavelength_m=search.wavelength_m)
    loudness = loudness_log_likelihood(
        search.spectra, walk, search.anchor_m, points, anchor_z_m=search.anchor_z_m
    )
    terms = Terms(grid, 1, doppler + loudness, log_heard(points, walk), sums)
    height = height_log_likelihood(search, points, terms.log_density(), doppler, offset_s)
    return replace(terms, height=height)


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


def _unusable(recording: Recording) -> str:
    """Why these data cannot be solved; empty when they can."""
    t_ns, walk = recording.t_ns, recording.walk
    if len(t_ns) < 2:
        return "no CSI packets"
    if len(walk.t_ns) < 2:
        return "the walk has fewer than two points"
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
