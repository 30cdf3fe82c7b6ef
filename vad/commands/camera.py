"""`vad camera`: where the camera is, calibrated and checked by the robot's drive, without the daemon."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.live import Live
from rich.text import Text

from vad.commands.camera_lens import board, intrinsics
from vad.commands.camera_tables import check_json, check_table, progress_table, result_json, rows_of
from vad.commands.console import (
    EXIT_NOTHING,
    JsonOption,
    complain,
    out,
    print_json,
    reported_errors,
)
from vad.commands.robot import running_robot
from vad.commands.run import DEFAULT_CONFIG, ConfigOption
from vad.commands.signals import until_ended
from vad.config import Settings, load_settings, resolve
from vad.errors import VadError
from vad.streams import DropOldestQueue

if TYPE_CHECKING:  # cv2 and onnxruntime take a second to import
    from vad.daemon.eyes import Eyes
    from vad.mapping.camera_calibration import CameraCalibration, Deviations
    from vad.robot.floor_plan import FloorPlan

REFRESH_S = 1.0
# A valid calibration and a robot that rests so long: it has come home.
_RESTS_S = 8.0
MIN_CHECK_PAIRS = 30

app = typer.Typer(
    help="The camera: its lens, where it is, and whether that is still right.", no_args_is_help=True
)
app.command()(board)
app.command()(intrinsics)

SecondsOption = Annotated[
    float | None, typer.Option("--for", min=1.0, metavar="SECONDS", help="End after this long.")
]
PictureOption = Annotated[
    Path | None,
    typer.Option(
        help="Write the camera's picture with the plan's grid, walls, the robot's path and the deviations.",
        metavar="FILE.png",
    ),
]


@dataclass(slots=True)
class Session:
    """What a drive before the camera gives."""

    plan: FloorPlan
    eyes: Eyes
    trouble: str = ""
    rested_s: float = 0.0


@app.command()
def calibrate(
    config: ConfigOption = DEFAULT_CONFIG,
    seconds: SecondsOption = None,
    picture: PictureOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find out where the camera is while the robot drives where the camera sees it, and keep it.

    Start it, then let the robot clean the room. It shows how far it is and what is missing, and ends when
    the robot rests after the calibration has become valid, or with Ctrl-C. The daemon does the same by
    itself; stop it first where both would use one device. It takes the result over at its next start.

    Example:  vad camera calibrate --config vad.yaml --picture camera.png

    Exit code 0: valid and kept; 1: not, and the line on standard error says what is missing; 2: the settings
    or a device cannot be used.
    """
    with reported_errors():
        settings = load_settings(config)
        session, drive = _drive(settings, config.resolve(), seconds, picture, as_json=as_json, known=False)
        found = session.eyes.calibration
        if found.status != "valid":
            if as_json:
                print_json(result_json(found))
            complain(session.trouble or found.reason)
            raise typer.Exit(EXIT_NOTHING)
        asyncio.run(_keep(settings, config.resolve(), session.plan.epoch, found))
        if as_json:
            print_json(result_json(found))
            return
        if drive is not None:
            out.print(check_table(rows_of(drive, found)))
        out.print(Text("kept; the daemon uses it from its next start on", "green"))


