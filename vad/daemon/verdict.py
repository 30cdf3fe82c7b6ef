"""What the walks so far make of a device: mapped, or what is still wanted."""

from __future__ import annotations

from vad.config import CaptureSettings
from vad.mapping.device_stage import PlaceEstimate
from vad.mapping.posterior import Posterior
from vad.robot.floor_plan import FloorPlan

STAYS_MAPPED = 1.5
"""A mapped device is one until its region is this much larger than what made it one."""
SURE_OF_ROOM = 0.9
NEGLIGIBLE = 1e-6
"""Cells below this share do not decide a room."""


def verdict(
    limits: CaptureSettings,
    plan: FloorPlan,
    place: PlaceEstimate,
    walks: int,
    posterior: Posterior,
    *,
    was_mapped: bool,
) -> tuple[str, str]:
    """State and reason after `walks` walks. Where walks of this kind do not make it sharp, a sure room is an
    answer, too."""
    enough_m = limits.mapped_radius_m * (STAYS_MAPPED if was_mapped else 1.0)
    located = place.status == "located"
    if located and place.radius90_m <= enough_m and walks >= limits.min_walks:
        return "mapped", ""
    if walks < limits.max_walks:
        return "waiting", another_walk(place.radius90_m, walks)
    size = _size(place.radius90_m, walks)
    room, share = _likeliest_room(plan, posterior)
    if located and room == plan.room_at(*place.xy_m.tolist()) and share >= SURE_OF_ROOM:
        return "mapped", f"{size}: the room is sure to {share:.0%}, more walks of this kind do not tell"
    return "failed", f"{size}: more walks of this kind do not tell; walk elsewhere in the picture"


def another_walk(radius90_m: float, walks: int) -> str:
    """What a device waits for that is known, and not sharply enough."""
    return f"{_size(radius90_m, walks)}; another walk through the picture makes it sharper"


def _likeliest_room(plan: FloorPlan, posterior: Posterior) -> tuple[str | None, float]:
    """The room with the largest share of the posterior, and that share."""
    shares: dict[str, float] = {}
    for (x_m, y_m), p in zip(posterior.grid.points_m, posterior.probability.ravel(), strict=True):
        if p > NEGLIGIBLE and (room := plan.room_at(x_m, y_m)) is not None:
            shares[room] = shares.get(room, 0.0) + float(p)
    return max(shares.items(), key=lambda item: item[1], default=(None, 0.0))


def _size(radius90_m: float, walks: int) -> str:
    return f"±{radius90_m:.1f} m after {walks} walk{'s' if walks > 1 else ''}"
