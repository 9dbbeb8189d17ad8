import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edgegrasp_model.candidates.edge_grasps import edge_grasps
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.hand_description import HAND_DESCRIPTION_SIZE, describe_hands, without_support
from edgegrasp_model.options import SupportPlane
from edgegrasp_model.scene.cloud import Cloud

PANDA = load_gripper()
UP = np.array([0.0, 0.0, 1.0], dtype=np.float32)


def scene(seed: int) -> tuple[Cloud, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    points = (rng.uniform(-0.5, 0.5, (150, 3)) * (0.06, 0.05, 0.07)).astype(np.float32)
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    a, c = rng.integers(len(points), size=(2, 60))
    return Cloud(points, normals), a, c


def describe(cloud: Cloud, a: np.ndarray, c: np.ndarray, up: np.ndarray, support: SupportPlane):
    return describe_hands(cloud, edge_grasps(cloud, a, c, PANDA), PANDA, up, support)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_turning_the_whole_scene_changes_nothing(seed: int) -> None:
    cloud, a, c = scene(seed)
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
    cloud, a, c = scene(0)
    described = describe_hands(cloud, edge_grasps(cloud, a, c, PANDA), PANDA, UP, None)
    assert (described[:, -3:] == np.float32(0.10)).all()
    table = SupportPlane(normal=(0.0, 0.0, 1.0), offset=-0.03)
    known = describe_hands(cloud, edge_grasps(cloud, a, c, PANDA), PANDA, UP, table)
    assert not np.array_equal(known, described)
    np.testing.assert_array_equal(without_support(known), described)
