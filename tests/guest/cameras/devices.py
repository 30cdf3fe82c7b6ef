"""A process that is one emulated USB camera: `devices.py uvc|kinect`; takes plug, unplug, sent as input."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from kinect import Kinect
from uvc import UvcCamera

FPS = 10.0


def main() -> None:
    kind = sys.argv[1]
    stored = [path.read_bytes() for path in sorted((Path(__file__).parent / kind).glob("*.jpg"))]

    def picture(k: int) -> bytes:
        return stored[k % len(stored)]

    device = UvcCamera(picture, 640, 480, FPS) if kind == "uvc" else Kinect(picture, FPS)
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
