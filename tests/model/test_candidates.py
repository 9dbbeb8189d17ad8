"""Approach points, the candidates around them, and which of them a request allows."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edgegrasp_model.candidates.edge_grasps import (
    Candidates,
    edge_grasps,
    sample_approach_points,
)
from edgegrasp_model.gripper import Gripper, gripper_names, load_gripper
from edgegrasp_model.scene.cloud import Cloud

from .scenes import PANDA, SEED


@pytest.mark.parametrize("method", ["farthest", "uniform"])
@given(seed=st.integers(0, SEED), count=st.integers(1, 60), size=st.integers(1, 40))
def test_approach_points_are_different_rows(method: str, seed: int, count: int, size: int) -> None:
    points = np.random.default_rng(seed).normal(size=(size, 3)).astype(np.float32)
    rows = sample_approach_points(points, count, method, np.random.default_rng(seed))
    assert len(set(rows.tolist())) == len(rows) == min(count, size)
    again = sample_approach_points(points, count, method, np.random.default_rng(seed))
    np.testing.assert_array_equal(rows, again)


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
