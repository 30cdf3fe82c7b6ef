"""Where an old floor plan lies on a new one: rotation, translation and flip, a score, or a refusal. Pure.

Both plans become the outline of their free floor. Every angle (3 degrees apart, both ways up) is tried by
correlating the outlines with an FFT; the best places are refined on the distance field of the new outline,
and judged by how much of either outline lies on the other and how much floor agrees. A plan that fits
equally well in two places is refused: what hangs on it would be moved to a wrong place with confidence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

FREE_UP_TO = 19
OCCUPIED_FROM = 65
SPECK_CELLS = 6
"""Smaller parts are dirt: legs of chairs, single misread cells."""
ANGLE_STEP_RAD = math.radians(3.0)
COARSE_M = 0.15
COARSE_CELLS = 200
"""A plan is made coarser where it would have more cells a side than this."""
CANDIDATES = 12
APART_M = 0.5
APART_RAD = math.radians(8.0)
REFINE_STEPS = 40
OUTLIER_M = 0.4
MAX_POINTS = 4000
TOLERANCE_M = 0.1
"""An outline's point that is nearer to the other outline than this lies on it (two cells)."""
MIN_OVERLAP = 0.5
MIN_SCORE = 0.65
"""Different homes reach 0.60, one robot's maps of one home 0.85 and more, two robots' 0.60 to 0.79
(all pairs of 33 recorded maps)."""
AMBIGUOUS = 0.93
MIN_OUTLINE_M = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class Occupancy:
    """cells: (rows, cols) int8, row 0 lowest, -1 unknown, 0 free to 100 occupied; origin: x_m, y_m, yaw_rad
    of the corner of cell (0, 0) in the plan's frame."""

    cells: NDArray[np.int8]
    resolution_m: float
    origin: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class PlanTransform:
    """new = R(angle_rad) (x, -y if flipped) + (x_m, y_m): from the old plan's frame to the new one's."""

    angle_rad: float = 0.0
    x_m: float = 0.0
    y_m: float = 0.0
    flipped: bool = False

    @property
    def matrix(self) -> FloatArray:
        """(2, 2): the rotation, with the flip before it."""
        c, s = math.cos(self.angle_rad), math.sin(self.angle_rad)
        return np.array([[c, -s], [s, c]]) @ np.diag([1.0, -1.0 if self.flipped else 1.0])

    def apply(self, points_m: FloatArray) -> FloatArray:
        """(N, 2) points of the old frame in the new one."""
        moved: FloatArray = points_m @ self.matrix.T + (self.x_m, self.y_m)
        return moved

    def inverse_apply(self, points_m: FloatArray) -> FloatArray:
        """(N, 2) points of the new frame in the old one."""
        moved: FloatArray = (points_m - (self.x_m, self.y_m)) @ self.matrix
        return moved


IDENTITY = PlanTransform()


@dataclass(frozen=True, slots=True)
class Agreement:
    """How well two plans fit under a transform, all from 0 to 1.

    outline: the smaller share of either outline, where the other plan knows the floor, that lies on the
    other's; floor: free floor common to both, of the free floor where both know; overlap: how much of the
    smaller plan's free floor the other knows.
    """

    outline: float
    floor: float
    overlap: float

    @property
    def score(self) -> float:
        """One number from 0 to 1; below MIN_SCORE, or with little overlap, the plans are not the same."""
        return self.outline * self.floor

    @property
    def same(self) -> bool:
        """Whether it is the same home in this place."""
        return self.score >= MIN_SCORE and self.overlap >= MIN_OVERLAP


@dataclass(frozen=True, slots=True)
class PlanMatch:
    """transform: None where it is refused, `reason` then says why; agreement: of the best place found."""

    transform: PlanTransform | None
    agreement: Agreement
    reason: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class _Outline:
    """A plan made ready. free, known: (rows, cols) bool without specks; distance_m: of each cell to the
    outline; points_m: (N, 2) the outline; floor_m: (M, 2) a thinned sample of the free floor."""

    plan: Occupancy
    free: NDArray[np.bool_]
    known: NDArray[np.bool_]
    distance_m: NDArray[np.float32]
    points_m: FloatArray
    floor_m: FloatArray


