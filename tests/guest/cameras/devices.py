"""A process that is one emulated USB camera: `devices.py uvc|kinect`; takes plug, unplug, sent as input."""

from __future__ import annotations

import json
import sys

from kinect import Kinect
from pictures import jpegs
from uvc import UvcCamera

FPS = 10.0


def main() -> None:
    uvc = sys.argv[1] == "uvc"
    stored = jpegs(640, 480) if uvc else jpegs(1920, 1080)[:64]

    def picture(k: int) -> bytes:
        return stored[k % len(stored)]

    device = UvcCamera(picture, 640, 480, FPS) if uvc else Kinect(picture, FPS)
    sys.stdout.write("{}\n")
    sys.stdout.flush()
    for line in sys.stdin:
        if line.strip() == "plug":
            device.plug()
        elif line.strip() == "unplug":
            device.unplug()
        sys.stdout.write(json.dumps({"sent": device.sent, "kinds": len(stored)}) + "\n")
        sys.stdout.flush()


main()
