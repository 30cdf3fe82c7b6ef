"""The floor plan as a picture, drawn by a process of its own.

So matplotlib's memory and its seconds of work stay out of the daemon.

    input    a Scene, JSON
    output   a PNG

Run as a program it draws one picture and ends.
"""

from __future__ import annotations

import asyncio
import io
import os
import sys
from collections.abc import Iterable
from pathlib import Path

import msgspec

from vad.bus import messages as m
from vad.child import end_child
from vad.errors import VadError

NICE = 5
TIMEOUT_S = 300.0
"""Two seconds of work is what it takes, but all others go first: on a busy hub that may be minutes, and what
is given up begins anew."""


class Scene(msgspec.Struct, frozen=True):
    """What is drawn; grid: the occupancy grid's PNG (vad.bus.grid), empty where there is none."""

    plan: m.MapMessage
    grid: bytes
    devices: tuple[m.DeviceMessage, ...]
    cameras: tuple[m.CameraMessage, ...]


def scene_of(
    plan: m.MapMessage, grid: bytes, devices: Iterable[m.DeviceMessage], cameras: Iterable[m.CameraMessage]
) -> bytes:
    """A Scene as JSON that changes only where the picture does."""
    drawn = [
        m.DeviceMessage(
            source=device.source,
            mac=device.mac,
            name=device.name,
            state="waiting" if device.state == "capturing" else device.state,
            reason="" if device.x_m is not None else device.reason,
            x_m=device.x_m,
            y_m=device.y_m,
            covariance_m2=device.covariance_m2,
            radius90_m=device.radius90_m,
            region90=device.region90,
        )
        for device in sorted(devices, key=lambda device: device.mac)
    ]
    seen = [
        m.CameraMessage(
            source=camera.source,
            id=camera.id,
            state="valid",
            position_m=camera.position_m,
            map_from_camera=camera.map_from_camera,
        )
        for camera in cameras
    ]
    return msgspec.json.encode(Scene(plan, grid, tuple(drawn), tuple(seen)))


async def draw(scene: bytes, cache: Path) -> bytes:
    """The PNG of a Scene; VadError where it cannot be drawn. cache: a folder for a list of fonts."""
    try:
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "vad.homeassistant.picture",
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1", "MPLCONFIGDIR": str(cache)},
            start_new_session=True,
        )
    except OSError as error:
        raise VadError(f"the map's picture cannot be drawn ({error.strerror})") from error
    try:
        async with asyncio.timeout(TIMEOUT_S):
            png, _ = await process.communicate(scene)
    except TimeoutError as error:
        raise VadError("the map's picture takes too long to draw") from error
    finally:
        await end_child(process)
    if process.returncode != 0 or not png:
        raise VadError("the map's picture cannot be drawn", remedy="The log says more")
    return png


def main() -> None:
    """Draw what is on standard input."""
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever a library prints is no picture
    os.nice(NICE)
    from vad.bus.grid import png_to_grid
    from vad.report.floor import DPI, PAPER, Floor, draw_floor

    scene = msgspec.json.decode(sys.stdin.buffer.read(), type=Scene)
    grid = png_to_grid(scene.grid) if scene.grid else None
    figure = draw_floor(Floor(scene.plan, grid, scene.devices, scene.cameras))
    png = io.BytesIO()
    figure.savefig(png, format="png", dpi=DPI, facecolor=PAPER)
    answer.write(png.getvalue())
    answer.flush()


if __name__ == "__main__":
    main()