def agreement(old: Occupancy, new: Occupancy, transform: PlanTransform = IDENTITY) -> Agreement:
    """How well `old`, moved by `transform`, fits on `new`."""
    return _agreement(_outline(old), _outline(new), transform)


def match_plans(old: Occupancy, new: Occupancy) -> PlanMatch:
    """The transform from the old plan's frame to the new one's, or why there is none.

    Takes about a second for plans of a home: not for the event loop.
    """
    a, b = _outline(old), _outline(new)
    shortest_m = min(len(a.points_m) * old.resolution_m, len(b.points_m) * new.resolution_m)
    if shortest_m < MIN_OUTLINE_M:
        return PlanMatch(None, Agreement(0.0, 0.0, 0.0), "one of the plans shows too little")
    found = [_refined(a, b, rough) for rough in _rough_places(a, b)]
    judged = sorted(((_agreement(a, b, t), t) for t in found), key=lambda e: _rank(e[0]), reverse=True)
    best, transform = judged[0]
    if not best.same:
        return PlanMatch(None, best, f"the plans do not fit: the best place agrees to {best.score:.0%}")
    middle = a.points_m.mean(axis=0)
    for other, elsewhere in judged[1:]:
        if not _apart(transform, elsewhere, middle) or not other.same:
            continue
        if other.score > AMBIGUOUS * best.score:
            return PlanMatch(None, best, "the plans fit in two places about equally well")
    return PlanMatch(transform, best)


def _rank(found: Agreement) -> float:
    return found.score * min(1.0, found.overlap / MIN_OVERLAP)


def _outline(plan: Occupancy) -> _Outline:
    cells = plan.cells
    free = (cells >= 0) & (cells <= FREE_UP_TO)
    blocked = _without_specks(~free, 8)
    free = _without_specks(~blocked, 4)
    known = free | ((cells >= OCCUPIED_FROM) & ~free)
    inner = cv2.erode(free.astype(np.uint8), np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8))
    edge = free & ~inner.astype(bool)
    distance = cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    rows_cols = np.argwhere(free)
    thin = max(1, len(rows_cols) // (4 * MAX_POINTS))
    return _Outline(
        plan,
        free,
        known,
        np.asarray(distance * plan.resolution_m, np.float32),
        _places(plan, np.argwhere(edge)),
        _places(plan, rows_cols[::thin]),
    )


def _without_specks(mask: NDArray[np.bool_], connectivity: int) -> NDArray[np.bool_]:
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=connectivity)
    large = stats[:, cv2.CC_STAT_AREA] >= SPECK_CELLS
    large[0] = False
    kept: NDArray[np.bool_] = large[labels]
    return kept


def _places(plan: Occupancy, rows_cols: NDArray[np.int64]) -> FloatArray:
    """Centres of cells (N, 2) in metres."""
    x_m, y_m, yaw_rad = plan.origin
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    along = (rows_cols[:, ::-1] + 0.5) * plan.resolution_m
    places: FloatArray = along @ np.array([[c, s], [-s, c]]) + (x_m, y_m)
    return places


def _cells(plan: Occupancy, points_m: FloatArray) -> FloatArray:
    """Fractional column, row (N, 2), 0 at the centre of the first cell."""
    x_m, y_m, yaw_rad = plan.origin
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    grid: FloatArray = (points_m - (x_m, y_m)) @ np.array([[c, -s], [s, c]]) / plan.resolution_m - 0.5
    return grid


def _sampled(mask: NDArray[np.bool_], plan: Occupancy, points_m: FloatArray) -> NDArray[np.bool_]:
    """The mask at points; False outside."""
    col, row = np.rint(_cells(plan, points_m)).astype(np.int64).T
    inside = (row >= 0) & (row < mask.shape[0]) & (col >= 0) & (col < mask.shape[1])
    values = np.zeros(len(points_m), np.bool_)
    values[inside] = mask[row[inside], col[inside]]
    return values


