"""The compiled loops, and the fused layers made of them, beside a plain way of each."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edgegrasp_model.candidates.collision import hits_cloud
from edgegrasp_model.candidates.edge_grasps import crop_balls
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.hand_kernels import (
    any_point_in_boxes,
    non_max_suppression,
    points_in_hand_boxes,
    signed_distance_to_boxes,
)
from edgegrasp_model.hand_view import hand_views, reach_of
from edgegrasp_model.kernels import nearest_in_groups
from edgegrasp_model.networks.balls import nearest_in_ball
from edgegrasp_model.networks.checkpoint import build_network
from edgegrasp_model.options import Collision
from edgegrasp_model.scene.cloud import Cloud

from . import oracles
from .scenes import PANDA, SEED, TINY, RandomScene, random_hands

HANDS = random_hands(150, seed=0)
grippers = pytest.mark.parametrize("name", ["panda", "robotiq-2f-85"])


def cloud(seed: int, count: int = 700) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-0.1, 0.1, (count, 3)).astype(np.float32)


@pytest.mark.parametrize("seed", range(3))
def test_hands_see_the_points_within_reach(seed: int) -> None:
    points, (low, high) = cloud(seed), np.asarray(reach_of(PANDA), dtype=np.float32)
    found = points_in_hand_boxes(points, HANDS, low, high)
    expected = oracles.points_in_hand_boxes(points, HANDS, low, high)
    assert len(found[0]) == pytest.approx(len(expected[0]), abs=2)  # float32 beside float64
    pairs = [{(h, r): p for h, r, p in zip(*seen, strict=True)} for seen in (found, expected)]
    both = pairs[0].keys() & pairs[1].keys()
    assert len(both) >= len(expected[0]) - 2 > 100
    for pair in both:
        np.testing.assert_allclose(pairs[0][pair], pairs[1][pair], rtol=0, atol=1e-6)
    assert list(pairs[0]) == sorted(pairs[0])


def test_near_duplicates_fall_to_the_better_one() -> None:
    T_cloud_tcp = np.repeat(np.eye(4, dtype=np.float32)[None], 4, axis=0)
    T_cloud_tcp[1, :3, 3] = 0.005  # near the first
    T_cloud_tcp[2, 0, 3] = 0.05  # elsewhere
    T_cloud_tcp[3, :3, :3] = Rotation.from_euler("x", 1.0).as_matrix()  # turned away
    order = np.array([1, 0, 2, 3])
    kept, dropped = non_max_suppression(T_cloud_tcp, order, 0.01, 0.5, 10)
    assert (kept.tolist(), dropped.tolist()) == ([1, 2, 3], [0])
    kept, dropped = non_max_suppression(T_cloud_tcp, order, 0.01, 0.5, 2)
    assert (kept.tolist(), dropped.tolist()) == ([1, 2], [0])
    kept, dropped = non_max_suppression(T_cloud_tcp, order, 0.0, 0.0, 10)
    assert (kept.tolist(), dropped.tolist()) == ([1, 0, 2, 3], [])
    kept, _ = non_max_suppression(T_cloud_tcp, order, 0.01, 3.2, 10)  # however they are turned
    assert kept.tolist() == [1, 2]


def test_of_hands_that_are_near_each_other_the_first_is_kept() -> None:
    hands = random_hands(60, seed=1)
    hands[:, :3, 3] = np.random.default_rng(1).uniform(0, 0.015, (60, 3))
    hands[30:, :3, :3] = hands[:30, :3, :3] * (-1, -1, 1)  # turned about their approach
    order = np.random.default_rng(2).permutation(60)
    kept, dropped = non_max_suppression(hands, order, 0.01, 0.8, 60)
    turns, flip = Rotation.from_matrix(hands[:, :3, :3]), Rotation.from_euler("z", np.pi)

    def near(row: int, others: np.ndarray) -> np.ndarray:
        apart = np.linalg.norm(hands[others, :3, 3] - hands[row, :3, 3], axis=1)
        between = turns[row].inv() * turns[others]
        angle = np.minimum(between.magnitude(), (between * flip).magnitude())
        return (apart < 0.01) & (angle < 0.8)

    assert 10 < len(kept) < 60
    assert sorted([*kept, *dropped]) == list(range(60))
    before = np.argsort(order)
    for row in range(60):
        earlier = kept[before[kept] < before[row]]
        assert (row in kept) == (len(earlier) == 0 or not near(row, earlier).any())


@grippers
@pytest.mark.parametrize("count", [30, 2000])
def test_hands_hit_the_points_in_their_boxes_and_are_as_far_from_them(name, count) -> None:
    gripper, points = load_gripper(name), cloud(1, count)
    boxes = gripper.boxes(gripper.max_opening)
    distance = oracles.signed_distance_to_boxes(points, HANDS, boxes)
    found = signed_distance_to_boxes(points, HANDS, boxes)
    np.testing.assert_allclose(found, distance, rtol=0, atol=1e-6)
    sure = np.abs(distance) > 1e-6
    hit = oracles.any_point_in_boxes(points, HANDS, boxes)
    np.testing.assert_array_equal(any_point_in_boxes(points, HANDS, boxes)[sure], hit[sure])
    assert hit.any()
    assert not hit.all()


def test_points_beyond_the_first_block_are_hit_too() -> None:
    far = np.full((2000, 3), 3.0, dtype=np.float32)
    far[-1] = 0.0
    boxes = PANDA.boxes(PANDA.max_opening)
    hit = oracles.any_point_in_boxes(far, HANDS, boxes)
    np.testing.assert_array_equal(any_point_in_boxes(far, HANDS, boxes), hit)
    assert hit.any()


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("count", [3, 40, 3000])
def test_neighbours_are_the_nearest_of_the_same_group(seed: int, count: int) -> None:
    points = cloud(seed, count)
    bounds = np.array([0, count // 3, count // 3, count])  # an empty one between
    expected = oracles.nearest_in_groups(points, bounds, 16)
    np.testing.assert_array_equal(nearest_in_groups(points, bounds, 16), expected)


def test_neighbours_of_points_in_one_place_are_any_of_them() -> None:
    nearest = np.sort(nearest_in_groups(np.zeros((20, 3), np.float32), np.array([0, 20]), 16))
    assert (nearest[:, 1:] > nearest[:, :-1]).all()


def test_no_point_and_no_hand() -> None:
    nothing, some = (Cloud(points, points) for points in (cloud(0, 0), cloud(0)))
    for here, hands in ((nothing, HANDS), (some, HANDS[:0])):
        assert len(hand_views(here, hands, reach_of(PANDA)).row) == 0
        assert not hits_cloud(here, hands, PANDA, Collision()).any()
        assert len(hits_cloud(here, hands, PANDA, Collision())) == len(hands)
    none = np.empty(0, dtype=np.int64)
    crop = crop_balls(cloud(1), none, 0.05)
    assert (len(crop.ball_rows), len(crop.ball_of_point)) == (0, 0)
    assert nearest_in_ball(cloud(1), none, crop).shape == (0, 16)


@given(seed=st.integers(0, SEED), radius=st.floats(0.02, 0.1))
def test_balls_hold_all_points_within_their_radius(seed: int, radius: float) -> None:
    points, approach = cloud(seed, 120), np.array([3, 50, 4, 3])
    crop = crop_balls(points, approach, radius)
    distance = np.linalg.norm(points[approach][:, None].astype(float) - points, axis=2)
    ball, row = np.nonzero(distance <= radius)
    np.testing.assert_array_equal(crop.ball_of_point, ball)
    np.testing.assert_array_equal(crop.ball_rows, row)
    neighbors = nearest_in_ball(points, approach, crop)
    assert (crop.ball_of_point[neighbors] == crop.ball_of_point[:, None]).all()
    np.testing.assert_array_equal(neighbors[:, 0], np.arange(len(row)))


@pytest.mark.parametrize("architecture", ["edgegrasp", "vn-edgegrasp"])
def test_a_fused_convolution_is_the_plain_one(architecture: str) -> None:
    layer = build_network(TINY[architecture]).conv2
    batch = RandomScene.of_seed(1).batch(torch.float32)
    shape = (len(batch.points), 8) if architecture == "edgegrasp" else (len(batch.points), 3, 8)
    features = torch.randn(*shape, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        fused = layer(features, batch)
    plain = layer(features, batch).detach()  # gradients are recorded
    assert plain.std() > 0.01
    # Of vector neurons, a near tie may fall to another vector.
    assert torch.isclose(fused, plain, rtol=1e-4, atol=1e-5).float().mean() > 0.99
    assert not torch.equal(fused, plain)  # two ways, not one twice


def test_fused_ball_features_are_the_plain_ones_and_finite_where_vectors_vanish() -> None:
    layer = build_network(TINY["vn-edgegrasp"]).ball_feature
    batch = RandomScene.of_seed(1).batch(torch.float32)
    local = torch.randn(len(batch.points), 3, 36, generator=torch.Generator().manual_seed(1))
    for values in (local, torch.zeros_like(local)):
        with torch.inference_mode():
            fused = layer(values, batch)
        torch.testing.assert_close(fused, layer(values, batch).detach(), rtol=1e-3, atol=1e-5)


def test_fused_vector_layers_score_as_the_plain_ones() -> None:
    network, close = build_network(TINY["vn-edgegrasp"]), 0
    for seed in range(6):
        batch = RandomScene.of_seed(seed).batch(torch.float32)
        with torch.inference_mode():
            fused = network(batch)
        plain = network(batch).detach()
        close += torch.allclose(fused, plain, rtol=0, atol=0.05 * float(plain.std()))
    assert close >= 5  # in a scene at most
