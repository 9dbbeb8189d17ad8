"""Edges and hand poses that a caller gives."""

import numpy as np
from tests.checks import refusal
from tests.many_options import OWN_GRIPPER

from edgegrasp_model.gripper import HALF_TURN, gripper_fields
from edgegrasp_model.options import DetectOptions
from edgegrasp_model.results import NoGraspReason
from edgegrasp_model.scene.cloud import CloudInput
from edgegrasp_results import Grasp

from .scenes import PANDA, box_on_table, detector

ASKED = {
    "viewpoint": (0.3, 0.2, 0.5),
    "support": {"normal": (0.0, 0.0, 1.0), "offset": 0.0},
    "num_approach_points": 12,
    "suppression": None,
    "top_k": 300,
    "collision": "penalise",
}


def ask(**fields: object) -> DetectOptions:
    return DetectOptions.model_validate(ASKED | fields)


def row_of(cloud: np.ndarray, point: np.ndarray) -> int:
    return int(np.linalg.norm(cloud - point, axis=1).argmin())


def edge_of(cloud: np.ndarray, found: Grasp) -> list[int]:
    return [row_of(cloud, found.approach_point), row_of(cloud, found.contact_point)]


def same_pose(one: Grasp | None, other: Grasp) -> bool:
    return one is not None and np.allclose(one.T_cloud_hand, other.T_cloud_hand, atol=1e-5)


def test_edges_of_detected_grasps_are_the_grasps_that_were_detected() -> None:
    cloud = box_on_table()
    found = detector().detect(cloud, ask())
    edges = np.array([edge_of(cloud, grasp) for grasp in found.grasps])
    scored = detector().score(cloud, ask(), edges=edges)
    assert len(scored.evaluations) == len(found.grasps)
    same = 0
    for mine, theirs in zip(scored.evaluations, found.grasps, strict=True):
        if not same_pose(mine.grasp, theirs):
            continue  # a top-down grasp, or a row that went into a neighbouring voxel
        same += 1
        np.testing.assert_allclose(mine.grasp.clearance, theirs.clearance, atol=1e-6)
        np.testing.assert_allclose(mine.grasp.width, theirs.width, atol=1e-6)
        np.testing.assert_array_equal(mine.grasp.contact_point, theirs.contact_point)
        assert mine.grasp.collision_free == theirs.collision_free
    assert same > 0.5 * len(found.grasps)
    same = 0
    for seed in range(12):  # without others like it, the score is that of the edge
        (found,) = detector().detect(cloud, ask(num_candidates=1, min_score=0.0, seed=seed)).grasps
        edge = np.array([edge_of(cloud, found)])
        (mine,) = detector().score(cloud, ask(), edges=edge).evaluations
        if same_pose(mine.grasp, found):
            same += 1
            np.testing.assert_allclose(mine.grasp.score, found.score, atol=1e-5)
    assert same


def test_answers_keep_the_order_of_the_edges_and_say_why_there_is_no_grasp() -> None:
    rng = np.random.default_rng(0)
    flat = rng.uniform(-0.1, 0.1, (4000, 3)) * (1, 1, 0)
    edge = np.array([[0.001, 0.0, 0.0]])
    cloud = np.concatenate([flat, edge, [[0.0, 0.0, -0.5]]]).astype(np.float32)

    def row(x: float, y: float) -> int:
        return row_of(cloud, np.array([x, y, 0.0]))

    origin, near, far = row(0, 0), row(0.02, 0), row(0.06, 0)
    asked = [[origin, origin], [origin, far], [origin, near], [origin, 4001], [near, origin]]
    outside = {"min": (-1, -1, -0.1), "max": (1, 1, 1)}
    answer = detector().score(cloud, ask(support=None, workspace=outside), edges=np.array(asked))
    reasons = [NoGraspReason.TOO_SHORT, NoGraspReason.TOO_LONG, None, NoGraspReason.NO_POINT, None]
    assert [each.reason for each in answer.evaluations] == reasons
    assert [each.grasp is None for each in answer.evaluations] == [True, True, False, True, False]
    one, other = answer.evaluations[2].grasp, answer.evaluations[4].grasp
    # The hand moves from p_a to p_c, along the sheet.
    assert one.approach_direction[0] > 0.9
    assert other.approach_direction[0] < -0.9
    np.testing.assert_array_equal(one.approach_point, other.contact_point)
    assert answer.counts["given"] == 5
    assert answer.counts["scored"] == 2
    for wrong, value in (([[-1, 0]], "row -1"), ([[0, 4002]], "4002"), ([[0, 1]] * 16_001, "")):
        with refusal("edges", value):
            detector().score(cloud, ask(), edges=np.array(wrong))
    nowhere = ask(workspace={"min": (5, 5, 5), "max": (6, 6, 6)})  # all of it is cropped away
    answer = detector().score(cloud, nowhere, edges=np.array([[0, 1], [2, 3]]))
    assert [each.reason for each in answer.evaluations] == [NoGraspReason.NO_POINT] * 2


