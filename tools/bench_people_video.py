"""Real pedestrians: the tracks in vtest.avi, as a table and as a picture.

The footage is view 1 of PETS 2009's S2.L1 (University of Reading), which OpenCV ships among its samples and
Debian in opencv-doc; it is no part of this project. Its camera is calibrated: the published Tsai model.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from vad.geometry import Intrinsics, Rigid
from vad.vision.body import Camera
from vad.vision.path import smooth
from vad.vision.people import PoseNetwork
from vad.vision.standing import Standing, standing
from vad.vision.tracks import Track, Tracker
from vad.vision.watch import PeopleWatch

FPS = 7.0
"""As recorded; the file's header says 10."""
INPUT_SIZE = (480, 640)
MIN_POINTS = 20
_TINTS = 11

# The published calibration: focal length and pixel in mm, first radial term (raw to straight), angles, mm.
_FOCAL, _PIXEL_X, _PIXEL_Y, _SCALE_X = 5.5549183034, 0.0051273271277, 0.00465, 1.0937855397
_KAPPA, _CENTRE = 0.0051113043639, (324.22149053, 282.56650051)
_ANGLES = (2.0405458695, -0.89337703748, -0.43056124791)
_SHIFT_MM = (828.73214225, -3175.4796051, 35469.298547)


def pets_camera() -> Camera:
    """View 1; its map is the ground plane of PETS 2009, metres."""
    (sa, sb, sg), (ca, cb, cg) = np.sin(_ANGLES), np.cos(_ANGLES)
    rotation = np.array(
        [
            [cb * cg, cg * sa * sb - ca * sg, sa * sg + ca * cg * sb],
            [cb * sg, sa * sb * sg + ca * cg, ca * sb * sg - cg * sa],
            [-sb, cb * sa, ca * cb],
        ]
    )
    fx, fy = _FOCAL * _SCALE_X / _PIXEL_X, _FOCAL / _PIXEL_Y
    # Tsai's term takes raw to straight, ours straight to raw: to first order its negative.
    lens = Intrinsics(768, 576, fx, fy, *_CENTRE, k1=-_KAPPA * _FOCAL**2)
    return Camera(lens, Rigid(rotation, np.array(_SHIFT_MM) / 1000.0))


def follow_video(console: Console, path: str, frames: int, picture: str | None) -> int:
    """Follow the pedestrians of the first `frames`; 2 where the video cannot be read."""
    capture, camera = cv2.VideoCapture(path), pets_camera()
    watch, tracker = PeopleWatch(PoseNetwork(input_size=INPUT_SIZE)), Tracker()
    tracks: dict[int, Track] = {}
    image: NDArray[np.uint8] | None = None
    for k in range(frames):
        ok, frame = capture.read()
        if not ok:
            break
        image, t_ns = np.asarray(frame, dtype=np.uint8), int(k / FPS * 1e9)
        look = watch.look(image, t_ns)
        if not look.looked:
            continue
        found = [standing(person, image, camera) for person in look.people]
        seen = [place for place in found if isinstance(place, Standing)]
        tracker.update(t_ns, seen)
        tracks |= {track.id: track for track in tracker.tracks()}
    if image is None:
        console.print(f"{path} cannot be read: apt-get install opencv-doc brings vtest.avi")
        return 2
    long = [track for track in tracks.values() if len(track.t_ns) >= MIN_POINTS]
    table = Table(title=f"{len(long)} tracks of {MIN_POINTS} pictures or more in {k + 1} pictures")
    for name in ("track", "pictures", "seen in", "way, m", "mean speed, m/s"):
        table.add_column(name, justify="right")
    for track in long:
        spans = (track.t_ns[[0, -1]] * 1e-9 * FPS).round().astype(int)
        way = float(np.linalg.norm(np.diff(track.xy_m[::7], axis=0), axis=1).sum())
        lasted = max(float(np.ptp(track.t_ns)) * 1e-9, 1e-9)
        share = len(track.t_ns) / (spans[1] - spans[0] + 1)
        table.add_row(
            str(track.id), f"{spans[0]}-{spans[1]}", f"{share:.0%}", f"{way:.1f}", f"{way / lasted:.2f}"
        )
    console.print(table)
    if picture is not None:
        cv2.imwrite(picture, draw(image, long, camera))
        console.print(f"drawn into {Path(picture).name}")
    return 0


def draw(image: NDArray[np.uint8], tracks: list[Track], camera: Camera) -> NDArray[np.uint8]:
    """The tracks' smooth paths on a picture, each with its number where it ends."""
    canvas = image.copy()
    for track in tracks:
        hue = np.uint8([[[(track.id * 180 // _TINTS * 4) % 180, 230, 255]]])
        tint = tuple(int(v) for v in cv2.cvtColor(hue, cv2.COLOR_HSV2BGR)[0, 0])
        path = smooth(track, camera)
        on_floor = np.column_stack([path.xy_m, np.zeros(len(path.xy_m))])
        px = camera.pixels(on_floor).round().astype(np.int32)
        cv2.polylines(canvas, [px], False, tint, 2, cv2.LINE_AA)
        end = (int(px[-1, 0]) + 4, int(px[-1, 1]) - 6)
        cv2.putText(canvas, str(track.id), end, cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 4, cv2.LINE_AA)
        cv2.putText(canvas, str(track.id), end, cv2.FONT_HERSHEY_SIMPLEX, 0.6, tint, 2, cv2.LINE_AA)
    return canvas
