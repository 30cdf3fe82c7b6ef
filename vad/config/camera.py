"""Settings of the camera: one class for each kind of source."""

from __future__ import annotations

from typing import Literal

import msgspec

from vad.config.kinds import Id, Positive


class V4l2CameraSettings(msgspec.Struct, tag="v4l2", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A USB or built-in camera. device: /dev/video0 or a /dev/v4l/by-id path; format: of the pixels, where
    the camera has both."""

    device: str
    width_px: int = 640
    height_px: int = 480
    fps: Positive = 15.0
    format: Literal["MJPG", "YUYV"] = "MJPG"


class Kinect2CameraSettings(
    msgspec.Struct, tag="kinect2", frozen=True, forbid_unknown_fields=True, kw_only=True
):
    """The colour camera of a Kinect v2 on USB 3. serial: which, where there are several; fraction: pictures
    of 1920x1080 divided by 1, 2 or 4; fps: pictures decoded, of the 30 that come."""

    serial: str | None = None
    fraction: Literal[1, 2, 4] = 2
    fps: Positive = 15.0


class RtspCameraSettings(msgspec.Struct, tag="rtsp", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """An IP camera. url: rtsp://[user:password@]host[:port]/path, best of its small stream."""

    url: str
    transport: Literal["tcp", "udp"] = "tcp"


class MjpegCameraSettings(msgspec.Struct, tag="mjpeg", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A camera that serves MJPEG over HTTP (ustreamer, mjpg-streamer, ESP32-CAM, go2rtc)."""

    url: str


class FolderCameraSettings(
    msgspec.Struct, tag="folder", frozen=True, forbid_unknown_fields=True, kw_only=True
):
    """Recorded pictures (a folder with times.csv) or a video file, played at their own times."""

    path: str


CameraSourceSettings = (
    V4l2CameraSettings
    | MjpegCameraSettings
    | RtspCameraSettings
    | Kinect2CameraSettings
    | FolderCameraSettings
)


class CameraSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The camera. id: its name on the bus. intrinsics: a file that `vad camera intrinsics` wrote; or
    focal_px, if that alone is known; with neither the lens is estimated from the robot's drive."""

    source: CameraSourceSettings
    id: Id = "main"
    intrinsics: str | None = None
    focal_px: Positive | None = None
