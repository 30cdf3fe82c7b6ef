"""What is kept, as plain values; the store knows nothing of the bus."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Covariance = tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True, slots=True)
class Estimate:
    """Where a device is: map frame of `epoch`, metres; region90: outline of the 90 % region; height90_m:
    lowest and highest above the floor, where that is told."""

    x_m: float
    y_m: float
    covariance_m2: Covariance
    radius90_m: float
    region90: tuple[tuple[float, float], ...] = ()
    room: str | None = None
    method: str = ""
    height90_m: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class DeviceRecord:
    """One device. discovered_at, updated_at: RFC 3339 UTC; evidence: named counts."""

    mac: str
    state: str
    discovered_at: str
    updated_at: str
    name: str | None = None
    reason: str = ""
    epoch: int = 0
    walks: int = 0
    evidence: dict[str, float] = field(default_factory=dict)
    estimate: Estimate | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PosteriorRecord:
    """What walks say of a device all over the map: vad.mapping.evidence.Terms, kept.

    log_posterior, log_heard: (rows, columns) float32, natural logarithm, row 0 at y0; log_heard None: it is
    in log_posterior. bounds_m: x0, y0, x1, y1 of the outer cell edges. step_m: the cells' side. walks: how
    many walks it holds. height: log-likelihoods of heights, None where none was told.
    """

    mac: str
    epoch: int
    bounds_m: tuple[float, float, float, float]
    step_m: float
    walks: int
    log_posterior: NDArray[np.float32]
    updated_at: str
    log_heard: NDArray[np.float32] | None = None
    height: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class CameraRecord:
    """A camera's calibration in the map of `epoch`: a JSON object whose meaning is the mapping's."""

    id: str
    epoch: int
    calibration: dict[str, Any]
    updated_at: str


@dataclass(frozen=True, slots=True)
class EpochRecord:
    """A map the home had; fingerprint: what tells it from another."""

    epoch: int
    fingerprint: str
    since: str


@dataclass(frozen=True, slots=True)
class HistoryRecord:
    """What was said of a device from `at` (wall time of the writing) on; no coordinates: it had none."""

    mac: str
    at: str
    state: str
    epoch: int
    x_m: float | None = None
    y_m: float | None = None
    radius90_m: float | None = None
    name: str | None = None
    room: str | None = None
    walks: int = 0
    covariance_m2: Covariance | None = None


@dataclass(frozen=True, slots=True)
class PastRecord:
    """What is known of a device at a time that has passed.

    said: what was said of it then; None where that is not kept any more, for history is bounded. kept_since:
    when the oldest entry that is kept was written; None where there is none.
    """

    mac: str
    said: HistoryRecord | None
    kept_since: str | None


@dataclass(frozen=True, slots=True)
class AgentRecord:
    """A remote CSI node the hub has met. info: a JSON object whose meaning is the agent's part's."""

    id: str
    info: dict[str, Any]
    first_seen: str
    last_seen: str
