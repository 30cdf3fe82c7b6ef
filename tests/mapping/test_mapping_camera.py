"""Stage 1 on simulated drives: geometry only, noise as in the project's own figures."""

from __future__ import annotations

import json

import numpy as np
import pytest
from drives import S_NS, drive, simulate, true_deviation, way_points

from vad.geometry import Intrinsics, project
from vad.mapping.camera_calibration import CameraCalibration
from vad.mapping.camera_consensus import Candidates, Sightings, sightings_of
from vad.mapping.camera_contact import recontacted
from vad.mapping.camera_fit import Start
from vad.mapping.camera_spread import best_of_each, spread, spread_selection
from vad.mapping.camera_stage import CameraMapper
from vad.mapping.camera_track import PoseTrack
from vad.vision.robot import disc_contact


@pytest.mark.parametrize(
    ("shape", "limit_m"), [("L", 0.03), ("circle", 0.03), ("rectangle", 0.03), ("random", 0.05)]
)
def test_drive_calibrates_an_unknown_camera(shape: str, limit_m: float) -> None:
    scenes = [simulate(shape, seed) for seed in range(2)]
    results = [scene.mapper.solve() for scene in scenes]
    assert [r.status for r in results] == ["valid"] * 2
    assert [(r.percent, r.reason) for r in results] == [(100, "")] * 2
    deviations = [true_deviation(s, r) for s, r in zip(scenes, results, strict=True)]
    assert np.mean(deviations) <= limit_m
    # Stated with the poses' own 2 cm per axis in it.
    assert all(r.deviation_m is not None and r.deviation_m < 0.045 for r in results)
    assert all(r.homography_gap_m is not None and r.homography_gap_m < 0.03 for r in results)
    focal = [abs(r.intrinsics.fx_px / s.lens.fx_px - 1.0) for s, r in zip(scenes, results, strict=True)]
    assert np.mean(focal) <= 0.03
    offset = [abs(r.time_offset_s - s.latency_s) for s, r in zip(scenes, results, strict=True)]
    assert np.mean(offset) <= 0.03


@pytest.mark.slow
def test_stated_covariance_of_the_position_is_true() -> None:
    squared = []
    for seed in range(8):
        scene = simulate("rectangle", seed)
        result = scene.mapper.solve()
        error = result.position_m - scene.eye
        squared.append(error @ np.linalg.solve(result.position_covariance, error) / 3.0)
    assert 0.4 < np.mean(squared) < 2.5


@pytest.mark.slow
def test_clutter_in_every_picture_does_not_hide_the_robot() -> None:
    scene = simulate("random", 1, laps=2, spurious=4)
    result = scene.mapper.solve()
    assert result.status == "valid"
    assert true_deviation(scene, result) <= 0.02
    assert abs(result.time_offset_s - scene.latency_s) <= 0.03


@pytest.mark.slow
def test_known_lens_gives_the_position_within_5_cm() -> None:
    errors = []
    for seed in range(5):
        scene = simulate("rectangle", seed, known_lens=True)
        result = scene.mapper.solve()
        assert result.status == "valid"
        assert result.intrinsics == scene.lens
        assert result.focal_sigma_px == 0.0
        errors.append(np.linalg.norm(result.position_m - scene.eye))
    assert max(errors) <= 0.05


def test_slow_pose_source_is_interpolated() -> None:
    scene = simulate("rectangle", 1, pose_hz=0.5, laps=2)
    result = scene.mapper.solve()
    assert result.status == "valid"
    assert true_deviation(scene, result) <= 0.06


