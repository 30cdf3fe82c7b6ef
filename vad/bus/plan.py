"""The message of a floor plan's frame and rooms; its cells go out as a picture (vad.bus.grid)."""

from __future__ import annotations

from vad.bus.messages import MapMessage, Room, Source
from vad.robot.floor_plan import FloorPlan


def map_message(plan: FloorPlan, source: Source) -> MapMessage:
    """What `map` says of a plan."""
    rows, columns = plan.cells.shape
    return MapMessage(
        source=source,
        epoch=plan.epoch,
        bounds_m=plan.bounds_m,
        resolution_m=plan.resolution_m,
        origin=plan.origin,
        width=columns,
        height=rows,
        rooms=tuple(
            Room(name=room.name, polygon_m=tuple((float(x), float(y)) for x, y in room.polygon))
            for room in plan.rooms
        ),
    )
