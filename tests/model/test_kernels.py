"""The compiled loops, and the fused layers made of them, beside a plain way of each."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edgegrasp_model.candidates.edge_grasps import crop_balls
from edgegrasp_model.hand_kernels import (
    non_max_suppression,
)
from edgegrasp_model.kernels import nearest_in_groups
from edgegrasp_model.networks.balls import nearest_in_ball

from . import oracles
from .scenes import SEED, random_hands


def cloud(seed: int, count: int = 700) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-0.1, 0.1, (count, 3)).astype(np.float32)


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