def test_floor_point_covariance_covers_its_error() -> None:
    scene = simulate("rectangle", 2)
    result = scene.mapper.solve()
    rng = np.random.default_rng(5)
    floor = np.column_stack([rng.uniform(0.5, 2.3, (400, 2)), np.zeros(400)])
    px = project(floor, scene.lens, scene.camera_from_map) + rng.normal(0.0, 2.0, (400, 2))
    xy, covariance = result.floor_point(px, 2.0)
    error = xy - floor[:, :2]
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error) / 2.0
    assert 0.6 < np.mean(squared) < 1.6
    again, same = result.floor_points_with(px, np.broadcast_to(4.0 * np.eye(2), (400, 2, 2)))
    assert np.allclose(again, xy)
    assert np.allclose(same, covariance)
    sky, _ = result.floor_point([[320.0, -5000.0]], 1.0)
    assert np.all(np.isnan(sky))


def test_homography_covariance_is_that_of_its_floor_points() -> None:
    scene = simulate("rectangle", 2, known_lens=True, k1=0.0)
    result = scene.mapper.solve()
    px = np.array([[250.0, 300.0]])
    x, y, w = np.append(px[0], 1.0) @ result.map_from_image.T
    row = np.append(px[0], 1.0)
    zero = np.zeros(3)
    by_entry = np.array(
        [np.concatenate([row, zero, -x / w * row]) / w, np.concatenate([zero, row, -y / w * row]) / w]
    )
    _, covariance = result.floor_point(px, 0.0)
    assert np.allclose(by_entry @ result.homography_covariance @ by_entry.T, covariance[0], rtol=1e-3)
    assert CameraCalibration("collecting", 0, "").homography_covariance is None


def test_calibration_survives_json() -> None:
    result = simulate("L", 0).mapper.solve()
    back = CameraCalibration.from_dict(json.loads(json.dumps(result.to_dict())))
    assert json.dumps(back.to_dict()) == json.dumps(result.to_dict())
    px = [[300.0, 300.0]]
    assert np.allclose(back.floor_point(px, 1.0)[1], result.floor_point(px, 1.0)[1])
    empty = CameraMapper(640, 480).solve()
    assert CameraCalibration.from_dict(empty.to_dict()) == empty


@pytest.mark.parametrize(
    "spoil",
    [
        lambda d: d.update(schema="other"),
        lambda d: d.update(status="perhaps"),
        lambda d: d.pop("pairs"),
        lambda d: d.update(map_from_image=[[1.0, 2.0]]),
        lambda d: d["intrinsics"].pop("fx_px"),
        lambda d: d.update(parameter_covariance=[[float("nan")] * 8] * 8),
    ],
)
def test_spoilt_record_is_refused(spoil) -> None:  # type: ignore[no-untyped-def]
    record = simulate("L", 0).mapper.solve().to_dict()
    spoil(record)
    with pytest.raises(ValueError, match=r"record|shape"):
        CameraCalibration.from_dict(record)


def test_uncalibrated_before_any_data() -> None:
    mapper = CameraMapper(640, 480)
    assert mapper.solve().status == "uncalibrated"
    with pytest.raises(ValueError, match="not calibrated"):
        mapper.solve().floor_point([[0.0, 0.0]], 1.0)
    for k in range(5):
        mapper.add_pose(k * S_NS, 0.1 * k, 0.0, 0.02)
    mapper.add_candidates(S_NS, np.empty((0, 2)), 1.0)
    result = mapper.solve()
    assert (result.status, result.percent) == ("uncalibrated", 0)
    assert "picture" in result.reason


