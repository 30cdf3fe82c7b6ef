"""Pictures that carry a number as bright and dark stripes: survive JPEG, YUYV and half size.

`pictures.py FOLDER`, on the host, writes those that the emulated cameras send: the guest would take minutes.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

STRIPES = 10
KINDS = 64


def draw(k: int, width: int, height: int) -> NDArray[np.uint8]:
    row = np.array([230 if k >> bit & 1 else 20 for bit in range(STRIPES)], np.uint8)
    grey = cv2.resize(row[None, :], (width, height), interpolation=cv2.INTER_NEAREST)
    return np.repeat(grey[:, :, None], 3, axis=2)


def number(image: NDArray[np.uint8]) -> int:
    width = image.shape[1] // STRIPES * STRIPES
    means = image[::16, :width].reshape(-1, STRIPES, width // STRIPES * 3).mean((0, 2))
    return sum(int(mean > 128) << bit for bit, mean in enumerate(means))


if __name__ == "__main__":
    for kind, size in (("uvc", (640, 480)), ("kinect", (1920, 1080))):
        folder = Path(sys.argv[1]) / kind
        folder.mkdir()
        for k in range(KINDS):
            cv2.imwrite(str(folder / f"{k:03}.jpg"), draw(k, *size))
