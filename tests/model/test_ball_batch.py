import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from edgegrasp_model.candidates.edge_grasps import crop_balls
from edgegrasp_model.networks.balls import BallBatch, nearest_in_ball


def cloud(seed: int, count: int = 120) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-0.08, 0.08, (count, 3)).astype(np.float32)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), radius=st.floats(0.02, 0.1))
def test_balls_and_neighbors_are_those_of_brute_force(seed, radius):
    points = cloud(seed)
    approach_index = np.array([3, 50, 4])
    crop = crop_balls(points, approach_index, radius)
    neighbors = nearest_in_ball(points, approach_index, crop, k=16)

    for ball, index in enumerate(approach_index):
        distance = np.linalg.norm(points.astype(float) - points[index], axis=1)
        rows = np.flatnonzero(crop.ball_of_point == ball)
        np.testing.assert_array_equal(crop.ball_rows[rows], np.flatnonzero(distance <= radius))

        members = points[crop.ball_rows[rows]] - points[index]
        between = np.linalg.norm(members[:, None].astype(float) - members, axis=2)
        for place, own_row in enumerate(rows):
            nearest = set(rows[np.argsort(between[place], kind="stable")[:16]])
            assert set(neighbors[own_row]) == nearest
            assert neighbors[own_row, 0] == own_row


def test_a_small_ball_repeats_the_own_row():
    points = np.array([[0, 0, 0], [0.01, 0, 0], [0.2, 0, 0]], dtype=np.float32)
    crop = crop_balls(points, np.array([0]), 0.05)
    np.testing.assert_array_equal(crop.ball_rows, [0, 1])
    neighbors = nearest_in_ball(points, np.array([0]), crop, k=4)
    np.testing.assert_array_equal(neighbors, [[0, 1, 0, 0], [1, 0, 1, 1]])


def test_a_point_within_two_balls_counts_twice_and_keeps_to_its_ball():
    points = cloud(1)
    crop = crop_balls(points, np.array([7, 7]), 0.08)
    half = len(crop.ball_rows) // 2
    np.testing.assert_array_equal(crop.ball_rows[:half], crop.ball_rows[half:])
    neighbors = nearest_in_ball(points, np.array([7, 7]), crop)
    np.testing.assert_array_equal(neighbors[:half] + half, neighbors[half:])


def test_no_approach_points_make_no_balls():
    none = np.empty(0, dtype=np.int64)
    crop = crop_balls(cloud(1), none, 0.05)
    assert (len(crop.ball_rows), len(crop.ball_of_point)) == (0, 0)
    assert nearest_in_ball(cloud(1), none, crop).shape == (0, 16)


def test_from_cloud_centres_each_ball_on_its_approach_point():
    points, approach_index = cloud(2), np.array([5, 9])
    crop = crop_balls(points, approach_index, 0.08)
    batch = BallBatch.from_cloud(
        points,
        points[::-1],
        approach_index,
        crop,
        contact=np.array([0, len(crop.ball_rows) - 1]),
        approach=np.eye(3)[:2],
        depth=np.array([0.01, 0.02]),
    )
    for ball, index in enumerate(approach_index):
        rows = crop.ball_of_point == ball
        expected = points[crop.ball_rows[rows]] - points[index]
        np.testing.assert_array_equal(batch.points[rows].numpy(), expected)
    assert batch.ball_of_edge.tolist() == [0, 1]
    assert sum(batch.ball_sizes) == len(batch.points)
    assert {batch.points.dtype, batch.normals.dtype, batch.approach.dtype, batch.depth.dtype} == {
        torch.float32
    }


def test_concatenate_shifts_rows_and_balls(random_scene):
    first, second = random_scene(1).batch(), random_scene(2).batch()
    both = BallBatch.concatenate([first, second])

    assert both.num_balls == first.num_balls + second.num_balls
    assert both.ball_sizes == first.ball_sizes + second.ball_sizes
    tail = slice(len(first.points), None)
    torch.testing.assert_close(
        both.points[both.neighbors[tail]], second.points[second.neighbors], rtol=0, atol=0
    )
    torch.testing.assert_close(
        both.points[both.contact[len(first.contact) :]], second.points[second.contact]
    )
    assert both.ball_of_edge[-1] == second.ball_of_edge[-1] + first.num_balls


def test_there_is_no_batch_of_no_batches():
    with pytest.raises(ValueError, match=r"batches: got none"):
        BallBatch.concatenate([])
