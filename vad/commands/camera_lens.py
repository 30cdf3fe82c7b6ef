"""`vad camera board`, `vad camera intrinsics`: a lens measured with a printed board."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer
from rich.live import Live
from rich.table import Table
from rich.text import Text

from vad.camera.board import MIN_PICTURES, Board, Kind, LensMeasurement, MeasuredLens
from vad.camera.folder import TIMES_FILE, Recording
from vad.camera.frame import Frame, FrameQueue
from vad.camera.lens_file import LensFile, write_lens
from vad.commands.console import EXIT_NOTHING, JsonOption, complain, out, print_json, reported_errors
from vad.commands.run import DEFAULT_CONFIG, ConfigOption
from vad.commands.signals import until_ended
from vad.config import load_settings
from vad.errors import SourceError, VadError

KindOption = Annotated[
    Kind, typer.Option("--board", help="charuco: may be cut off by the picture's edge; chess: must be whole.")
]
SquaresOption = Annotated[str, typer.Option("--squares", help="Squares across and down.", metavar="WxH")]
_STILL_S = 0.3
_SQUARE_PX = 120
_PICTURES = {".jpg", ".jpeg", ".png", ".bmp"}


def board(
    picture: Annotated[Path, typer.Argument(help="Where to write it, a PNG.", metavar="FILE.png")],
    kind: KindOption = "charuco",
    squares: SquaresOption = "8x6",
) -> None:
    """Write the board for printing. Its size does not matter; it must be flat: glue it to cardboard.

    Example:  vad camera board board.png

    Exit code 0: written; 2: it cannot be.
    """
    import cv2

    with reported_errors():
        drawn = _board(kind, squares).picture(_SQUARE_PX)
        if picture.suffix != ".png":
            raise VadError("the name does not end in .png", where=str(picture))
        _, data = cv2.imencode(".png", drawn)
        try:
            picture.write_bytes(data.tobytes())
        except OSError as error:
            raise VadError(f"cannot be written: {error.strerror}", where=str(picture)) from error
    out.print(Text(f"wrote {picture}: print it, glue it to something flat"), soft_wrap=True)


def intrinsics(
    recording: Annotated[
        Path | None,
        typer.Argument(
            help="A folder of pictures or a video of the board; left out: the camera of the settings, live.",
            metavar="[RECORDING]",
        ),
    ] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="The file to write.")] = Path("lens.yaml"),
    kind: KindOption = "charuco",
    squares: SquaresOption = "8x6",
    seconds: Annotated[
        float, typer.Option("--for", min=1.0, metavar="SECONDS", help="Live: give up after this long.")
    ] = 180.0,
    config: ConfigOption = DEFAULT_CONFIG,
    as_json: JsonOption = False,
) -> None:
    """Measure the lens with a board that is moved and tilted before the camera, all over the picture.

    Nobody has to: without it the lens is estimated from the robot's drive. With it the camera's place is
    several times better after one lap. Name the file in the settings:  camera: {intrinsics: lens.yaml}

    Examples:  vad camera board board.png; vad camera intrinsics --config vad.yaml -o lens.yaml
               vad camera intrinsics pictures/ --board chess --squares 10x7

    Exit code 0: measured and written; 1: the pictures do not suffice, and the line on standard error says
    what is missing; 2: something cannot be read or written.
    """
    with reported_errors():
        measurement = LensMeasurement(_board(kind, squares))
        if recording is not None:
            _from_recording(recording, measurement, quiet=as_json)
        else:
            settings = load_settings(config)
            watching = _live(settings.camera, config.resolve().parent, measurement, seconds, as_json)
            asyncio.run(until_ended(watching))
        if not as_json and not out.is_terminal:
            out.print()  # there the live table's last line is left open
        try:
            measured = measurement.solve()
        except ValueError as error:
            complain(str(error))
            raise typer.Exit(EXIT_NOTHING) from error
        _save(output, measured, measurement, as_json)


def _board(kind: Kind, squares: str) -> Board:
    columns, _, rows = squares.partition("x")
    try:
        return Board(kind, int(columns), int(rows))
    except ValueError as error:
        raise VadError("the squares are given like 8x6, 3 to 30 to each side", where="--squares") from error


def _add(measurement: LensMeasurement, frame: Frame, where: str) -> None:
    try:
        measurement.add(frame.image)
    except ValueError as error:
        raise SourceError(str(error), where=where) from error


def _from_recording(path: Path, measurement: LensMeasurement, *, quiet: bool) -> None:
    with contextlib.nullcontext() if quiet else Live(console=out, auto_refresh=False) as live:
        for frame in _frames(path):
            _add(measurement, frame, str(path))
            if live is not None:
                live.update(_table(measurement), refresh=True)
    if measurement.seen == 0:
        remedy = "are --board and --squares those of the board?"
        raise SourceError("the board is in none of the pictures", where=str(path), remedy=remedy)


def _frames(path: Path) -> Iterator[Frame]:
    """The frames of a recording; of a bare folder, every picture in it by name."""
    if not path.is_dir() or (path / TIMES_FILE).is_file():
        yield from Recording(path).frames()
        return
    import cv2
    import numpy as np

    names = sorted(p for p in path.iterdir() if p.suffix.lower() in _PICTURES)
    if not names:
        raise SourceError("there are no pictures in the folder", where=str(path))
    for seq, name in enumerate(names):
        image = cv2.imread(str(name), cv2.IMREAD_COLOR)
        if image is not None:
            yield Frame(seq, seq, np.asarray(image, dtype=np.uint8))


async def _live(
    camera_settings: object, base: Path, measurement: LensMeasurement, seconds: float, quiet: bool
) -> None:
    from vad.config import CameraSettings
    from vad.daemon.adapters import camera_source

    assert isinstance(camera_settings, CameraSettings)
    camera = camera_source(camera_settings, base)
    frames = FrameQueue(1)
    task = asyncio.create_task(camera.run(frames))
    ends_s = time.monotonic() + seconds
    try:
        with contextlib.nullcontext() if quiet else Live(console=out, auto_refresh=False) as live:
            while time.monotonic() < ends_s and measurement.missing() and not task.done():
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(_STILL_S):
                        frame = await frames.get()
                        await asyncio.to_thread(_add, measurement, frame, camera.health.part)
                if live is not None:
                    trouble = "" if camera.health.state == "ok" else camera.health.detail
                    live.update(_table(measurement, trouble), refresh=True)
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


def _table(measurement: LensMeasurement, trouble: str = "") -> Table:
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    table.add_row("pictures", f"{measurement.kept} of {MIN_PICTURES} ({measurement.seen} with the board)")
    table.add_row("covered", f"{measurement.covered():.0%} of the picture")
    if trouble:
        table.add_row("camera", Text(trouble, "red"))
    table.add_row("missing", measurement.missing() or Text("nothing", "green"))
    return table


def _save(output: Path, measured: MeasuredLens, measurement: LensMeasurement, as_json: bool) -> None:
    lens = measured.lens
    file = LensFile(
        width_px=lens.width_px,
        height_px=lens.height_px,
        fx_px=round(lens.fx_px, 3),
        fy_px=round(lens.fy_px, 3),
        cx_px=round(lens.cx_px, 3),
        cy_px=round(lens.cy_px, 3),
        k1=round(lens.k1, 6),
        k2=round(lens.k2, 6),
        focal_sigma_px=round(measured.focal_sigma_px, 3),
        error_px=round(measured.error_px, 3),
        pictures=measurement.kept,
    )
    try:
        write_lens(output, file)
    except OSError as error:
        raise VadError(f"cannot be written: {error.strerror}", where=str(output)) from error
    if as_json:
        print_json(file)
        return
    out.print(
        Text(
            f"focal length {lens.fx_px:.1f} ± {measured.focal_sigma_px:.1f} px, centre {lens.cx_px:.1f}, "
            f"{lens.cy_px:.1f}, k1 {lens.k1:+.3f}, k2 {lens.k2:+.3f}; corners {measured.error_px:.2f} px "
            f"off, {measurement.kept} pictures\n"
            f"wrote {output}; in the settings:  camera: {{intrinsics: {output}}}"
        ),
        soft_wrap=True,
    )