@app.command()
def check(
    config: ConfigOption = DEFAULT_CONFIG,
    limit_m: Annotated[
        float, typer.Option("--limit", min=0.001, help="Mean deviation up to which it is right, metres.")
    ] = 0.06,
    seconds: SecondsOption = None,
    picture: PictureOption = None,
    as_json: JsonOption = False,
) -> None:
    """Drive again and compare: where the robot says it is, where the camera sees it.

    The kept calibration is not changed. It ends when the robot rests after a drive, or with Ctrl-C.

    Example:  vad camera check --config vad.yaml --picture check.png

    Exit code 0: robot and camera agree; 1: they do not, or the robot was seen too little to tell; 2: the
    settings or a device cannot be used, or nothing was calibrated yet.
    """
    with reported_errors():
        settings = load_settings(config)
        session, drive = _drive(settings, config.resolve(), seconds, picture, as_json=as_json, known=True)
        pairs = 0 if drive is None else len(drive.robot_m)
        if drive is None or pairs < MIN_CHECK_PAIRS:
            why = f"the robot was seen {pairs} times where it should be, {MIN_CHECK_PAIRS} are needed"
            complain(session.trouble or session.eyes.calibration.reason or why)
            raise typer.Exit(EXIT_NOTHING)
        rows = rows_of(drive, session.eyes.calibration)
        right = rows[0].mean_m <= limit_m and drive.agreeing >= 0.5
        if as_json:
            print_json(check_json(rows, drive.agreeing, right=right))
        else:
            out.print(check_table(rows))
            seen = f"{drive.agreeing:.0%} of the pictures show the robot where it should be"
            out.print(Text(f"{seen}: {'the camera is right' if right else 'the camera is not right'}"))
        if not right:
            complain("let the robot drive and run `vad camera calibrate`; has the camera been moved?")
            raise typer.Exit(EXIT_NOTHING)


def _drive(
    settings: Settings,
    config_file: Path,
    seconds: float | None,
    picture: Path | None,
    *,
    as_json: bool,
    known: bool,
) -> tuple[Session, Deviations | None]:
    """Watch one drive. known: against the kept calibration, else from nothing."""
    if picture is not None and picture.suffix != ".png":
        raise VadError("the name does not end in .png", where=str(picture))
    started: list[Session] = []
    watching = _watch(settings, config_file, seconds, started, quiet=as_json, known=known)
    asyncio.run(until_ended(watching))
    if not started:
        raise VadError("ended before the robot's map came")
    session = started[0]
    drive = session.eyes.deviations()
    if picture is not None and session.eyes.last_image is not None:
        _save_picture(picture, session, drive)
    return session, drive


async def _watch(
    settings: Settings,
    config_file: Path,
    seconds: float | None,
    started: list[Session],
    *,
    quiet: bool,
    known: bool,
) -> None:
    from vad.camera.frame import FrameQueue
    from vad.camera.lens_file import camera_lens
    from vad.daemon.adapters import camera_source, robot_finder
    from vad.daemon.eyes import Eyes
    from vad.daemon.floor import FloorKeeper, first_plan
    from vad.robot.map_server import load_floor_plan
    from vad.robot.pose import RobotPose
    from vad.vision.people import PoseNetwork

    logging.getLogger("vad").addHandler(logging.NullHandler())
    base, begun_s = config_file.parent, time.monotonic()
    ends_s = math.inf if seconds is None else begun_s + seconds
    camera = camera_source(settings.camera, base)
    lens = camera_lens(settings.camera, base)
    model = resolve(settings.vision.model, config_file) if settings.vision.model else None
    network = PoseNetwork(model, threads=settings.vision.threads)
    of_file = None
    if settings.map.file is not None:
        of_file = load_floor_plan(resolve(settings.map.file, config_file), epoch=settings.map.epoch)
    poses: DropOldestQueue[RobotPose] = DropOldestQueue(256)
    frames = FrameQueue(2)
    async with running_robot(settings, poses) as robot:
        keeper = FloorKeeper(resolve(settings.state_dir, config_file) / "plans", ())
        with contextlib.nullcontext() if quiet else Live(console=out, auto_refresh=False) as live:

            def say(what: Any) -> None:
                if live is not None:
                    live.update(what, refresh=True)

            plan, _ = await first_plan(keeper, of_file, robot, lambda r: say(Text(_waiting(r.health.detail))))
            before = await _kept(settings, config_file, plan.epoch)
            if known and before is None:
                raise VadError(
                    "the camera has not been calibrated on this map",
                    where=settings.camera.id,
                    remedy="run `vad camera calibrate`, or the daemon, while the robot drives",
                )
            eyes = Eyes(
                network,
                max_fps=settings.vision.max_fps,
                focal_px=settings.camera.focal_px,
                lens=lens,
                known=before if known else None,
                on_calibration=lambda _: None,
                finder=robot_finder(settings.vision, base),
                fixed=known,
            )
            session = Session(plan, eyes)
            started.append(session)
            tasks = [
                asyncio.create_task(work)
                for work in (camera.run(frames), eyes.follow_robot(poses), eyes.run(frames))
            ]
            try:
                while time.monotonic() < ends_s and not _is_over(session, known):
                    await asyncio.sleep(REFRESH_S)
                    for task in tasks[1:]:
                        if task.done():
                            task.result()
                    parts = (("robot", robot.health), ("camera", camera.health))
                    bad = [f"{name}: {h.detail}" for name, h in parts if h.state in ("degraded", "failed")]
                    session.trouble = "; ".join(bad)
                    say(
                        progress_table(
                            eyes.calibration, session.trouble, eyes.deviations() if known else None
                        )
                    )
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)
    if not quiet and not out.is_terminal:
        out.print()  # there the live table's last line is left open


