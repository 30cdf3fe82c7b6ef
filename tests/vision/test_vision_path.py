"""A walker's path from the body's points: accuracy, covariance, gaps, wild points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vad.geometry import Intrinsics, look_at
from vad.sim.render import Renderer
from vad.sim.render_person import Build
from vad.sim.scenario import make_home
from vad.vision.body import ANKLES, CROWN, HEIGHTS, HIPS, SHOULDERS, Body, Camera
from vad.vision.path import FloatArray, SmoothTrack, smooth
from vad.vision.people import PoseNetwork
from vad.vision.standing import Standing, standing
from vad.vision.tracks import Track, Tracker
from vad.vision.watch import PeopleWatch

pytestmark = pytest.mark.timeout(600)
"""Much work for the processor: a busy machine takes many times as long as an idle one."""

LENS = Intrinsics(640, 480, 410.0, 410.0, 320.0, 240.0)
CAMERA = Camera(LENS, look_at((-2.6, -2.3, 2.25), (0.0, 0.2, 0.55)))
RATE_HZ = 15.0


def true_path(t: FloatArray) -> FloatArray:
    angle = 2 * np.pi * t / 12
    return np.stack([1.4 * np.cos(angle), 1.2 * np.sin(angle) + 0.2 * np.sin(2 * angle)], axis=1)


def lasting(rng: np.random.Generator, count: int, seconds: float = 0.35) -> FloatArray:
    """An error of unit variance that lasts, (count,)."""
    keep = np.exp(-1 / RATE_HZ / seconds)
    values = rng.standard_normal(count)
    for k in range(1, count):
        values[k] = keep * values[k - 1] + np.sqrt(1 - keep**2) * values[k]
    return values


def walked(seed: int, *, seconds: float = 13.0, camera: Camera = CAMERA) -> tuple[Track, float]:
    """What a camera sees of somebody on `true_path`, with errors like the network's; and the stature."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, seconds, 1 / RATE_HZ)
    xy = true_path(t)
    stature = float(rng.normal(1.70, 0.08))
    shares = HEIGHTS + rng.normal(0, 1, 4) * (0.005, 0.01, 0.01, 0.005)
    tall_px = np.linalg.norm(
        camera.pixels(np.column_stack([xy, np.full(len(t), stature)]))
        - camera.pixels(np.column_stack([xy, np.zeros(len(t))])),
        axis=1,
    )
    points = np.zeros((len(t), 4, 2))
    step = 2 * np.pi * rng.uniform(1.3, 1.9) * t + rng.uniform(0, 6)
    sigmas = {ANKLES: (0.008, 0.012), HIPS: (0.011, 0.011), SHOULDERS: (0.011, 0.011), CROWN: (0.0, 0.008)}
    for point, sigma in sigmas.items():
        error = np.stack([s * lasting(rng, len(t)) for s in sigma], axis=1)
        if point == ANKLES:
            error += np.sqrt(2) * np.stack([0.025 * np.cos(step), 0.015 * np.sin(step)], axis=1)
        seen = camera.pixels(np.column_stack([xy, np.full(len(t), shares[point] * stature)]))
        points[:, point] = seen + error * tall_px[:, None]
    # The lens bends what it sees: iterating undoes the undistortion.
    raw = points.reshape(-1, 2).copy()
    for _ in range(20):
        raw += points.reshape(-1, 2) - camera.straight(raw)
    bodies = tuple(Body(p, np.ones(4)) for p in raw.reshape(points.shape))
    rough = xy + rng.normal(0, 0.12, xy.shape)
    spread = np.repeat(np.eye(2)[None] * 0.12**2, len(t), axis=0)
    return Track(1, np.rint(t * 1e9).astype(np.int64), rough, spread, bodies, True), stature


def error_of(path: SmoothTrack) -> FloatArray:
    return path.xy_m - true_path(path.t_ns * 1e-9)


def test_the_path_is_good_to_centimetres_and_its_covariance_true_within_a_factor_of_1_5() -> None:
    errors, ratios, speeds, statures = [], [], [], []
    for seed in range(10):
        track, stature = walked(seed)
        path = smooth(track, CAMERA)
        error = error_of(path)
        weight = np.linalg.inv(path.covariance_m2)
        ratios.append(np.einsum("ni,nij,nj->n", error, weight, error).mean() / 2)
        errors.append(np.linalg.norm(error, axis=1))
        at_s = path.t_ns * 1e-9
        velocity = (true_path(at_s + 0.01) - true_path(at_s - 0.01)) / 0.02
        speeds.append(np.mean((path.velocity_mps - velocity) ** 2))
        statures.append((path.stature_m - stature) / path.stature_sigma_m)
        assert np.all(np.linalg.eigvalsh(path.covariance_m2 - path.slow_covariance_m2) > 0)
    # Standard deviations, as stated and as they are.
    assert 1 / 1.5 < np.sqrt(np.mean(ratios)) < 1.5
    assert np.median(np.concatenate(errors)) < 0.035
    assert np.sqrt(np.mean(speeds)) < 0.12
    assert np.sqrt(np.mean(np.square(statures))) < 1.8


def test_a_lens_with_distortion_makes_no_difference() -> None:
    bent = Camera(replace(LENS, k1=-0.22, k2=0.04), CAMERA.camera_from_map)
    (plain, _), (curved, _) = walked(4), walked(4, camera=bent)
    assert smooth(curved, bent).xy_m == pytest.approx(smooth(plain, CAMERA).xy_m, abs=2e-3)


