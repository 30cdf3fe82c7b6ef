#!/usr/bin/env python3
"""A simulated week in a home with twelve devices: who is measured when, mapped, found to be moved, or mute.

Schedule, registry, store, session folders with their quota, estimator and log of decisions are the daemon's
own; time, people, what the camera makes of them and the radio are simulated.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
from dataclasses import dataclass
from datetime import datetime

import msgspec
import numpy as np
from bench_week_sim import Week, simulate
from rich.console import Console
from rich.table import Table

from vad.csi.heard import NOT_HEARD
from vad.sim.household import DAY_S


@dataclass(frozen=True, slots=True)
class Row:
    """One device at the end. error_m: None where it has no place."""

    name: str
    true_room: str | None
    room: str | None
    state: str
    reason: str
    error_m: float | None
    radius90_m: float | None
    walks: int
    mapped_h: float | None
    moved_h: float | None
    answers: bool

    @property
    def right(self) -> bool:
        """Mapped in the room where it stands; for a mute one: not mapped and explained."""
        if not self.answers:
            return self.state not in ("mapped", "failed") and NOT_HEARD in self.reason
        return self.state == "mapped" and self.room == self.true_room


def rows_of(week: Week) -> list[Row]:
    """Each device against the truth, at the end."""
    end_s = week.days * DAY_S
    rows = []
    for device in week.house.devices:
        told = week.records.get(device.mac)
        if told is None:
            continue
        x_m, y_m, _ = device.place_m(end_s)
        error_m = None
        if told.x_m is not None and told.y_m is not None:
            error_m = float(np.hypot(told.x_m - x_m, told.y_m - y_m))
        mapped_s, moved_s = week.first("mapped", device.mac), week.first("moved", device.mac)
        rows.append(
            Row(
                device.name,
                week.house.room_of(device, end_s),
                told.room,
                told.state,
                told.reason,
                error_m,
                told.radius90_m,
                told.walks,
                None if mapped_s is None else (mapped_s - device.joined_s) / 3600,
                None if moved_s is None else (moved_s - device.places_m[-1][0]) / 3600,
                device.answers,
            )
        )
    return rows


def table_of(rows: list[Row]) -> Table:
    """The devices at the end."""
    table = Table(title="After the week (simulated)", title_justify="left", box=None)
    for column in (
        "device",
        "stands in",
        "mapped in",
        "state",
        "error m",
        "±90 % m",
        "walks",
        "mapped after",
    ):
        table.add_column(
            column, justify="left" if column.endswith("in") or column in ("device", "state") else "right"
        )
    table.add_column("remark", overflow="fold")
    for row in rows:
        remark = row.reason
        if row.moved_h is not None:
            remark = f"moved: noticed after {row.moved_h:.1f} h. {remark}"
        table.add_row(
            row.name,
            row.true_room or "–",
            row.room or "–",
            row.state if row.right else f"{row.state} (!)",
            "–" if row.error_m is None else f"{row.error_m:.2f}",
            "–" if row.radius90_m is None else f"{row.radius90_m:.2f}",
            str(row.walks),
            "–" if row.mapped_h is None else f"{row.mapped_h:.1f} h",
            remark,
        )
    return table


def summary_of(week: Week, rows: list[Row]) -> dict[str, object]:
    """The week in figures."""
    reachable = [row for row in rows if row.answers]
    moved = [week.house.devices[k].name for k, d in enumerate(week.house.devices) if len(d.places_m) > 1]
    errors = sorted(row.error_m for row in reachable if row.error_m is not None)
    return {
        "seed": week.house.home.seed,
        "days": week.days,
        "crossings": sum(v.walk.start_s < week.days * DAY_S for v in week.house.visits),
        "walks recorded": week.walks,
        "crossings unused": week.unused,
        "sessions solved": week.solved,
        "walks void": week.void,
        "reachable devices": len(reachable),
        "mapped in the right room": sum(row.right for row in reachable),
        "median error m": round(errors[len(errors) // 2], 2) if errors else None,
        "moved": moved,
        "moved noticed": [row.name for row in rows if row.moved_h is not None],
        "mute explained": all(row.right for row in rows if not row.answers),
        "provoked airtime s": round(week.airtime_s, 1),
        "sessions deleted by the quota": week.removed,
        "decisions": len(week.decisions),
    }


def main() -> None:
    options = argparse.ArgumentParser(prog="tools/bench week", description=__doc__)
    options.add_argument("--seed", type=int, default=3, help="which household")
    options.add_argument("--days", type=int, default=7)
    options.add_argument("--story", action="store_true", help="print the log of decisions, too")
    options.add_argument("--json", action="store_true", dest="as_json")
    given = options.parse_args()
    logging.basicConfig(level=logging.WARNING)
    week = simulate(given.seed, days=given.days)
    rows = rows_of(week)
    summary = summary_of(week, rows)
    console = Console(width=150)
    if given.as_json:
        plain = {"summary": summary, "devices": [msgspec.to_builtins(row) for row in rows]}
        print(json.dumps(plain, indent=1))
    else:
        if given.story:
            for decision in week.decisions:
                at = datetime.fromisoformat(decision.at)
                console.print(f"{at:%a %H:%M}  {decision.text}", highlight=False, soft_wrap=True)
        console.print(table_of(rows))
        for name, value in summary.items():
            console.print(f"{name}: {value}", highlight=False)
    sys.exit(0 if all(row.right for row in rows) else 1)


if __name__ == "__main__":
    main()
