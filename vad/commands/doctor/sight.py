"""The camera: is it there, may it be used, has it the format, how fast do pictures come, how dated."""

from __future__ import annotations

import asyncio
import contextlib
import time
from pathlib import Path
from typing import TYPE_CHECKING

from vad.commands.doctor.visit import Finding, Visit
from vad.config import FolderCameraSettings, Kinect2CameraSettings, V4l2CameraSettings
from vad.errors import VadError

if TYPE_CHECKING:
    from vad.camera.v4l2_formats import V4l2Description

MEASURE_S = 2.0
_REMEDY = "Is it on, and camera: source: right? Another program may have it: sudo fuser -v /dev/video*"
_SLOW = 0.6
"""Of the rate that was asked for."""
_FEW_FPS = 4.0
_BLACK = 6.0
"""Mean of a picture's pixels: a lens behind its cap."""


async def check_camera(visit: Visit) -> list[Finding]:
    """The camera of the settings; what the running daemon says of it, else by opening it."""
    source = visit.settings.camera.source
    if (part := visit.part("camera")) is not None:
        daemon = visit.part("daemon")
        rate = 0.0 if daemon is None else daemon.rates_per_s.get("frames", 0.0)
        if part.state != "ok":
            return [Finding.of_health("camera", part, _REMEDY)]
        return [Finding("camera", "ok", f"{rate:g} pictures a second; {part.detail}")]
    findings = []
    if isinstance(source, V4l2CameraSettings):
        findings = [*visit.refused("camera", Path(source.device), "rw"), *_formats(source)]
        if any(finding.verdict == "bad" for finding in findings):
            return findings
    return [*findings, *await _measured(visit)]


def _formats(source: V4l2CameraSettings) -> list[Finding]:
    """Whether the camera has what the settings ask for."""
    from vad.camera.v4l2_formats import describe

    try:
        description = describe(Path(source.device))
    except VadError as error:
        remedy = error.remedy or "Plug it in; `v4l2-ctl --list-devices` and /dev/v4l/by-id show what is there"
        return [Finding("camera", "bad", f"{error.where}: {error.what}", remedy)]
    if description is None:
        what = f"{source.device} is no camera but another device of one, e.g. for its settings"
        return [Finding("camera", "bad", what, "Take the camera's first device: see /dev/v4l/by-id/*index0")]
    return [format_finding(source, description)]


def format_finding(source: V4l2CameraSettings, description: V4l2Description) -> Finding:
    """Whether what the settings ask for is among what the camera offers."""
    from vad.camera.v4l2_formats import best_format

    offers = [
        f for f in description.formats if (f.width_px, f.height_px) == (source.width_px, source.height_px)
    ]
    wanted = f"{source.format} {source.width_px}x{source.height_px} at {source.fps:g}"
    same = [f for f in offers if f.fourcc == source.format]
    if any(not f.fps or max(f.fps) >= source.fps * 0.99 for f in same):
        return Finding("camera format", "ok", f"{description.card}: {wanted} is offered")
    best = best_format(
        description.formats, width_px=source.width_px, height_px=source.height_px, fps=source.fps
    )
    if best is None:
        what = f"{description.card} offers neither MJPG nor YUYV"
        return Finding("camera format", "bad", what, "Another camera is needed: any UVC webcam will do")
    rate = min(max(best.fps, default=source.fps), source.fps)
    values = f"format: {best.fourcc}, width_px: {best.width_px}, height_px: {best.height_px}, fps: {rate:g}"
    remedy = f"Set camera: source: {{{values}}}"
    return Finding("camera format", "warning", f"{description.card} does not offer {wanted}", remedy)


async def _measured(visit: Visit) -> list[Finding]:
    """Open the camera and count pictures."""
    from vad.camera.frame import FrameQueue
    from vad.daemon.adapters import camera_source

    try:
        camera = camera_source(visit.settings.camera, visit.config_file.parent)
    except VadError as error:
        return [Finding.of_error("camera", error)]
    frames = FrameQueue(4)
    task = asyncio.create_task(camera.run(frames))
    try:
        async with asyncio.timeout(visit.listen_s):
            first = await frames.get()
        begun, begun_s = frames.accepted, time.monotonic()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(MEASURE_S):
                await asyncio.wait({task})
        rate = (frames.accepted - begun) / (time.monotonic() - begun_s)
    except TimeoutError:
        if camera.health.state in ("degraded", "failed"):
            return [Finding.of_health("camera", camera.health, _REMEDY)]
        what = f"no picture came in {visit.listen_s:g} s"
        return [Finding("camera", "bad", what, _REMEDY)]
    finally:
        task.cancel()
        await asyncio.wait({task})
    told = f"{rate:.1f} pictures a second; {camera.health.detail}"
    return [_rate(visit, rate, told), *_looks(visit, float(first.image.mean()), camera.health.detail)]


def _rate(visit: Visit, rate: float, told: str) -> Finding:
    source = visit.settings.camera.source
    if isinstance(source, FolderCameraSettings):
        return Finding("camera", "ok", told)
    asked = source.fps if isinstance(source, V4l2CameraSettings | Kinect2CameraSettings) else None
    if asked is not None and rate < _SLOW * asked:
        remedy = (
            "More light, or no automatic exposure: v4l2-ctl -d DEVICE -c exposure_dynamic_framerate=0; "
            "another USB port where the cable is shared"
        )
        return Finding("camera", "warning", f"{told}; {asked:g} were asked for", remedy)
    if rate < _FEW_FPS:
        return Finding(
            "camera", "warning", told, "Set the camera itself, or the way to it, to 5 a second or more"
        )
    return Finding("camera", "ok", told)


def _looks(visit: Visit, brightness: float, detail: str) -> list[Finding]:
    findings = []
    if brightness < _BLACK:
        what = "its pictures are black"
        findings.append(
            Finding("camera picture", "warning", what, "Take off its cap, or switch on the light")
        )
    if isinstance(visit.settings.camera.source, V4l2CameraSettings) and "stamps: arrival" in detail:
        what = "its driver does not say when a picture was taken: when it comes is what counts"
        remedy = "Plug it into a port of its own; if that stays so, take another camera (UVC)"
        findings.append(Finding("camera picture", "warning", what, remedy))
    return findings
