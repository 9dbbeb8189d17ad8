"""The compiled loops over points beside the plain way of each."""

import numpy as np
import pytest
from edgegrasp_model.collision import _cloud_clearance
from scipy.spatial.transform import Rotation

from edgegrasp_model import compiled
from edgegrasp_model.candidates.collision import hits_cloud
from edgegrasp_model.candidates.edge_grasps import crop_balls
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.hand_view import hand_views, reach_of
from edgegrasp_model.networks.balls import nearest_in_ball
from edgegrasp_model.options import Collision
from edgegrasp_model.scene.cloud import Cloud

pytest.importorskip("numba", reason="the extra `fast` is not installed")

GRIPPERS = ["panda", "robotiq-2f-85"]


@pytest.fixture
def plain(monkeypatch):
    """Calls a function without Numba."""

    def call(function, *arguments):
        with monkeypatch.context() as patch:
            patch.setattr(compiled, "find_spec", lambda name: None)
            assert compiled.point_kernels() is None
            return function(*arguments)

    assert compiled.point_kernels() is not None
    return call


def scene(seed: int, count: int = 700, hands: int = 150) -> tuple[Cloud, np.ndarray]:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.1, 0.1, (count, 3)).astype(np.float32)
    poses = np.tile(np.eye(4, dtype=np.float32), (hands, 1, 1))
    poses[:, :3, :3] = Rotation.random(hands, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.uniform(-0.2, 0.2, (hands, 3))
    return Cloud(points, points), poses


@pytest.mark.parametrize("seed", range(3))
def test_hands_see_the_same_points(plain, seed):
    cloud, hands = scene(seed)
    reach = reach_of(load_gripper())
    expected, view = plain(hand_views, cloud, hands, reach), hand_views(cloud, hands, reach)
    np.testing.assert_array_equal(view.candidate, expected.candidate)
    np.testing.assert_array_equal(view.row, expected.row)
    np.testing.assert_allclose(view.position, expected.position, rtol=0, atol=1e-7)
    assert len(view.row) > 100


@pytest.mark.parametrize("name", GRIPPERS)
@pytest.mark.parametrize("direction", ["back", "up"])
@pytest.mark.parametrize("seed", range(3))
def test_the_same_hands_meet_the_cloud(plain, name, direction, seed):
    cloud, hands = scene(seed, count=30)
    request = Collision(margin=0.004, retreat_direction=direction, retreat_length=0.08)
    gripper = load_gripper(name)
    expected = plain(hits_cloud, cloud, hands, gripper, request)
    np.testing.assert_array_equal(hits_cloud(cloud, hands, gripper, request), expected)
    assert 0 < expected.sum() < len(hands)


def test_points_beyond_the_first_block_are_met_too(plain):
    _, hands = scene(0)
    far = np.full((2000, 3), 3.0, dtype=np.float32)
    far[-1] = 0.0
    cloud, gripper = Cloud(far, far), load_gripper()
    hits = hits_cloud(cloud, hands, gripper, Collision())
    np.testing.assert_array_equal(hits, plain(hits_cloud, cloud, hands, gripper, Collision()))
    assert hits.any()


@pytest.mark.parametrize("name", GRIPPERS)
@pytest.mark.parametrize("count", [50, 2000])
def test_clearances_are_the_same(plain, name, count):
    cloud, hands = scene(1, count)
    gripper = load_gripper(name)
    expected = plain(_cloud_clearance, cloud.points, hands, gripper)
    found = _cloud_clearance(cloud.points, hands, gripper)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)
    assert (expected > 0).any()
    assert (expected < 0).any()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("count", [3, 40, 3000])
def test_neighbours_are_the_same(plain, seed, count):
    cloud, _ = scene(seed, count)
    approach = np.random.default_rng(seed).choice(count, 3, replace=False)
    crop = crop_balls(cloud.points, approach, 0.05)
    expected = plain(nearest_in_ball, cloud.points, approach, crop)
    np.testing.assert_array_equal(nearest_in_ball(cloud.points, approach, crop), expected)


def test_neighbours_of_points_in_one_place_are_any_of_them():
    points = np.zeros((20, 3), dtype=np.float32)
    neighbors = nearest_in_ball(points, np.array([0]), crop_balls(points, np.array([0]), 0.05))
    assert (np.sort(neighbors, axis=1)[:, 1:] > np.sort(neighbors, axis=1)[:, :-1]).all()


def test_no_point_and_no_hand():
    cloud, hands = scene(0)
    nothing, gripper = Cloud(cloud.points[:0], cloud.points[:0]), load_gripper()
    reach = reach_of(gripper)
    assert len(hand_views(nothing, hands, reach).row) == 0
    assert len(hand_views(cloud, hands[:0], reach).row) == 0
    assert not hits_cloud(nothing, hands, gripper, Collision()).any()
    assert len(hits_cloud(cloud, hands[:0], gripper, Collision())) == 0
