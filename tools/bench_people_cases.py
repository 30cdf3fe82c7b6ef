"""Rendered walkers through the real network, frame by frame as in the daemon, against the truth."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from vad.sim.render import Renderer
from vad.sim.render_person import Build
from vad.sim.scenario import Scenario, make_home
from vad.vision.body import Camera
from vad.vision.path import SmoothTrack, smooth
from vad.vision.people import PoseNetwork
from vad.vision.standing import Standing, standing
from vad.vision.tracks import Tracker
from vad.vision.watch import PeopleWatch

FloatArray = NDArray[np.float64]

FPS = 15.0
NEAR_M, FAR_M = 2.0, 6.0
HALF_SECOND = 10  # of the path's points
MIN_BODIES = 20


@dataclass
class Walked:
    """One walk. Rows are points: distance_m from the camera's foot, error_m (N, 2) along and across the view.

    path: of the smoothed path; slow: the same averaged over half a second; ratio: squared error over what the
    covariance says, 1 in the mean where that is true; single: of single pictures' ground points. frames: all
    with the walker in the room; shown: with a place; pieces: how many tracks the walk came in.
    """

    seed: int
    stature_m: float
    frames: int = 0
    shown: int = 0
    pieces: int = 0
    seen: Counter[str] = field(default_factory=Counter)
    distance_m: FloatArray = field(default_factory=lambda: np.empty(0))
    path: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    ratio: FloatArray = field(default_factory=lambda: np.empty(0))
    slow: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    slow_distance_m: FloatArray = field(default_factory=lambda: np.empty(0))
    single: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    single_distance_m: FloatArray = field(default_factory=lambda: np.empty(0))
    speed_error_mps: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    stature_error_m: float = float("nan")


def walk(seed: int, fps: float = FPS) -> Walked:
    """The first visit in the home of `seed`, its walker of a build of their own, the camera's place known."""
    scenario = make_home(seed, walks=1)
    build = Build.draw(np.random.default_rng([seed, 7]))
    renderer = Renderer(scenario, seed=seed, build=build)
    camera = Camera(renderer.view.intrinsics, renderer.view.camera_from_map)
    watch, tracker = PeopleWatch(PoseNetwork()), Tracker()
    visit = scenario.walks[0]
    result = Walked(seed, visit.height_m)
    places: list[tuple[float, FloatArray]] = []
    for t_s in np.arange(visit.start_s, visit.end_s, 1.0 / fps):
        if not _in_room(scenario, float(t_s)):
            continue
        result.frames += 1
        image = renderer.frame(float(t_s))
        look = watch.look(image, int(t_s * 1e9))
        if not look.looked:
            continue
        found = [standing(person, image, camera) for person in look.people]
        seen = [place for place in found if isinstance(place, Standing)]
        result.shown += bool(seen)
        for place in found:
            result.seen[_how(place)] += 1
        places += [(float(t_s), place.xy_m) for place in seen]
        tracker.update(int(t_s * 1e9), seen)
    for track in tracker.tracks():
        if sum(body is not None for body in track.bodies) >= MIN_BODIES:
            result.pieces += 1
            _add(result, scenario, camera, smooth(track, camera))
    truth = _truth(scenario, np.array([t for t, _ in places]))
    error, distance = _along_the_view(np.array([xy for _, xy in places]) - truth, truth, camera)
    result.single, result.single_distance_m = error, distance
    return result


def _how(place: object) -> str:
    if isinstance(place, Standing):
        return "by the feet" if place.by_feet else "feet hidden"
    return str(getattr(place, "reason", place))


def _in_room(scenario: Scenario, t_s: float) -> bool:
    x0, y0, x1, y1 = scenario.room_m
    walker = scenario.walker_at(t_s)
    return walker is not None and x0 < walker.x_m < x1 and y0 < walker.y_m < y1


def _truth(scenario: Scenario, t_s: FloatArray) -> FloatArray:
    states = [scenario.walks[0].state(float(t)) for t in t_s]
    return np.array([(s.x_m, s.y_m) for s in states if s is not None])


