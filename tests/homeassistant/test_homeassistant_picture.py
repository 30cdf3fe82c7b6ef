"""The map's picture: when it is drawn anew, and what becomes of one that cannot be drawn."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

from vad.bus import messages as m
from vad.errors import VadError
from vad.homeassistant.picture import draw, scene_of

PLAN = m.MapMessage(
    source="live", epoch=1, bounds_m=(0, 0, 3, 2), resolution_m=0.05, origin=(0, 0, 0), width=60, height=40
)


def scene(grid: bytes = b"", **changes: Any) -> bytes:
    fields: dict[str, Any] = {
        "source": "live",
        "mac": "f4:f5:d8:d3:35:b2",
        "state": "waiting",
        "x_m": 1.0,
        "y_m": 1.0,
    }
    camera = m.CameraMessage(source="live", id="main", state="collecting", percent=10.0)
    return scene_of(PLAN, grid, [m.DeviceMessage(**(fields | changes))], [camera])


@pytest.mark.parametrize(
    "changes",
    [
        {"last_seen": "2026-01-01T00:00:00Z"},
        {"published_at": "2026-01-01T00:00:00Z"},
        {"evidence": {"packets": 5000.0}},
        {"reason": "another walk makes it sharper"},
        {"state": "capturing"},
        {"ip": "10.0.0.7"},
    ],
)
def test_what_is_not_in_the_picture_does_not_change_it(changes: dict[str, Any]) -> None:
    assert scene(**changes) == scene()


@pytest.mark.parametrize(
    "changes", [{"x_m": 1.1}, {"name": "Lamp"}, {"state": "mapped"}, {"radius90_m": 0.4}, {"x_m": None}]
)
def test_what_is_in_the_picture_changes_it(changes: dict[str, Any]) -> None:
    assert scene(**changes) != scene()


async def test_no_process_is_no_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    with pytest.raises(VadError, match="cannot be drawn"):
        await draw(scene(), tmp_path)


@pytest.mark.slow
@pytest.mark.timeout(400)
async def test_a_damaged_plan_is_no_picture(tmp_path: Path) -> None:
    with pytest.raises(VadError, match="cannot be drawn"):
        await draw(scene(grid=b"no PNG"), tmp_path)