def test_too_few_pairs_are_collecting() -> None:
    scene = simulate("rectangle", 0)
    few = CameraMapper(640, 480)
    for k in range(12):
        few.add_pose(k * S_NS // 5, 0.06 * k, 0.0, 0.02)
        few.add_candidates(
            k * S_NS // 5, project([[0.06 * k, 0.0, 0.0]], scene.lens, scene.camera_from_map), 1.5
        )
    result = few.solve()
    assert result.status == "collecting"
    assert 0 < result.percent < 100
    assert "of 15" in result.reason


def test_a_drive_along_one_line_is_collecting() -> None:
    result = simulate("line", 3).mapper.solve()
    assert result.status == "collecting"
    assert result.percent < 100
    assert "line" in result.reason


def test_a_robot_seen_on_one_spot_is_collecting_and_told_where_to_go() -> None:
    scene = simulate("rectangle", 4)
    mapper = CameraMapper(640, 480)
    rng = np.random.default_rng(0)
    angle = np.arange(0.0, 30.0, 0.02)
    path = np.column_stack([1.6 + 0.35 * np.cos(angle), 1.2 + 0.35 * np.sin(angle) * np.cos(0.31 * angle)])
    for k, (x, y) in enumerate(path):
        mapper.add_pose(k * S_NS // 20, x, y, 0.005)
        if k % 3 == 0:
            px = project([[x, y, 0.0]], scene.lens, scene.camera_from_map)
            mapper.add_candidates(k * S_NS // 20, px + rng.normal(0.0, 1.0, px.shape), 1.0)
    result = mapper.solve()
    assert result.status == "collecting"
    assert "m2" in result.reason


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["rectangle", "L", "random"])
@pytest.mark.parametrize("walks", [True, False])
def test_motion_that_is_not_the_robot_is_never_valid(shape: str, walks: bool) -> None:
    invalid = 0
    for seed in range(3):
        mapper = CameraMapper(640, 480)
        rng = np.random.default_rng(seed)
        truth = drive(way_points(shape, rng))
        walker = rng.uniform(0, [640, 480])
        for k in range(0, len(truth), 10):
            walker = np.clip(walker + rng.normal(0, 12, 2), 0, [640, 480])
            mapper.add_pose(k * S_NS // 100, *map(float, truth[k]), 0.02)
            seen = walker[None] if walks else rng.uniform(0, [640, 480], (3, 2))
            mapper.add_candidates(k * S_NS // 100, seen, 2.0)
        result = mapper.solve()
        assert result.status in ("invalid", "collecting")
        assert result.reason
        invalid += result.status == "invalid"
    assert invalid >= 2


@pytest.mark.parametrize("jump_m", [0.2, 0.5, 3.0])
def test_wild_poses_are_dropped_and_jumps_begin_a_segment(jump_m: float) -> None:
    rng = np.random.default_rng(5)
    t = np.arange(0.0, 60.0, 0.1)
    xy = np.column_stack([0.2 * t, np.sin(0.2 * t)]) + rng.normal(0.0, 0.015, (len(t), 2))
    wild = rng.choice(np.arange(20, len(t) - 20), 25, replace=False)
    xy[wild] += rng.uniform(0.5, 2.0, (25, 2))
    track = PoseTrack(t, xy, np.full(len(t), 0.015))
    assert track.wild >= 25
    assert set(track.segment.tolist()) == {0}
    found, _ = track.at(t[20:-20])
    assert (
        float(np.max(np.linalg.norm(found - np.column_stack([0.2 * t, np.sin(0.2 * t)])[20:-20], axis=1)))
        < 0.06
    )
    xy[300:] += (0.0, jump_m)
    track = PoseTrack(t, xy, np.full(len(t), 0.015))
    assert set(track.segment.tolist()) == {0, 1}
    begin = track.t_s[np.argmax(track.segment)]
    assert abs(begin - 30.0) < 0.5
    assert track.segment_at(np.array([20.0, 40.0, 99.0])).tolist() == [0, 1, -1]


@pytest.mark.slow
@pytest.mark.parametrize("latency_s", [-1.7, 1.7])
def test_time_offsets_up_to_two_seconds_are_found(latency_s: float) -> None:
    scene = simulate("random", 3, latency_s=latency_s)
    result = scene.mapper.solve()
    assert result.status == "valid"
    assert abs(result.time_offset_s - latency_s) < 0.03
    assert true_deviation(scene, result) <= 0.03


@pytest.mark.slow
def test_after_a_relocalisation_the_robots_new_place_counts() -> None:
    scene = simulate("random", 2, laps=3, jump_m=0.6)
    result = scene.mapper.solve()
    assert result.status == "valid"
    assert true_deviation(scene, result) <= 0.03


def test_relocalisation_jump_does_not_spoil_the_track() -> None:
    t = np.arange(0.0, 6.0, 0.1)
    xy = np.column_stack([0.3 * t, np.where(t < 3.0, 0.0, 2.0)])
    track = PoseTrack(t, xy, np.full(len(t), 0.02))
    found, sigma = track.at(np.array([1.05, 2.95, 4.05, -1.0, 7.0]))
    assert np.allclose(found[[0, 2]], [[0.315, 0.0], [1.215, 2.0]], atol=1e-6)
    assert np.isnan(found[[1, 3, 4]]).all()
    assert np.isnan(sigma[[1, 3, 4]]).all()


def test_track_across_a_gap_is_unknown_and_between_slow_poses_less_certain() -> None:
    t = np.array([0.0, 2.0, 4.0, 10.0])
    track = PoseTrack(t, np.column_stack([0.2 * t, 0.0 * t]), np.full(4, 0.02))
    found, sigma = track.at(np.array([2.0, 3.0, 7.0]))
    assert np.allclose(found[:2, 0], [0.4, 0.6])
    assert np.isnan(found[2]).all()
    assert sigma[1] > sigma[0]
    none, _ = PoseTrack([], np.empty((0, 2)), []).at(np.array([1.0]))
    assert np.isnan(none).all()


def test_helpers() -> None:
    assert spread(np.array([[0.0, 0.0], [1.0, 0.0]])) == (0.0, 0.0)
    area, width = spread(np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]]))
    assert area == pytest.approx(2.0)
    assert width == pytest.approx(np.sqrt(1.0 / 3.0))
    rows = best_of_each(np.array([0, 0, 1, 2, 2]), np.array([3.0, 1.0, 9.0, np.nan, 2.0]), 4.0)
    assert rows.tolist() == [1, 4]
    parked = np.vstack([np.zeros((500, 2)), np.column_stack([np.arange(1.0, 9.0), np.zeros(8)])])
    chosen = spread_selection(parked, 20)
    assert len(chosen) == 20
    assert set(range(500, 508)) <= set(chosen.tolist())


def test_intrinsics_of_another_size_are_refused() -> None:
    with pytest.raises(ValueError, match="size"):
        CameraMapper(1280, 720, Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0))