def _waiting(detail: str) -> str:
    return f"waiting for the robot's map{': ' + detail if detail else ''}"


def _is_over(session: Session, known: bool) -> bool:
    """Whether the robot has come to rest after the drive that was wanted."""
    eyes = session.eyes
    if eyes.robot_moves or not eyes.frames:
        session.rested_s = 0.0
        return False
    session.rested_s += REFRESH_S
    enough = eyes.calibration.status == "valid"
    if known:
        drive = eyes.deviations() if enough and session.rested_s > _RESTS_S else None
        enough = drive is not None and len(drive.robot_m) >= MIN_CHECK_PAIRS
    return enough and session.rested_s > _RESTS_S


async def _kept(settings: Settings, config_file: Path, epoch: int) -> CameraCalibration | None:
    from vad.daemon.eyes import known_calibration
    from vad.store.worker import StoreWorker

    async with StoreWorker(resolve(settings.state_dir, config_file) / "vad.sqlite") as store:
        for record in await store.cameras(epoch):
            if record.id == settings.camera.id:
                return known_calibration(record.calibration)
    return None


async def _keep(settings: Settings, config_file: Path, epoch: int, found: CameraCalibration) -> None:
    from vad.store.records import CameraRecord, EpochRecord
    from vad.store.worker import StoreWorker

    now = datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
    async with StoreWorker(resolve(settings.state_dir, config_file) / "vad.sqlite") as store:
        await store.save_epoch(EpochRecord(epoch, "", now))
        await store.save_camera(CameraRecord(settings.camera.id, epoch, found.to_dict(), now))


def _save_picture(path: Path, session: Session, drive: Deviations | None) -> None:
    import cv2
    import numpy as np

    from vad.report.camera_overlay import draw_overlay

    found, image = session.eyes.calibration, session.eyes.last_image
    assert image is not None
    if found.camera_from_map is None:
        return
    walls = session.plan.map_from_cell(np.argwhere(session.plan.cells >= 65))
    off_m = found.deviation_m
    if drive is not None and len(drive.robot_m):
        off_m = float(np.mean(np.linalg.norm(drive.camera_m - drive.robot_m, axis=1)))
    lines = [] if off_m is None else [f"robot and camera differ by {100 * off_m:.1f} cm on average"]
    drawn = draw_overlay(
        image,
        found,
        walls_m=walls,
        path_m=None if drive is None else drive.path_m,
        found_px=None if drive is None else drive.image_px[::4],
        robot_m=None if drive is None else drive.robot_m[::4],
        errors=True,
        lines=lines,
    )
    _, data = cv2.imencode(".png", drawn)
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise VadError(f"cannot be written: {error.strerror}", where=str(path)) from error