def test_edges_along_the_normal_or_deeper_than_the_fingers_define_no_grasp() -> None:
    rng = np.random.default_rng(0)
    lower = rng.uniform(-0.05, 0.05, (3000, 3)) * (1, 1, 0)
    normals = np.concatenate([np.tile([0.0, 0, 1], (3000, 1)), np.tile([0.0, 1, 0], (3000, 1))])
    cloud = np.concatenate([lower, lower + np.array([0, 0, 0.03])]).astype(np.float32)
    a = row_of(cloud, np.array([0, 0, 0.03]))
    c = int(a - 3000)
    sent = CloudInput(cloud, normals=normals)
    # The voxels of both sheets are the same ones but for their height: the edge is vertical.
    both = detector().score(sent, ask(support=None), edges=np.array([[a, c], [c, a]]))
    assert both.evaluations[0].reason == NoGraspReason.NO_DIRECTION
    assert both.evaluations[1].grasp is not None
    finger = {"boxes": [[[-0.01, 0, 0.05], [0.01, 0.02, 0.07]]]}
    short = OWN_GRIPPER | {"tip_z": 0.07, "contact_z": 0.065, "finger": finger}
    deep = detector().score(sent, ask(support=None, gripper=short), edges=np.array([[c, a]]))
    assert deep.evaluations[0].reason == NoGraspReason.TOO_DEEP


def test_hand_poses_of_detected_grasps_find_their_own_contacts() -> None:
    cloud, hand = box_on_table(), gripper_fields("panda")
    hand["hand"]["boxes"].append([[0.0316, -0.03, 0.02], [0.1, 0.03, 0.09]])  # a camera on one side
    found = detector().detect(cloud, ask(collision="avoid", min_score=0.0, gripper=hand))
    poses = np.stack([grasp.T_cloud_hand for grasp in found.grasps])
    scored = detector().score(cloud, ask(gripper=hand), hand_poses=poses)
    assert len(scored.evaluations) == len(poses) > 20
    near = 0
    for pose, theirs, mine in zip(poses, found.grasps, scored.evaluations, strict=True):
        np.testing.assert_allclose(mine.grasp.T_cloud_hand, pose, atol=1e-5)
        np.testing.assert_allclose(mine.grasp.clearance, theirs.clearance, atol=1e-5)
        assert mine.grasp.collision_free
        near += np.linalg.norm(mine.grasp.contact_point - theirs.contact_point) < 0.025
        contact = (mine.grasp.contact_point - pose[:3, 3]) @ pose[:3, :3]
        assert abs(contact[0]) < PANDA.pad_half_width
        assert abs(contact[1]) < PANDA.max_opening / 2
    assert near > 0.8 * len(poses)
    flipped = detector().score(cloud, ask(gripper=hand), hand_poses=poses * HALF_TURN)
    assert not all(each.grasp.collision_free for each in flipped.evaluations)
    for one, other in zip(scored.evaluations, flipped.evaluations, strict=True):
        np.testing.assert_allclose(one.grasp.score, other.grasp.score, atol=1e-3)
        np.testing.assert_allclose(one.grasp.contact_point, other.grasp.contact_point, atol=1e-6)


def test_hand_poses_hold_the_object_where_specks_of_background_are_on_it() -> None:
    cloud = box_on_table()
    found = detector().detect(cloud, ask(collision="ignore", min_score=0.0))
    poses = np.stack([grasp.T_cloud_hand for grasp in found.grasps])
    specks = np.floor(cloud / 0.005).astype(int).sum(axis=1) % 3 == 0
    segmented = CloudInput(cloud, segment_ids=1 - specks.astype(int))
    scored = detector().score(segmented, ask(collision="ignore"), hand_poses=poses)
    assert all(one.grasp is None or one.grasp.object == 1 for one in scored.evaluations)


def test_fingers_that_swing_are_as_free_when_scored_as_when_found() -> None:
    asked = {"collision": "avoid", "min_score": 0.0, "gripper": "robotiq-2f-85"}
    cloud = box_on_table(size=(0.04, 0.06, 0.02))
    poses = [grasp.T_cloud_hand for grasp in detector().detect(cloud, ask(**asked)).grasps]
    scored = detector().score(cloud, ask(gripper="robotiq-2f-85"), hand_poses=np.array(poses))
    assert all(each.grasp.collision_free for each in scored.evaluations)
    assert len(poses) > 10


def test_poses_in_the_air_hold_nothing_and_colliding_ones_are_marked() -> None:
    poses = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (2, 1, 1))
    poses[0, :3, 3] = 1.0
    poses[1, 2, 3] = 0.1  # the tips below the table, the palm in the box
    air, box = detector().score(box_on_table(500), ask(), hand_poses=poses).evaluations
    assert air.reason == NoGraspReason.NOTHING_BETWEEN
    whole = detector().score(box_on_table(500), ask(), hand_poses=np.eye(4, dtype=int)[None])
    assert len(whole.evaluations) == 1
    assert not box.grasp.collision_free
    assert box.grasp.clearance < 0
