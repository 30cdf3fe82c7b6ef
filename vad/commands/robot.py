"""`vad robot watch`: what the robot says, live, without the daemon."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import math
import time
from collections import deque
from collections.abc import AsyncIterator
from typing import Annotated, Any

import typer
from rich.live import Live
from rich.table import Table
from rich.text import Text

from vad.commands.console import EXIT_NOTHING, JsonOption, complain, out, reported_errors
from vad.commands.run import DEFAULT_CONFIG, ConfigOption
from vad.config import Settings, ZenohRobot, load_settings
from vad.report.words import printable
from vad.robot.pose import MapSource, PoseSource, RobotPose
from vad.streams import DropOldestQueue

REFRESH_S = 0.25
RATE_OVER_S = 5.0

app = typer.Typer(help="The robot, without the daemon.", no_args_is_help=True)


@app.command()
def watch(
    config: ConfigOption = DEFAULT_CONFIG,
    seconds: Annotated[
        float | None, typer.Option("--for", min=0.1, metavar="SECONDS", help="Stop after this long.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Show where the robot is, how often and how late it says so, and what is wrong.

    It opens the robot itself: stop the daemon first where both would use one serial port.

    Example:  vad robot watch --config vad.yaml

    Exit code 0: poses came; 1: none came; 2: the settings cannot be used.
    """
    with reported_errors():
        settings = load_settings(config)
        watched = Watched()
        with contextlib.suppress(KeyboardInterrupt):
            asyncio.run(_watch(settings, watched, seconds, as_json))
    if not watched.count:
        complain(watched.trouble or "no pose came")
        raise typer.Exit(EXIT_NOTHING)


class Watched:
    """The last pose and how they come."""

    def __init__(self) -> None:
        self.count = 0
        self.last: RobotPose | None = None
        self.trouble = ""
        self._arrivals: deque[tuple[float, float]] = deque()

    def take(self, pose: RobotPose, now_ns: int) -> None:
        """A pose that is handed over at `now_ns`."""
        self.count += 1
        self.last = pose
        self._arrivals.append((now_ns / 1e9, (now_ns - pose.t_ns) / 1e6))

    def rate_hz(self, now_s: float) -> float:
        """Poses a second, over the last seconds."""
        while self._arrivals and now_s - self._arrivals[0][0] > RATE_OVER_S:
            self._arrivals.popleft()
        if len(self._arrivals) < 2:
            return 0.0
        return (len(self._arrivals) - 1) / max(self._arrivals[-1][0] - self._arrivals[0][0], 1e-3)

    def latency_ms(self) -> float | None:
        """From the pose's time to its arrival here, the median of the last seconds."""
        late = sorted(ms for _, ms in self._arrivals)
        return late[len(late) // 2] if late else None


@contextlib.asynccontextmanager
async def running_robot(
    settings: Settings, out_queue: DropOldestQueue[RobotPose]
) -> AsyncIterator[PoseSource]:
    """The settings' robot, running; a zenoh session of its own where the robot needs one."""
    from vad.bus.session import BusSettings, local_endpoints, open_session  # zenoh takes a while to import
    from vad.daemon.adapters import robot_source
    from vad.errors import VadError

    needs_router = isinstance(settings.robot, ZenohRobot) or (
        getattr(settings.robot, "endpoint", "") is None or getattr(settings.robot, "key", None) is not None
    )
    # What is wrong is shown; without a handler Python would print it, too.
    logging.getLogger("vad").addHandler(logging.NullHandler())
    local = local_endpoints(settings.bus.listen)
    try:
        # A running daemon is the router; without one we are, so that the robot finds one.
        session = open_session(BusSettings(mode="client", connect=local))
    except VadError:
        listen = local if needs_router else ()
        session = open_session(BusSettings(mode="router", listen=listen, connect=settings.bus.connect))
    try:
        robot = robot_source(settings, session)
        task = asyncio.create_task(robot.run(out_queue))
        try:
            yield robot
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
    finally:
        await asyncio.to_thread(session.close)


async def _watch(settings: Settings, watched: Watched, seconds: float | None, as_json: bool) -> None:
    poses: DropOldestQueue[RobotPose] = DropOldestQueue(256)
    async with running_robot(settings, poses) as robot:
        ends_s = math.inf if seconds is None else time.monotonic() + seconds
        with contextlib.nullcontext() if as_json else Live(console=out, auto_refresh=False) as live:
            while time.monotonic() < ends_s:
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(REFRESH_S):
                        pose = await poses.get()
                        watched.take(pose, time.monotonic_ns())
                        if as_json:
                            _print_line(pose, watched)
                for pose in [] if as_json else poses.drain():
                    watched.take(pose, time.monotonic_ns())
                watched.trouble = "" if robot.health.state == "ok" else robot.health.detail
                if live is not None:
                    live.update(_table(robot, watched), refresh=True)


def _print_line(pose: RobotPose, watched: Watched) -> None:
    line: dict[str, Any] = {
        "t_ns": pose.t_ns,
        "x_m": round(pose.x_m, 4),
        "y_m": round(pose.y_m, 4),
        "yaw_rad": round(pose.yaw_rad, 4),
        "sigma_m": round(pose.sigma_m, 4),
        "quality": pose.quality,
        "status": pose.status,
        "frame": pose.frame,
        "rate_hz": round(watched.rate_hz(time.monotonic()), 2),
    }
    out.print(json.dumps(line), markup=False, highlight=False, soft_wrap=True)


def _table(robot: PoseSource, watched: Watched) -> Table:
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    pose, health = watched.last, robot.health
    table.add_row("robot", printable(health.part))
    table.add_row("status", robot.status)
    if pose is not None:
        table.add_row(
            "pose", f"x {pose.x_m:7.3f} m  y {pose.y_m:7.3f} m  yaw {math.degrees(pose.yaw_rad):6.1f}°"
        )
        table.add_row("deviation", f"±{pose.sigma_m:.3f} m  ±{math.degrees(pose.sigma_yaw_rad):.1f}°")
        table.add_row("quality", f"{pose.quality}, frame {printable(pose.frame)}")
    late_ms = watched.latency_ms()
    late = "" if late_ms is None else f", {late_ms:.0f} ms old when it comes"
    table.add_row("rate", f"{watched.rate_hz(time.monotonic()):.1f} Hz{late}, {watched.count} in all")
    if isinstance(robot, MapSource):
        table.add_row("maps", str(health.counters["maps"]))
    style = "green" if health.state == "ok" else "yellow" if health.state == "starting" else "red"
    table.add_row(
        "now", Text(f"{health.state}: {printable(health.detail)}" if health.detail else health.state, style)
    )
    bad = health.counters["bad_input"]
    if bad:
        table.add_row("not understood", str(bad))
    return table
