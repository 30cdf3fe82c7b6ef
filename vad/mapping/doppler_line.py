"""The Doppler line that a walk predicts for a candidate place, and how far the true one may be from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vad.mapping.walk import SeenWalk, WalkTrack

FloatArray = NDArray[np.float64]

_TINY_M2 = 1e-4


@dataclass(frozen=True, slots=True)
class LineModel:
    """Means and standard deviations (`_sd`) of what is not known of a walker.

    kappa: share of the walker's speed that shows; surface_m: from the body's axis to what reflects, towards
    the bisector of both directions; torso_z_m: height of what reflects; the ends' squared heights above or
    below it where they are not known (`unknown_*`), the device's where only the anchor's is known.
    late_sd_s: of the track's stamps, beside what is searched for; smoothing_s: half-width of the Hann window
    over the track. track_share: how much of the track's stated slow error is believed, for `track_corr_s`
    (tracks are smoother than their errors are large); clutter_hz, clutter_s: what limbs and ghosts by way of
    the walls do to the ridge, and for how long.
    """

    kappa: float = 0.957
    kappa_sd: float = 0.03
    surface_m: float = 0.1
    surface_sd_m: float = 0.06
    torso_z_m: float = 0.95
    anchor_sd_m2: float = 0.15
    device_m2: float = 0.3
    device_sd_m2: float = 0.2
    unknown_anchor_m2: float = 1.0
    unknown_device_m2: float = 0.6
    late_sd_s: float = 0.02
    smoothing_s: float = 0.3
    track_share: float = 0.8
    track_corr_s: float = 1.0
    clutter_hz: float = 0.9
    clutter_s: float = 0.4


@dataclass(frozen=True, slots=True)
class PredictedLines:
    """f_hz (G, F): the line of each candidate; covariance_hz2 (G, F, F): of the true line around it."""

    f_hz: FloatArray
    covariance_hz2: FloatArray


@dataclass(frozen=True, slots=True)
class _Paths:
    """One instant's paths: to the anchor (F,), to the candidates (F, G); gradient (F, G, 2) of their sum."""

    anchor_m: FloatArray
    device_m: FloatArray
    gradient: FloatArray

    @property
    def bisector(self) -> FloatArray:
        """(F, G): length of the gradient: 2 where both ends are in one direction, 0 between them."""
        return np.asarray(np.sqrt((self.gradient**2).sum(axis=-1) + _TINY_M2))


def predicted_lines(
    points_m: FloatArray,
    seen: SeenWalk,
    anchor_m: FloatArray,
    *,
    wavelength_m: float,
    anchor_z_m: float | None,
    model: LineModel,
) -> PredictedLines:
    """The lines for candidates points_m (G, 2), map frame, at the F instants of `seen`."""
    known = anchor_z_m is not None
    anchor_m2 = (anchor_z_m - model.torso_z_m) ** 2 if anchor_z_m is not None else model.unknown_anchor_m2
    device_m2 = model.device_m2 if known else model.unknown_device_m2

    def paths(places_m: FloatArray) -> _Paths:
        to_anchor, to_device = places_m - anchor_m, places_m[:, None] - points_m[None]
        anchor = np.sqrt((to_anchor**2).sum(axis=1) + anchor_m2 + _TINY_M2)
        device = np.sqrt((to_device**2).sum(axis=-1) + device_m2 + _TINY_M2)
        gradient = (to_anchor / anchor[:, None])[:, None] + to_device / device[..., None]
        return _Paths(anchor, device, gradient)

    ahead, behind = paths(seen.ahead_m), paths(seen.behind_m)
    per_metre = -1 / (wavelength_m * seen.base_s)  # from metres over the base to hertz
    rate = ((ahead.anchor_m - behind.anchor_m)[:, None] + ahead.device_m - behind.device_m) * per_metre
    surface = (ahead.bisector - behind.bisector) * per_metre
    line = model.kappa * (rate - model.surface_m * surface)
    higher_anchor = (0.5 / ahead.anchor_m - 0.5 / behind.anchor_m)[:, None] * np.full_like(rate, per_metre)
    higher_device = (0.5 / ahead.device_m - 0.5 / behind.device_m) * per_metre
    later = np.gradient(line, seen.t_s, axis=0) if len(line) > 1 else np.zeros_like(line)
    unknowns = np.stack(
        [
            model.kappa_sd * rate,
            model.surface_sd_m * surface,
            model.anchor_sd_m2 * higher_anchor,
            model.device_sd_m2 * higher_device,
            model.late_sd_s * later,
        ]
    ).transpose(2, 1, 0)
    track = seen.velocity_covariance(model.track_share, model.track_corr_s)
    lag_s = np.abs(seen.t_s[:, None] - seen.t_s[None])
    clutter = model.clutter_hz**2 * np.exp(-lag_s / model.clutter_s) + 1e-3 * np.eye(len(lag_s))
    # As for ends in directions square to each other: with each candidate's own gradient, candidates whose
    # paths hardly change would be favoured wherever the track is better than it says.
    covariance = 2 / wavelength_m**2 * track + clutter
    covariance = covariance[None] + np.matmul(unknowns, unknowns.transpose(0, 2, 1))
    return PredictedLines(np.ascontiguousarray(line.T), covariance)


def predicted_doppler_hz(
    points_m: FloatArray,
    walk: WalkTrack,
    anchor_m: FloatArray,
    t_ns: NDArray[np.int64],
    *,
    wavelength_m: float,
    anchor_z_m: float | None = None,
    model: LineModel | None = None,
) -> FloatArray:
    """The line of each candidate points_m (G, 2) at times t_ns (F,): (F, G) Hz."""
    model = model or LineModel()
    seen = walk.seen_at(t_ns, model.smoothing_s)
    lines = predicted_lines(
        points_m, seen, anchor_m, wavelength_m=wavelength_m, anchor_z_m=anchor_z_m, model=model
    )
    return np.asarray(lines.f_hz.T)
