import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from edgegrasp_model.candidates.edge_grasps import (
    TIP_MARGIN,
    edge_grasps,
    retract,
    support_clearance,
)
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.options import SupportPlane
from edgegrasp_model.scene.cloud import Cloud

PANDA = load_gripper()
TABLE = SupportPlane(normal=(0.0, 0.0, 1.0), offset=0.05)


def random_pairs(seed: int, count: int = 200):
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.0, 0.06, (count, 3)).astype(np.float32) + np.float32([0, 0, 0.05])
    normals = rng.normal(size=(count, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    a, c = rng.integers(count, size=(2, 500))
    return Cloud(points, normals), edge_grasps(Cloud(points, normals), a, c, PANDA), a, c


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_poses_follow_the_definition_of_an_edge_grasp(seed: int) -> None:
    cloud, candidates, a, c = random_pairs(seed)
    np.testing.assert_array_equal(candidates.approach_index, a[candidates.pair])
    np.testing.assert_array_equal(candidates.contact_index, c[candidates.pair])
    pose = candidates.T_cloud_hand.astype(np.float64)
    turn = pose[:, :3, :3]
    identity = np.broadcast_to(np.eye(3), turn.shape)
    np.testing.assert_allclose(turn @ turn.transpose(0, 2, 1), identity, atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(turn), 1.0, atol=1e-5)

    def in_hand(points: np.ndarray) -> np.ndarray:
        return np.einsum("edk,ed->ek", turn, points - pose[:, :3, 3])

    p_a, p_c = cloud.points[candidates.approach_index], cloud.points[candidates.contact_index]
    n_c = cloud.normals[candidates.contact_index]
    np.testing.assert_allclose(
        np.einsum("edk,ed->ek", turn, n_c), [[0, 1, 0]] * len(p_a), atol=1e-4
    )
    contact, approach = in_hand(p_c), in_hand(p_a)
    np.testing.assert_allclose(contact[:, 2], PANDA.contact_z, atol=1e-5)
    np.testing.assert_allclose(contact[:, 0], 0.0, atol=1e-5)
    np.testing.assert_allclose(approach[:, :2], 0.0, atol=1e-5)
    np.testing.assert_allclose(approach[:, 2], PANDA.contact_z - candidates.depth, atol=1e-5)
    np.testing.assert_allclose(candidates.approach, -turn[:, :, 2], atol=1e-6)
    assert (np.abs(contact[:, 1]) < PANDA.max_opening / 2).all()


def test_a_point_does_not_make_an_edge_with_itself() -> None:
    cloud, _, _, _ = random_pairs(0)
    same = np.arange(len(cloud.points))
    assert len(edge_grasps(cloud, same, same, PANDA)) == 0


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_support_clearance_is_the_lowest_point_of_any_box(seed: int) -> None:
    _, candidates, _, _ = random_pairs(seed)
    clearance = support_clearance(candidates.T_cloud_hand, TABLE, PANDA)
    rng = np.random.default_rng(seed)
    boxes = PANDA.boxes(PANDA.max_opening)
    samples = rng.uniform(size=(len(boxes), 2000, 3)).round()  # corners of each box
    points = (boxes[:, :1] + samples * (boxes[:, 1:] - boxes[:, :1])).reshape(-1, 3)
    for pose, expected in zip(candidates.T_cloud_hand[:5], clearance[:5], strict=True):
        heights = (points @ pose[:3, :3].T + pose[:3, 3])[:, 2] - TABLE.offset
        np.testing.assert_allclose(heights.min(), expected, atol=1e-5)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_hands_are_drawn_back_just_out_of_the_table(seed: int) -> None:
    _, candidates, _, _ = random_pairs(seed)
    before = support_clearance(candidates.T_cloud_hand, TABLE, PANDA)
    drawn, kept = retract(candidates, TABLE, PANDA)
    clear = drawn.take(kept)
    np.testing.assert_array_equal(drawn.T_cloud_hand[~kept], candidates.T_cloud_hand[~kept])
    after = support_clearance(clear.T_cloud_hand, TABLE, PANDA)
    assert (after >= -1e-6).all()
    assert set(candidates.pair[before >= 0]) <= set(clear.pair)
    shift = (
        clear.T_cloud_hand[:, :3, 3]
        - candidates.T_cloud_hand[np.isin(candidates.pair, clear.pair), :3, 3]
    )
    back = np.einsum("ed,ed->e", shift, clear.approach)
    np.testing.assert_allclose(shift, back[:, None] * clear.approach, atol=1e-6)
    assert (back >= -1e-7).all()
    assert (back <= PANDA.tip_z - PANDA.contact_z - TIP_MARGIN + 1e-6).all()
    np.testing.assert_allclose(after[back > 1e-6], 0.0, atol=1e-5)
