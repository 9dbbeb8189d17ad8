"""Approach points, the candidates around them, and which of them a request allows."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edgegrasp_model.candidates.edge_grasps import (
    MAX_SHIFT,
    MIN_SHIFT,
    BallCrop,
    Candidates,
    centred_grasps,
    crop_balls,
    edge_grasps,
    sample_approach_points,
)
from edgegrasp_model.candidates.sample import allowed_directions
from edgegrasp_model.gripper import Gripper, gripper_names, load_gripper
from edgegrasp_model.options import ApproachDirection, Cone
from edgegrasp_model.scene.cloud import Cloud

from .scenes import PANDA, SEED

RADIUS = 0.045
DOWNWARD = Cone(direction=(0, 0, -5), max_angle=0.2)
SIDEWAYS = Cone(direction=(1, 0, 0), max_angle=0.1)
DOWN, UP = np.array([[0.0, 0.0, -1.0]]), np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("method", ["farthest", "uniform"])
@given(seed=st.integers(0, SEED), count=st.integers(1, 60), size=st.integers(1, 40))
def test_approach_points_are_different_rows(method: str, seed: int, count: int, size: int) -> None:
    points = np.random.default_rng(seed).normal(size=(size, 3)).astype(np.float32)
    rows = sample_approach_points(points, count, method, np.random.default_rng(seed))
    assert len(set(rows.tolist())) == len(rows) == min(count, size)
    again = sample_approach_points(points, count, method, np.random.default_rng(seed))
    np.testing.assert_array_equal(rows, again)


def test_farthest_points_spread_out() -> None:
    line = np.zeros((101, 3), np.float32)
    line[:, 0] = np.linspace(0, 1, 101)
    rows = sample_approach_points(line, 5, "farthest", np.random.default_rng(0))
    gaps = np.diff(np.sort(line[rows, 0]))
    assert gaps.min() > 0.1


def random_pairs(seed: int, gripper: Gripper = PANDA) -> tuple[Cloud, Candidates, np.ndarray]:
    """A cloud over the table, its edge grasps, and the pairs (500, 2) they are of."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.0, 0.06, (200, 3)).astype(np.float32) + np.float32([0, 0, 0.05])
    normals = rng.normal(size=(200, 3)).astype(np.float32)
    cloud = Cloud(points, normals / np.linalg.norm(normals, axis=1, keepdims=True))
    pairs = rng.integers(200, size=(500, 2))
    return cloud, edge_grasps(cloud, *pairs.T, gripper), pairs


@pytest.mark.parametrize("name", gripper_names())
@given(seed=st.integers(0, SEED))
def test_poses_follow_the_definition_of_an_edge_grasp(name: str, seed: int) -> None:
    gripper = load_gripper(name)
    cloud, candidates, pairs = random_pairs(seed, gripper)
    chosen = np.stack([candidates.approach_index, candidates.contact_index], axis=1)
    np.testing.assert_array_equal(chosen, pairs[candidates.pair])
    pose = candidates.T_cloud_hand.astype(np.float64)
    turn = pose[:, :3, :3]
    identity = np.broadcast_to(np.eye(3), turn.shape)
    np.testing.assert_allclose(turn @ turn.transpose(0, 2, 1), identity, atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(turn), 1.0, atol=1e-5)
    np.testing.assert_allclose(candidates.approach, -turn[:, :, 2], atol=1e-6)

    approach, contact = (
        np.einsum("edk,ed->ek", turn, cloud.points[rows] - pose[:, :3, 3]) for rows in chosen.T
    )
    normal = np.einsum("edk,ed->ek", turn, cloud.normals[chosen[:, 1]])
    np.testing.assert_allclose(normal, np.tile([0, 1, 0], (len(pose), 1)), atol=1e-4)
    contact_z = gripper.contact_z_at(2 * np.abs(contact[:, 1]))
    np.testing.assert_allclose(contact[:, 2], contact_z, atol=1e-5)
    np.testing.assert_allclose(contact[:, 0], 0.0, atol=1e-5)
    np.testing.assert_allclose(approach[:, :2], 0.0, atol=1e-5)
    np.testing.assert_allclose(approach[:, 2], contact_z - candidates.depth, atol=1e-5)
    assert (np.abs(contact[:, 1]) < gripper.max_opening / 2).all()
    assert (approach[:, 2] > gripper.palm_z).all()
    tips = gripper.boxes(2 * np.abs(contact[:, 1]))[:, :, 1, 2].max(axis=1)
    np.testing.assert_allclose(tips - contact_z, gripper.tip_z - gripper.contact_z, atol=1e-6)


