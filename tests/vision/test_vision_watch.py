"""When the network looks, and where: the real one on rendered people, a tiny one of a fixed size."""

from __future__ import annotations

from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
from effort import effort
from onnx import TensorProto
from pose_networks import H, W, movenet_multi, red, save

from vad.sim.render import Renderer
from vad.sim.scenario import Scenario, make_home
from vad.vision.people import MotionGate, PoseNetwork
from vad.vision.watch import Look, PeopleWatch

pytestmark = pytest.mark.timeout(600)
"""Much work for the processor: a busy machine takes many times as long as an idle one."""

FPS = 15


@pytest.fixture(scope="module")
def network() -> PoseNetwork:
    return PoseNetwork()


@cache
def home(seed: int) -> tuple[Scenario, Renderer]:
    scenario = make_home(seed, walks=1)
    return scenario, Renderer(scenario, seed=seed)


def watched(watch: PeopleWatch, seed: int, from_s: float, frames: int) -> tuple[list[Look], float]:
    """What a watch makes of rendered frames, and the effort of five of them."""
    _, renderer = home(seed)
    looks: list[Look] = []
    pictures = [renderer.frame(from_s + k / FPS) for k in range(frames)]

    def look(first: int) -> None:
        for k, picture in enumerate(pictures[first : first + 5], first):
            looks.append(watch.look(picture, int((from_s + k / FPS) * 1e9)))

    return looks, effort(*(partial(look, first) for first in range(0, frames, 5)))


def test_a_walker_is_followed_in_every_frame_at_less_than_the_whole_pictures_cost(
    network: PoseNetwork,
) -> None:
    scenario, renderer = home(2)
    from_s = scenario.walks[0].start_s + 5.0
    looks, spent = watched(PeopleWatch(network), 2, from_s, 15)
    assert all(look.looked for look in looks)
    assert sum(len(look.people) == 1 for look in looks) >= 14
    pictures = [renderer.frame(from_s + k / FPS) for k in range(5)]
    whole = effort(*(partial(network.infer, picture) for picture in pictures))
    assert spent / 5 < 0.8 * whole


def test_a_piece_shows_the_same_person_as_the_whole_picture(network: PoseNetwork) -> None:
    scenario, renderer = home(2)
    picture = renderer.frame(scenario.walks[0].start_s + 6.0)
    (whole,) = network.infer(picture)
    for size in ((256, 192), (192, 128)):
        piece = network.follow(picture, whole.box, size)
        assert piece is not None
        trunk = [5, 6, 11, 12]
        apart = piece.keypoints[trunk, :2].mean(axis=0) - whole.keypoints[trunk, :2].mean(axis=0)
        assert np.abs(apart).max() < 3.0
    assert network.follow(picture, (10.0, 10.0, 60.0, 120.0)) is None


def test_somebody_half_outside_the_picture_is_looked_for_in_what_there_is(network: PoseNetwork) -> None:
    scenario, renderer = home(2)
    picture = renderer.frame(scenario.walks[0].start_s + 6.0)
    (whole,) = network.infer(picture)
    x0, y0, x1, y1 = whole.box
    from_x = int((x0 + x1) / 2)
    half = np.ascontiguousarray(picture[:, from_x:])
    network.follow(half, (x0 - from_x, y0, x1 - from_x, y1))
    assert network.follow(half, (-900.0, y0, -800.0, y1)) is None


def test_a_still_room_costs_next_to_nothing(network: PoseNetwork) -> None:
    scenario, _ = home(1)
    watch = PeopleWatch(network, MotionGate(hold_frames=5))
    watched(watch, 1, scenario.drive_end_s + 0.5, 8)
    looks, spent = watched(watch, 1, scenario.drive_end_s + 1.5, 30)
    assert all(look.looked and not look.people for look in looks)
    assert spent / 5 < 1


def test_who_leaves_the_picture_is_forgotten(network: PoseNetwork) -> None:
    scenario, _ = home(1)
    end_s = scenario.walks[0].end_s
    looks, _ = watched(PeopleWatch(network), 1, end_s - 2.5, 45)
    assert looks[0].boxes
    assert not looks[-1].boxes


def moving(k: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """A red picture with a dark patch that jumps about."""
    picture = red()
    picture[20 * (k % 8) : 20 * (k % 8) + 16, :60] = 0
    return picture


def test_a_network_of_one_size_looks_at_whole_pictures_now_and_then(tmp_path: Path) -> None:
    path = save(tmp_path / "net.onnx", movenet_multi(), [1, H, W, 3], TensorProto.UINT8, nchw=False)
    watch = PeopleWatch(PoseNetwork(path))
    looks = [watch.look(moving(k), int(k / FPS * 1e9)) for k in range(30)]
    looked = [k for k, look in enumerate(looks) if look.looked]
    assert np.diff(looked).max() <= 2
    assert len(looked) < 30
    for look in looks:
        assert bool(look.people) == look.looked
        assert len(look.boxes) == 1  # who is known stays known between two looks


def test_while_nobody_is_known_whole_pictures_are_looked_at_five_times_a_second(tmp_path: Path) -> None:
    nobody = np.zeros((1, 6, 56), np.float32)
    path = save(tmp_path / "net.onnx", nobody, [1, "h", "w", 3], TensorProto.INT32, nchw=False)
    watch = PeopleWatch(PoseNetwork(path))
    looked = [watch.look(moving(k), int(k / FPS * 1e9)).looked for k in range(60)]
    assert 18 <= sum(looked) <= 21
