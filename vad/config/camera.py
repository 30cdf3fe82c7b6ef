"""Settings of the camera: one class for each kind of source."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from vad.config.kinds import Id, Positive


class V4l2CameraSettings(msgspec.Struct, tag="v4l2", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A USB or built-in camera.

    device: /dev/video0 or, better, a name below /dev/v4l/by-id
    width_px: of its pictures
    height_px: of its pictures
    fps: pictures a second
    format: of the pixels; MJPG needs less of the USB, YUYV less of the processor
    """

    device: Annotated[str, Meta(examples=["/dev/video0"])]
    width_px: int = 640
    height_px: int = 480
    fps: Positive = 15.0
    format: Literal["MJPG", "YUYV"] = "MJPG"


class Kinect2CameraSettings(
    msgspec.Struct, tag="kinect2", frozen=True, forbid_unknown_fields=True, kw_only=True
):
    """The colour camera of a Kinect v2 on USB 3.

    serial: which, where there are several; left out: the first
    fraction: pictures of 1920x1080 divided by this
    fps: pictures a second that are decoded, of the 30 that come
    """

    serial: Annotated[str, Meta(examples=["012345678901"])] | None = None
    fraction: Literal[1, 2, 4] = 2
    fps: Positive = 15.0


class RtspCameraSettings(msgspec.Struct, tag="rtsp", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """An IP camera.

    url: rtsp://[user:password@]host[:port]/path, best of its small stream
    transport: udp where the camera knows no other
    """

    url: Annotated[str, Meta(examples=["rtsp://192.168.1.31:554/stream2"])]
    transport: Literal["tcp", "udp"] = "tcp"


class MjpegCameraSettings(msgspec.Struct, tag="mjpeg", frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A camera that serves MJPEG over HTTP (ustreamer, mjpg-streamer, ESP32-CAM, go2rtc).

    url: of the stream
    """

    url: Annotated[str, Meta(examples=["http://192.168.1.31:8080/stream"])]


class FolderCameraSettings(
    msgspec.Struct, tag="folder", frozen=True, forbid_unknown_fields=True, kw_only=True
):
    """Recorded pictures (a folder with times.csv) or a video file, played at their own times.

    path: of the folder or file
    """

    path: Annotated[str, Meta(examples=["/home/me/recording"])]


CameraSourceSettings = (
    V4l2CameraSettings
    | MjpegCameraSettings
    | RtspCameraSettings
    | Kinect2CameraSettings
    | FolderCameraSettings
)


class CameraSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The camera; its lens is estimated from the robot's drive unless intrinsics or focal_px is given.

    source: where its pictures come from
    id: its name on the bus
    intrinsics: a file that `vad camera intrinsics` wrote
    focal_px: focal length, if that alone is known
    """

    source: CameraSourceSettings
    id: Id = "main"
    intrinsics: Annotated[str, Meta(examples=["camera-lens.json"])] | None = None
    focal_px: Annotated[float, Meta(gt=0, examples=[615.0])] | None = None
