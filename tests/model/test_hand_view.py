"""What a hand sees of the cloud in its own frame, and what of it no camera saw."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edgegrasp_model.candidates.edge_grasps import edge_grasps
from edgegrasp_model.gripper import gripper_names, load_gripper
from edgegrasp_model.hand_description import (
    BEHIND,
    DEEP,
    HAND_DESCRIPTION_SIZE,
    DepthMap,
    describe_hands,
    occlusion_fractions,
    probes,
    without_support,
)
from edgegrasp_model.hand_view import hand_views, reach_of
from edgegrasp_model.options import SupportPlane
from edgegrasp_model.scene.cloud import Cloud

from .scenes import PANDA, SEED, random_hands

UP = np.array([0.0, 0.0, 1.0], dtype=np.float32)
CAMERA = np.array([0.0, 0.0, 0.6], dtype=np.float32)


def test_views_of_some_hands_are_those_of_all_taken() -> None:
    points = np.random.default_rng(0).uniform(-0.1, 0.15, (300, 3)).astype(np.float32)
    cloud, hands, rows = Cloud(points, points), random_hands(9, 0, 0.05), np.array([1, 4, 8])
    taken = hand_views(cloud, hands, reach_of(PANDA)).take(rows)
    direct = hand_views(cloud, hands[rows], reach_of(PANDA))
    np.testing.assert_array_equal(taken.candidate, direct.candidate)
    np.testing.assert_array_equal(taken.row, direct.row)
    np.testing.assert_allclose(taken.position, direct.position, atol=1e-6)


def described_scene(seed: int) -> tuple[Cloud, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    points = (rng.uniform(-0.5, 0.5, (150, 3)) * (0.06, 0.05, 0.07)).astype(np.float32)
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    a, c = rng.integers(len(points), size=(2, 60))
    return Cloud(points, normals), a, c


def describe(cloud: Cloud, a: np.ndarray, c: np.ndarray, up: np.ndarray, support: SupportPlane):
    return describe_hands(cloud, edge_grasps(cloud, a, c, PANDA), PANDA, up, support)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, SEED))
def test_turning_the_whole_scene_changes_no_description(seed: int) -> None:
    cloud, a, c = described_scene(seed)
    rng = np.random.default_rng(seed + 1)
    turn, shift = Rotation.random(rng=rng).as_matrix(), rng.uniform(-1, 1, 3)
    turned = Cloud(
        (cloud.points @ turn.T + shift).astype(np.float32),
        (cloud.normals @ turn.T).astype(np.float32),
    )
    normal = turn @ UP
    before = describe(cloud, a, c, UP, SupportPlane(normal=tuple(UP.tolist()), offset=-0.03))
    offset = float(normal @ shift) - 0.03
    support = SupportPlane(normal=tuple(normal.tolist()), offset=offset)
    after = describe(turned, a, c, normal.astype(np.float32), support)
    assert before.shape[1] == HAND_DESCRIPTION_SIZE
    # Points within rounding of a box's face may fall on its other side: rare, so count them.
    assert np.isclose(before, after, atol=2e-3).mean() > 0.995


def test_points_in_a_finger_and_between_the_fingers_are_counted() -> None:
    # An edge along -z from p_a, the contact on its -y side: the hand looks down, y closing.
    points = np.array(
        [[0, 0, 0.02], [0, 0.01, 0.0], [0, -0.01, 0.0], [0, 0.05, 0.0], [0, 0.3, 0]], np.float32
    )
    normals = np.array([[0, 0, 1], [0, 1, 0], [0, -1, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    support = SupportPlane(normal=(0.0, 0.0, 1.0), offset=-0.02)
    row = describe(Cloud(points, normals), np.array([0]), np.array([1]), UP, support)[0]
    in_fingers, between, depth, contact_height = row[0:2], row[7], row[53], row[59]
    np.testing.assert_allclose(sorted(in_fingers), [0.0, np.log(2)], atol=1e-6)
    np.testing.assert_allclose(between, np.log(4), atol=1e-6)  # p_a and both sides
    np.testing.assert_allclose(depth, 0.02, atol=1e-6)
    np.testing.assert_allclose(contact_height, 0.02, atol=1e-6)


def test_without_a_support_plane_heights_are_the_same_stand_in() -> None:
    cloud, a, c = described_scene(0)
    described = describe_hands(cloud, edge_grasps(cloud, a, c, PANDA), PANDA, UP, None)
    assert (described[:, -3:] == np.float32(0.10)).all()
    table = SupportPlane(normal=(0.0, 0.0, 1.0), offset=-0.03)
    known = describe_hands(cloud, edge_grasps(cloud, a, c, PANDA), PANDA, UP, table)
    assert not np.array_equal(known, described)
    np.testing.assert_array_equal(without_support(known), described)


def plate(spacing: float = 0.004) -> np.ndarray:
    """A level plate of 0.1 m in the middle, at a height of 0.1 m, as a cloud.  # (N, 3)."""
    steps = np.arange(-0.05, 0.05, spacing)
    x, y = np.meshgrid(steps, steps)
    return np.stack([x, y, np.full_like(x, 0.1)], axis=-1).reshape(-1, 3).astype(np.float32)


@pytest.mark.parametrize("exactly_above", [False, True])
def test_only_what_is_behind_the_plate_is_hidden(exactly_above: bool) -> None:
    camera = plate().mean(axis=0) + UP / 2 if exactly_above else CAMERA
    seen = DepthMap.of_cloud(plate(), camera, UP)
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
@given(seed=st.integers(0, SEED))
def test_turning_the_whole_scene_hides_next_to_nothing_else(seed: int) -> None:
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


@pytest.mark.parametrize("name", gripper_names())
def test_probes_lie_where_they_are_said_to(name: str) -> None:
    gripper = load_gripper(name)
    tips_right, tips_left, *_, hand = probes(gripper)
    assert (tips_right[:, 1] > gripper.max_opening / 2).all()
    np.testing.assert_allclose(tips_left * (1, -1, 1), tips_right, atol=1e-7)
    assert (hand[:, 2] < gripper.tip_z).all()