def can(diameter: float, seed: int = 0) -> Cloud:
    """The lid and the side of an upright can, lid at z = 0."""
    rng = np.random.default_rng(seed)
    turn = rng.uniform(0, 2 * np.pi, 900)
    out = np.stack([np.cos(turn), np.sin(turn), np.zeros(900)], axis=1)
    lid = out * (diameter / 2 * np.sqrt(rng.random(900)))[:, None]
    side = out * (diameter / 2) - np.stack([0 * turn, 0 * turn, rng.uniform(0, 0.08, 900)], axis=1)
    normals = np.concatenate([np.tile([0.0, 0.0, 1.0], (900, 1)), out])
    return Cloud(np.concatenate([lid, side]).astype(np.float32), normals.astype(np.float32))


def candidates_of(cloud: Cloud, seed: int = 1) -> tuple[BallCrop, Candidates]:
    """Edge grasps around 12 points of the lid, and the balls they are in."""
    rng = np.random.default_rng(seed)
    middle = np.flatnonzero(np.linalg.norm(cloud.points, axis=1) < 0.012)
    approach = np.sort(rng.choice(middle, 12, replace=False))
    crop = crop_balls(cloud.points, approach, RADIUS)
    pairs = approach[crop.ball_of_point], crop.ball_rows
    return crop, edge_grasps(cloud, *pairs, PANDA)


def extents(cloud: Cloud, T_cloud_hand: np.ndarray) -> tuple[float, float]:
    """How far what is between the fingers reaches along the closing direction."""
    points = (cloud.points - T_cloud_hand[:3, 3]) @ T_cloud_hand[:3, :3]
    x, y, z = points.T
    between = (np.abs(x) < PANDA.pad_half_width) & (z > PANDA.palm_z) & (z < PANDA.tip_z)
    return float(y[between].min()), float(y[between].max())


def test_a_hand_on_a_wide_can_is_moved_to_its_middle() -> None:
    cloud = can(0.074)
    crop, candidates = candidates_of(cloud)
    further = centred_grasps(cloud.points, crop, candidates, PANDA)
    assert 0 < len(further) < len(candidates)
    before = {int(pair): row for row, pair in enumerate(candidates.pair)}
    for row in range(0, len(further), 7):
        original = candidates.T_cloud_hand[before[int(further.pair[row])]]
        moved = further.T_cloud_hand[row]
        np.testing.assert_array_equal(moved[:3, :3], original[:3, :3])
        shift = original[:3, :3].T @ (moved[:3, 3] - original[:3, 3])
        np.testing.assert_allclose(shift[[0, 2]], 0.0, atol=1e-6)
        assert MIN_SHIFT < abs(shift[1]) < MAX_SHIFT
        low, high = extents(cloud, moved)
        assert low == pytest.approx(-high, abs=0.002)  # the pads' surroundings count too
        low, high = extents(cloud, original)
        assert abs(low + high) / 2 > MIN_SHIFT - 0.001


@pytest.mark.parametrize(
    ("request_", "angles", "allowed"),
    [
        (ApproachDirection(preset="top-down"), [0, 29, 31, 90, 180], [1, 1, 0, 0, 0]),
        (ApproachDirection(preset="side"), [0, 59, 61, 119, 121], [0, 0, 1, 1, 0]),
        # The direction is the way the hand moves: down, not where it comes from.
        (ApproachDirection(cones=(DOWNWARD,)), [0, 11, 12, 180], [1, 1, 0, 0]),
        (ApproachDirection(cones=(SIDEWAYS,), preset="top-down"), [0, 45, 90, 180], [1, 0, 1, 0]),
        # Nothing asked for: not from more than 6 degrees below the horizontal.
        (None, [0, 90, 95, 97, 180], [1, 1, 1, 0, 0]),
    ],
)
def test_directions_are_ways_the_hand_moves(request_, angles, allowed) -> None:
    tilt = np.radians(angles)  # from straight down toward x
    ways = np.stack([np.sin(tilt), 0 * tilt, -np.cos(tilt)], axis=1)
    assert allowed_directions(ways, request_, UP).tolist() == [bool(value) for value in allowed]
