import numpy as np
import pytest
import torch
from edgegrasp_model.on_device.balls import DeviceCrop
from edgegrasp_model.on_device.candidates import DeviceCandidates
from edgegrasp_model.on_device.centred import centred_grasps as on_device
from numpy.typing import NDArray

from edgegrasp_model.candidates.edge_grasps import (
    MAX_SHIFT,
    MIN_SHIFT,
    BallCrop,
    Candidates,
    centred_grasps,
    crop_balls,
    edge_grasps,
)
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.scene.cloud import Cloud

HAND = load_gripper("panda")
RADIUS = 0.045


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
    return crop, edge_grasps(cloud, *pairs, HAND)


def extents(cloud: Cloud, T_cloud_hand: NDArray[np.float32]) -> tuple[float, float]:
    """How far what is between the fingers reaches along the closing direction."""
    points = (cloud.points - T_cloud_hand[:3, 3]) @ T_cloud_hand[:3, :3]
    x, y, z = points.T
    between = (np.abs(x) < HAND.pad_half_width) & (z > HAND.palm_z) & (z < HAND.tip_z)
    return float(y[between].min()), float(y[between].max())


def test_a_hand_on_a_wide_can_is_moved_to_its_middle() -> None:
    cloud = can(0.074)
    crop, candidates = candidates_of(cloud)
    further = centred_grasps(cloud.points, crop, candidates, HAND)
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


def test_nothing_is_moved_where_the_middle_does_not_matter() -> None:
    cloud = can(0.05)
    assert len(centred_grasps(cloud.points, *candidates_of(cloud), HAND)) == 0


def test_the_candidates_themselves_stay_where_they_are() -> None:
    cloud = can(0.07)
    crop, candidates = candidates_of(cloud)
    before = candidates.T_cloud_hand.copy()
    assert len(centred_grasps(cloud.points, crop, candidates, HAND)) > 0
    np.testing.assert_array_equal(candidates.T_cloud_hand, before)
    none = candidates.take(np.empty(0, dtype=np.int64))
    assert len(centred_grasps(cloud.points, crop, none, HAND)) == 0


@pytest.mark.parametrize("name", ["robotiq-2f-85", "robotiq-2f-140", "wsg-50"])
def test_every_hand_has_the_contact_between_its_fingers(name: str) -> None:
    hand, cloud = load_gripper(name), can(0.075)
    rng = np.random.default_rng(2)
    approach = np.sort(rng.choice(900, 8, replace=False))
    crop = crop_balls(cloud.points, approach, 0.07)
    candidates = edge_grasps(cloud, approach[crop.ball_of_point], crop.ball_rows, hand)
    with np.errstate(all="raise"):
        further = centred_grasps(cloud.points, crop, candidates, hand)
    assert np.isfinite(further.T_cloud_hand).all()


@pytest.mark.parametrize("seed", range(3))
def test_a_device_moves_the_same_hands(seed: int) -> None:
    cloud = can(0.072, seed)
    crop, candidates = candidates_of(cloud, seed)
    expected = centred_grasps(cloud.points, crop, candidates, HAND)
    found = on_device(
        torch.from_numpy(cloud.points),
        DeviceCrop(torch.from_numpy(crop.ball_rows), torch.from_numpy(crop.ball_of_point), RADIUS),
        DeviceCandidates(*(torch.from_numpy(array) for array in vars(candidates).values())),
        HAND,
    ).on_processor
    assert len(expected) > 0
    np.testing.assert_array_equal(found.pair, expected.pair)
    np.testing.assert_allclose(found.T_cloud_hand, expected.T_cloud_hand, atol=1e-6)
