"""A lens from pictures of a board: ChArUco or chessboard corners, Zhang's method (OpenCV). No I/O.

Pictures come one by one; those that show the board from a new side are kept. The lens is refused where two
radial terms do not describe it or where the board was not shown all over the picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from vad.geometry import Intrinsics

Kind = Literal["charuco", "chess"]

MIN_PICTURES = 10
MAX_PICTURES = 60
MAX_ERROR_PX = 1.0
"""A greater error, in pictures 640 wide: a lens that bends in another way, or a board that is not flat."""

_MIN_CORNERS = 8
_GRID = 4
_MIN_CELLS = 0.6
# A view is new where a corner of the board has gone this share of the picture's width.
_NEW_VIEW = 0.05
_MARKER_PER_SQUARE = 0.75
_FLAGS = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3

FloatArray = NDArray[np.float64]
Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Board:
    """columns, rows: squares (not inner corners) across and down."""

    kind: Kind = "charuco"
    columns: int = 8
    rows: int = 6

    def __post_init__(self) -> None:
        if not (3 <= self.columns <= 30 and 3 <= self.rows <= 30):
            raise ValueError("a board has 3 to 30 squares to each side")

    def picture(self, square_px: int) -> Image:
        """The board for printing, with a white margin of half a square."""
        margin = square_px // 2
        size = (self.columns * square_px + 2 * margin, self.rows * square_px + 2 * margin)
        if self.kind == "charuco":
            return np.asarray(self._charuco().generateImage(size, marginSize=margin), dtype=np.uint8)
        x, y = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        squares = np.where((x + y) % 2 == 0, 0, 255).astype(np.uint8)
        drawn = squares.repeat(square_px, axis=0).repeat(square_px, axis=1)
        return np.asarray(np.pad(drawn, margin, constant_values=255), dtype=np.uint8)

    def corners(self, image: Image) -> tuple[FloatArray, FloatArray] | None:
        """Corners in a picture: on the board (N, 2), squares, and in the picture (N, 2), pixels; or None."""
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image)
        if self.kind == "charuco":
            board = self._charuco()
            points, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(grey)
            if ids is None or len(ids) < _MIN_CORNERS:
                return None
            on_board = np.asarray(board.getChessboardCorners())[ids.ravel(), :2]
        else:
            inner = (self.columns - 1, self.rows - 1)
            found, points = cv2.findChessboardCornersSB(grey, inner, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
            if not found:
                return None
            x, y = np.meshgrid(np.arange(inner[0]), np.arange(inner[1]))
            on_board = np.column_stack([x.ravel(), y.ravel()])
        return np.asarray(on_board, dtype=np.float64), np.asarray(points, dtype=np.float64).reshape(-1, 2)

    def _charuco(self) -> cv2.aruco.CharucoBoard:
        count = self.columns * self.rows // 2
        size = cv2.aruco.DICT_4X4_50 if count <= 50 else cv2.aruco.DICT_4X4_1000
        words = cv2.aruco.getPredefinedDictionary(size)
        return cv2.aruco.CharucoBoard((self.columns, self.rows), 1.0, _MARKER_PER_SQUARE, words)


@dataclass(frozen=True, slots=True)
class MeasuredLens:
    """focal_sigma_px: one standard deviation; error_px: rms distance of the corners from the lens's."""

    lens: Intrinsics
    focal_sigma_px: float
    error_px: float


class LensMeasurement:
    """Collects pictures of a board and solves for the lens.

    Attributes:
        seen: pictures in which the board was found; kept: those that showed it from a new side.
    """

    def __init__(self, board: Board) -> None:
        self.seen = 0
        self._board = board
        self._size: tuple[int, int] | None = None
        self._views: list[tuple[FloatArray, FloatArray]] = []

    @property
    def kept(self) -> int:
        """Pictures that are used."""
        return len(self._views)

    def add(self, image: Image) -> bool:
        """Take a picture; True when it showed the board from a new side.

        Raises:
            ValueError: the picture has another size than those before.
        """
        size = image.shape[1], image.shape[0]
        if self._size is None:
            self._size = size
        if size != self._size:
            raise ValueError(f"pictures of {self._size[0]}x{self._size[1]} and of {size[0]}x{size[1]}")
        found = self._board.corners(image)
        if found is None:
            return False
        self.seen += 1
        if self.kept >= MAX_PICTURES or not self._is_new(found):
            return False
        self._views.append(found)
        return True

    def covered(self) -> float:
        """Share of the picture's cells in which corners have been seen."""
        return float(np.mean(self._cells())) if self._views else 0.0

    def missing(self) -> str:
        """What is still missing, a sentence for people; empty when it is enough."""
        if self.kept < MIN_PICTURES:
            return f"{self.kept} of {MIN_PICTURES} pictures from different sides: move and tilt the board"
        if self.covered() < _MIN_CELLS:
            cells = self._cells()
            parts = {
                "left": cells[:, 0].mean(),
                "right": cells[:, -1].mean(),
                "top": cells[0].mean(),
                "bottom": cells[-1].mean(),
            }
            where = min(parts, key=lambda part: float(parts[part]))
            return f"the board was seen in {self.covered():.0%} of the picture: show it at the {where} edge"
        return ""

    def solve(self) -> MeasuredLens:
        """The lens.

        Raises:
            ValueError: it does not fit, or something is missing; the message says what to do.
        """
        if self._size is None or (missing := self.missing()):
            raise ValueError(missing if self._size is not None else "there was no picture")
        flat = [np.column_stack([p, np.zeros(len(p))]).astype(np.float32) for p, _ in self._views]
        seen = [px.astype(np.float32)[:, None] for _, px in self._views]
        start = np.array(
            [[self._size[0], 0, self._size[0] / 2], [0, self._size[0], self._size[1] / 2], [0, 0, 1]]
        )
        error_px, k, bent, _, _, doubt, _, _ = cv2.calibrateCameraExtended(
            flat, seen, self._size, start.astype(np.float64), np.zeros(5), flags=_FLAGS
        )
        terms = np.asarray(bent, dtype=np.float64).ravel()
        lens = Intrinsics(
            *self._size,
            fx_px=float(k[0, 0]),
            fy_px=float(k[1, 1]),
            cx_px=float(k[0, 2]),
            cy_px=float(k[1, 2]),
            k1=float(terms[0]),
            k2=float(terms[1]),
        )
        if not error_px <= MAX_ERROR_PX * max(1.0, self._size[0] / 640):
            raise ValueError(
                f"the corners are {error_px:.1f} px off: the board is not flat, its squares are not as said, "
                "or the lens (a fish-eye?) needs more than two radial terms"
            )
        return MeasuredLens(lens, float(np.asarray(doubt).ravel()[0]), float(error_px))

    def _cells(self) -> NDArray[np.bool_]:
        assert self._size is not None
        px = np.concatenate([view[1] for view in self._views])
        column, row = np.clip((_GRID * px / self._size).astype(int), 0, _GRID - 1).T
        cells = np.zeros((_GRID, _GRID), dtype=np.bool_)
        cells[row, column] = True
        return cells

    def _is_new(self, found: tuple[FloatArray, FloatArray]) -> bool:
        assert self._size is not None
        corners = {(float(x), float(y)): px for (x, y), px in zip(*found, strict=True)}
        for on_board, px in self._views:
            way = [
                np.linalg.norm(corners[key] - there)
                for (x, y), there in zip(on_board.tolist(), px, strict=True)
                if (key := (x, y)) in corners
            ]
            if way and max(way) < _NEW_VIEW * self._size[0]:
                return False
        return True