def _agreement(a: _Outline, b: _Outline, transform: PlanTransform) -> Agreement:
    on_b = _lies_on(transform.apply(a.points_m), b)
    on_a = _lies_on(transform.inverse_apply(b.points_m), a)
    a_floor, b_floor = transform.apply(a.floor_m), transform.inverse_apply(b.floor_m)
    a_known, a_free = _sampled(b.known, b.plan, a_floor), _sampled(b.free, b.plan, a_floor)
    b_known, b_free = _sampled(a.known, a.plan, b_floor), _sampled(a.free, a.plan, b_floor)
    floor = min(_share(a_free, a_known), _share(b_free, b_known))
    a_area, b_area = (np.count_nonzero(p.free) * p.plan.resolution_m**2 for p in (a, b))
    overlap = a_known.mean() if a_area <= b_area else b_known.mean()
    return Agreement(min(on_b, on_a), floor, float(overlap))


def _share(part: NDArray[np.bool_], whole: NDArray[np.bool_]) -> float:
    count = np.count_nonzero(whole)
    return float(np.count_nonzero(part & whole) / count) if count else 0.0


def _lies_on(points_m: FloatArray, other: _Outline) -> float:
    """Share of the points, where the other plan knows the floor nearby, that lie on its outline."""
    near = cv2.dilate(other.known.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    judged = points_m[_sampled(near, other.plan, points_m)]
    if len(judged) < 0.25 * len(points_m):
        return 0.0
    distance_m, _ = _field(other, judged)
    return float(np.mean(distance_m <= TOLERANCE_M))


def _field(outline: _Outline, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance (N,) in metres to the outline and its slope (N, 2) along the plan's x and y."""
    field = outline.distance_m
    grid = _cells(outline.plan, points_m)
    rows, cols = field.shape
    x, y = np.clip(grid[:, 0], 0, cols - 1.001), np.clip(grid[:, 1], 0, rows - 1.001)
    outside_m = np.hypot(grid[:, 0] - x, grid[:, 1] - y) * outline.plan.resolution_m
    col, row = x.astype(np.int64), y.astype(np.int64)
    fx, fy = x - col, y - row
    col1, row1 = np.minimum(col + 1, cols - 1), np.minimum(row + 1, rows - 1)
    d00, d01, d10, d11 = field[row, col], field[row, col1], field[row1, col], field[row1, col1]
    value = (1 - fy) * ((1 - fx) * d00 + fx * d01) + fy * ((1 - fx) * d10 + fx * d11)
    along_x = (1 - fy) * (d01 - d00) + fy * (d11 - d10)
    along_y = (1 - fx) * (d10 - d00) + fx * (d11 - d01)
    slope = np.stack([along_x, along_y], axis=1)
    yaw_rad = outline.plan.origin[2]
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    turned: FloatArray = slope @ np.array([[c, s], [-s, c]]) / outline.plan.resolution_m
    return np.asarray(value + outside_m, np.float64), turned


def _refined(a: _Outline, b: _Outline, rough: PlanTransform) -> PlanTransform:
    """Gauss-Newton on the squared distances of the old outline to the new one, far points left out."""
    points = a.points_m[:: max(1, len(a.points_m) // MAX_POINTS)]
    best = rough
    for step in range(REFINE_STEPS):
        moved = best.apply(points)
        distance, slope = _field(b, moved)
        reach_m = OUTLIER_M if step < REFINE_STEPS // 2 else OUTLIER_M / 2
        near = distance < reach_m
        if np.count_nonzero(near) < 20:
            break
        arm = moved[near] - (best.x_m, best.y_m)
        g = slope[near]
        rows = np.column_stack([g[:, 1] * arm[:, 0] - g[:, 0] * arm[:, 1], g])
        normal = rows.T @ rows + 1e-9 * np.eye(3)
        change = -np.linalg.solve(normal, rows.T @ distance[near])
        size = max(abs(change[0]) * 5.0, float(np.hypot(change[1], change[2])))
        change *= min(1.0, 0.2 / size) if size > 0 else 1.0
        best = PlanTransform(
            math.remainder(best.angle_rad + float(change[0]), math.tau),
            best.x_m + float(change[1]),
            best.y_m + float(change[2]),
            best.flipped,
        )
        if size < 1e-4 and step >= REFINE_STEPS // 2:
            break
    return best


def _rough_places(a: _Outline, b: _Outline) -> list[PlanTransform]:
    """The best places of the coarse search, all apart from one another, the best first."""
    middle = a.points_m.mean(axis=0)
    span_m = max(float(np.ptp(p.points_m, axis=0).max()) for p in (a, b))
    step_m = max(COARSE_M, span_m / COARSE_CELLS)
    reach_m = float(np.linalg.norm(a.points_m - middle, axis=1).max())
    low = b.points_m.min(axis=0)
    size = [int(v) for v in np.ceil((np.ptp(b.points_m, axis=0) + 2 * reach_m) / step_m) + 3]
    shape = (cv2.getOptimalDFTSize(size[1]), cv2.getOptimalDFTSize(size[0]))
    target = np.fft.rfft2(_drawn(b.points_m - low, step_m, shape))
    found: list[tuple[float, PlanTransform]] = []
    for flipped in (False, True):
        for angle_rad in np.arange(0.0, math.tau, ANGLE_STEP_RAD).tolist():
            turn = PlanTransform(angle_rad, 0.0, 0.0, flipped)
            turned = turn.apply(a.points_m - middle)
            drawn = _drawn(turned + reach_m, step_m, shape)
            score = np.fft.irfft2(target * np.conj(np.fft.rfft2(drawn)), shape)
            found += _peaks(score, step_m, low, reach_m, turn, middle)
    found.sort(key=lambda entry: entry[0], reverse=True)
    kept: list[PlanTransform] = []
    for _, place in found:
        if all(_apart(place, other, middle) for other in kept):
            kept.append(place)
            if len(kept) == CANDIDATES:
                break
    return kept


def _peaks(
    score: FloatArray,
    step_m: float,
    low: FloatArray,
    reach_m: float,
    turn: PlanTransform,
    middle: FloatArray,
) -> list[tuple[float, PlanTransform]]:
    """The two best shifts of one angle."""
    rows, cols = score.shape
    peaks = []
    radius = max(1, round(APART_M / step_m))
    for _ in range(2):
        row, col = divmod(int(score.argmax()), cols)
        value = float(score[row, col])
        # Shifts beyond the middle of the cyclic correlation are negative ones.
        shift = np.array([col - cols if col > cols // 2 else col, row - rows if row > rows // 2 else row])
        centre = low + shift * step_m + reach_m
        offset = centre - turn.matrix @ middle
        peaks.append((value, PlanTransform(turn.angle_rad, float(offset[0]), float(offset[1]), turn.flipped)))
        score[max(0, row - radius) : row + radius + 1, max(0, col - radius) : col + radius + 1] = -np.inf
    return peaks


def _drawn(points_m: FloatArray, step_m: float, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Points (N, 2) from 0 up as a soft picture, its values limited so that no wall counts twice."""
    picture = np.zeros(shape, np.float32)
    col, row = np.floor(points_m / step_m).astype(np.int64).T
    picture[np.clip(row, 0, shape[0] - 1), np.clip(col, 0, shape[1] - 1)] = 1.0
    return np.asarray(cv2.GaussianBlur(picture, (5, 5), 1.0), np.float32)


def _apart(one: PlanTransform, other: PlanTransform, middle: FloatArray) -> bool:
    if one.flipped != other.flipped:
        return True
    turn = abs(math.remainder(one.angle_rad - other.angle_rad, math.tau))
    shift = one.apply(middle[None]) - other.apply(middle[None])
    return turn > APART_RAD or float(np.hypot(*shift[0])) > APART_M