def test_hidden_feet_cost_accuracy_but_no_honesty() -> None:
    hidden, full, ratios = [], [], []
    for seed in range(5):
        track, _ = walked(seed)
        behind = slice(60, 110)
        bodies = list(track.bodies)
        for k in range(behind.start, behind.stop):
            body = bodies[k]
            assert body is not None
            bodies[k] = Body(body.points_px, np.array([np.inf, 1.0, 1.0, 1.0]))
        path = smooth(replace(track, bodies=tuple(bodies)), CAMERA)
        inside = (path.t_ns >= track.t_ns[60]) & (path.t_ns <= track.t_ns[109])
        error = error_of(path)[inside]
        hidden.append(np.mean(error**2))
        full.append(np.mean(error_of(smooth(track, CAMERA))[inside] ** 2))
        weight = np.linalg.inv(path.covariance_m2[inside])
        ratios.append(np.einsum("ni,nij,nj->n", error, weight, error).mean() / 2)
    assert np.sqrt(np.mean(hidden)) < 0.08
    assert np.mean(hidden) > np.mean(full)
    assert 0.3 < np.mean(ratios) < 2.0


def test_a_gap_is_bridged_with_a_larger_covariance() -> None:
    track, _ = walked(2)
    kept = [k for k in range(len(track.t_ns)) if not 70 <= k < 90]
    gap = replace(
        track,
        t_ns=track.t_ns[kept],
        xy_m=track.xy_m[kept],
        covariance_m2=track.covariance_m2[kept],
        bodies=tuple(track.bodies[k] for k in kept),
    )
    path = smooth(gap, CAMERA)
    assert np.diff(path.t_ns).max() == np.diff(path.t_ns).min() == 50_000_000
    sigma = np.sqrt(np.trace(path.covariance_m2, axis1=1, axis2=2))
    middle = np.searchsorted(path.t_ns, track.t_ns[80])
    assert sigma[middle] > 1.5 * np.median(sigma)
    assert np.linalg.norm(error_of(path)[middle]) < 3 * sigma[middle]


def test_wild_points_hardly_bend_the_path() -> None:
    track, _ = walked(3)
    bodies = list(track.bodies)
    for k in (50, 51, 120):
        body = bodies[k]
        assert body is not None
        points = body.points_px.copy()
        points[ANKLES] += (60.0, -50.0)
        bodies[k] = Body(points, body.spread)
    bent = smooth(replace(track, bodies=tuple(bodies)), CAMERA)
    assert np.abs(bent.xy_m - smooth(track, CAMERA).xy_m).max() < 0.06


def test_a_cameras_own_uncertainty_is_slow() -> None:
    path = smooth(walked(1)[0], CAMERA)
    more = np.repeat(np.eye(2)[None] * 0.05**2, len(path.t_ns), axis=0)
    wide = path.widened(more)
    assert np.allclose(wide.covariance_m2 - path.covariance_m2, more)
    assert np.allclose(wide.slow_covariance_m2 - path.slow_covariance_m2, more)


def test_a_single_body_has_no_path() -> None:
    track, _ = walked(1)
    bodies = (track.bodies[0], *[None] * (len(track.bodies) - 1))
    with pytest.raises(ValueError, match="fewer than two"):
        smooth(replace(track, bodies=bodies), CAMERA)


def test_somebody_who_stands_still_has_a_path_too() -> None:
    track, _ = walked(6)
    still = replace(track, bodies=(track.bodies[0],) * len(track.bodies), xy_m=track.xy_m[:1].repeat(195, 0))
    path = smooth(still, CAMERA)
    assert np.ptp(path.xy_m, axis=0).max() < 0.05
    assert np.abs(path.velocity_mps).max() < 0.15


@pytest.mark.slow
@pytest.mark.parametrize("seed", [102, 107])
def test_through_the_real_network_a_rendered_walkers_path_holds_its_bar(seed: int) -> None:
    scenario = make_home(seed, walks=1)
    build = Build.draw(np.random.default_rng([seed, 7]))
    renderer, watch, tracker = (
        Renderer(scenario, seed=seed, build=build),
        PeopleWatch(PoseNetwork()),
        Tracker(),
    )
    camera = Camera(renderer.view.intrinsics, renderer.view.camera_from_map)
    walk = scenario.walks[0]
    for t_s in np.arange(walk.start_s, walk.end_s, 1 / RATE_HZ):
        t_ns = int(t_s * 1e9)
        image = renderer.frame(t_s)
        look = watch.look(image, t_ns)
        found = [standing(person, image, camera) for person in look.people]
        if look.looked:
            tracker.update(t_ns, [place for place in found if isinstance(place, Standing)])
    track = max(tracker.tracks(), key=lambda one: len(one.t_ns))
    path = smooth(track, camera)
    truth = np.array([(s.x_m, s.y_m) for t in path.t_ns if (s := walk.state(t * 1e-9)) is not None])
    assert len(truth) == len(path.t_ns) > 150
    error = path.xy_m - truth
    distance = np.linalg.norm(error, axis=1)
    assert np.median(distance) < 0.05
    assert np.percentile(distance, 95) < 0.15
    half_second = np.stack([np.convolve(error[:, k], np.full(10, 0.1), mode="valid") for k in (0, 1)], axis=1)
    assert np.sqrt(np.mean(np.sum(half_second**2, axis=1))) < 0.03
    ratio = np.einsum("ni,nij,nj->n", error, np.linalg.inv(path.covariance_m2), error).mean() / 2
    assert 1 / 1.5 < np.sqrt(ratio) < 1.5