def test_contacts_of_boxes_come_from_where_the_camera_is() -> None:
    """A robot flatter than assumed: contacts made from its boxes alone are off, those of the fit are not."""
    scene = simulate("rectangle", 3)
    lens, pose = scene.lens, scene.camera_from_map
    truth = scene.truth[300:-300:40]
    angle = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    ring = 0.17 * np.column_stack([np.cos(angle), np.sin(angle)])
    outline = np.concatenate(
        [np.concatenate([xy + ring, xy + ring]) for xy in truth],
    )
    heights = np.tile(np.repeat([0.0, 0.06], 60), len(truth))
    px = project(np.column_stack([outline, heights]), lens, pose).reshape(len(truth), 120, 2)
    boxes = np.concatenate([px.min(axis=1), px.max(axis=1)], axis=1)
    crude = np.array([disc_contact(*box) for box in boxes.tolist()])
    right = project(np.column_stack([truth, np.zeros(len(truth))]), lens, pose)
    sightings = Sightings(
        np.arange(len(truth)), np.arange(len(truth)) * 0.4, crude, np.ones(len(truth)), boxes
    )
    seen = recontacted(sightings, Start(lens, pose, 0.0))
    assert float(np.median(np.linalg.norm(crude - right, axis=1))) > 1.0
    assert float(np.median(np.linalg.norm(seen.image_px - right, axis=1))) < 0.4
    none = sightings_of([Candidates.of(0, crude, 1.0, None)], 0)
    assert recontacted(none, Start(lens, pose, 0.0)) is none
