import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.hand_description import BEHIND, DEEP, DepthMap, occlusion_fractions, probes

UP = np.array([0.0, 0.0, 1.0], dtype=np.float32)
CAMERA = np.array([0.0, 0.0, 0.6], dtype=np.float32)
PANDA = load_gripper()


def plate(spacing: float = 0.004) -> np.ndarray:
    """A level plate of 0.1 m in the middle, at a height of 0.1 m, as a cloud.  # (N, 3)."""
    steps = np.arange(-0.05, 0.05, spacing)
    x, y = np.meshgrid(steps, steps)
    return np.stack([x, y, np.full_like(x, 0.1)], axis=-1).reshape(-1, 3).astype(np.float32)


def test_only_what_is_behind_the_plate_is_hidden() -> None:
    seen = DepthMap.of_cloud(plate(), CAMERA, UP)
    places = np.array(
        [[0, 0, 0.15], [0, 0, 0.1], [0.02, -0.03, 0.0], [0.09, 0, 0.0], [0, 0, -3.0], [3, 0, 0.1]]
    )
    hidden = seen.hidden(places.astype(np.float32))
    np.testing.assert_array_equal(hidden, [0, 0, 1, 0, 1, 0])


def test_what_is_just_behind_is_hidden_by_degrees() -> None:
    seen = DepthMap.of_cloud(plate(), CAMERA, UP)
    depth = np.array([BEHIND / 2, BEHIND + DEEP / 2, BEHIND + 2 * DEEP], dtype=np.float32)
    places = np.stack([0 * depth, 0 * depth, 0.1 - depth], axis=1)
    np.testing.assert_allclose(seen.hidden(places), [0.0, 0.5, 1.0], atol=0.02)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_turning_the_whole_scene_changes_next_to_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cloud = (rng.uniform(-0.05, 0.05, (400, 3)) + np.array([0, 0, 0.1])).astype(np.float32)
    camera = np.array([0.3, 0.2, 0.5], dtype=np.float32)
    places = rng.uniform(-0.1, 0.2, (2000, 3)).astype(np.float32)
    before = DepthMap.of_cloud(cloud, camera, UP).hidden(places)
    turn, shift = Rotation.random(rng=rng).as_matrix(), rng.uniform(-1, 1, 3)

    def moved(points: np.ndarray) -> np.ndarray:
        return (points @ turn.T + shift).astype(np.float32)

    after = DepthMap.of_cloud(moved(cloud), moved(camera), turn @ UP).hidden(moved(places))
    # A point within rounding of a cell's side may fall on its other side.
    assert np.isclose(before, after, atol=1e-3).mean() > 0.99


def test_the_finger_behind_a_plate_is_the_one_that_nobody_saw() -> None:
    # A hand from the side, its fingers above and below the plate: y, the closing direction, is up.
    hand = np.eye(4, dtype=np.float32)
    hand[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    hand[:3, 3] = [-0.1, 0.0, 0.1]
    parts = occlusion_fractions(plate(), hand[None], CAMERA, UP, PANDA)
    above, below = parts[0][0], parts[1][0]
    assert above == 0.0
    assert below > 0.9
    unknown = occlusion_fractions(plate(), hand[None], None, UP, PANDA)
    assert len(unknown) == len(parts)
    assert not np.any(unknown)


@pytest.mark.parametrize("name", ["panda", "robotiq-2f-85", "robotiq-2f-140", "wsg-50"])
def test_probes_lie_where_they_are_said_to(name: str) -> None:
    gripper = load_gripper(name)
    tips_right, tips_left, *_, hand = probes(gripper)
    assert (tips_right[:, 1] > gripper.max_opening / 2).all()
    np.testing.assert_allclose(tips_left * (1, -1, 1), tips_right, atol=1e-7)
    assert (hand[:, 2] < gripper.tip_z).all()


def test_a_camera_straight_above_has_a_map_too() -> None:
    seen = DepthMap.of_cloud(plate(), CAMERA, UP)
    np.testing.assert_allclose(seen.frame.axes @ seen.frame.axes.T, np.eye(3), atol=1e-6)