def _along_the_view(error: FloatArray, at: FloatArray, camera: Camera) -> tuple[FloatArray, FloatArray]:
    view = at - camera.eye_m[:2]
    distance = np.linalg.norm(view, axis=1)
    view = view / distance[:, None]
    across = error[:, 1] * view[:, 0] - error[:, 0] * view[:, 1]
    return np.column_stack([(error * view).sum(axis=1), across]), distance


def _add(result: Walked, scenario: Scenario, camera: Camera, path: SmoothTrack) -> None:
    t_s = path.t_ns * 1e-9
    truth = _truth(scenario, t_s)
    error = path.xy_m - truth
    turned, distance = _along_the_view(error, truth, camera)
    kernel = np.full(HALF_SECOND, 1.0 / HALF_SECOND)
    slow = np.column_stack([np.convolve(error[:, k], kernel, mode="valid") for k in (0, 1)])
    middle = slice(HALF_SECOND // 2, HALF_SECOND // 2 + len(slow))
    slow_turned, slow_distance = _along_the_view(slow, truth[middle], camera)
    ratio = np.einsum("ni,nij,nj->n", error, np.linalg.inv(path.covariance_m2), error) / 2.0
    speed = path.velocity_mps - np.gradient(truth, t_s, axis=0)
    result.path = np.concatenate([result.path, turned])
    result.distance_m = np.concatenate([result.distance_m, distance])
    result.ratio = np.concatenate([result.ratio, ratio])
    result.slow = np.concatenate([result.slow, slow_turned])
    result.slow_distance_m = np.concatenate([result.slow_distance_m, slow_distance])
    result.speed_error_mps = np.concatenate([result.speed_error_mps, speed])
    result.stature_error_m = path.stature_m - result.stature_m


@dataclass(frozen=True)
class Cost:
    """CPU time as a share of one core, and milliseconds from a frame to its ground points: of the clock on
    the wall, and of CPU, which other programs do not lengthen."""

    share: float
    decode_share: float
    p50_ms: float
    p95_ms: float
    cpu_p95_ms: float
    frames: int


def cost(seed: int, seconds: float, *, idle: bool) -> Cost:
    """Vision on 640x480 at 15 fps: gate, network, ground points, tracks; and decoding the JPEG, apart."""
    scenario = make_home(seed, walks=1)
    renderer = Renderer(scenario, seed=seed)
    camera = Camera(renderer.view.intrinsics, renderer.view.camera_from_map)
    visit = scenario.walks[0]
    begin_s = scenario.drive_end_s + 0.2 if idle else visit.start_s + 1.5
    if idle:
        seconds = min(seconds, visit.start_s - begin_s - 0.2)
    # A still room repeats itself: the gate must have seen nothing for a while before the count begins.
    warm = round(3.0 * FPS) if idle else 3
    count = round(min(seconds, visit.end_s - 1.5 - begin_s) * FPS) if not idle else round(20 * FPS)
    span_s = seconds if idle else count / FPS
    watch, tracker = PeopleWatch(PoseNetwork()), Tracker()
    waits: list[float] = []
    works: list[float] = []
    decoding = 0.0
    for k in range(warm + count):
        picture = renderer.frame(begin_s + (k / FPS) % span_s)
        _, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 90])
        started = time.process_time()
        image = np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_COLOR), dtype=np.uint8)
        decoded, arrived = time.process_time(), time.perf_counter()
        t_ns = int((begin_s + k / FPS) * 1e9)
        look = watch.look(image, t_ns)
        found = [standing(person, image, camera) for person in look.people]
        seen = [place for place in found if isinstance(place, Standing)]
        if look.looked:
            tracker.update(t_ns, seen)
        if k >= warm:
            waits.append(1e3 * (time.perf_counter() - arrived))
            works.append(1e3 * (time.process_time() - decoded))
            decoding += decoded - started
    whole_s = count / FPS
    p50, p95 = np.percentile(waits, [50, 95])
    return Cost(
        sum(works) / 1e3 / whole_s,
        decoding / whole_s,
        float(p50),
        float(p95),
        float(np.percentile(works, 95)),
        count,
    )
